"""Search for a best-known front: policies of one scenario, the same in every episode, that no known policy dominates.

    python scripts/bounds/front.py --scenario one_waypoint --action-type discrete --decisions 300000000 --seed 0
    python scripts/bounds/front.py --scenario static_obstacle --from RUN RUN ...

An evolutionary search over action sequences that starts from the shipped front, from the policies of trained runs and
from random driving rules. Every sequence is evaluated in the simulation. The policies that make up most of the
hypervolume replace the shipped front, unless that would make its hypervolume smaller. The same arguments, runs and
shipped front give the same front.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import moocore
import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import mo_deepdrive
from algorithms.runs.cli import TRUST, make_parser
from mo_deepdrive.fronts.reference_fronts import GAMMA, KnownPolicy
from mo_deepdrive.fronts.reference_fronts import read as read_front
from mo_deepdrive.fronts.reference_fronts import write as format_front
from mo_deepdrive.support.atomic_io import atomic_write
from mo_deepdrive.world.action_sequences import decode as decode_actions
from mo_deepdrive.world.action_sequences import encode as encode_actions
from mo_deepdrive.world.config import ActionType
from mo_deepdrive.world.scenarios import SCENARIOS
from scripts.bounds.front_search import UNKNOWN_SOURCE, FrontSearch
from scripts.bounds.plans import CRITERIA, Criterion
from scripts.result_file import check_folder, check_least

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Sequence

    from scripts.bounds.plans import EvaluatedPlans
    from scripts.bounds.trained_runs import RunRecording


@dataclass(frozen=True)
class FrontSearchSettings:
    """Settings of a search, as on the command line.

    Attributes:
        scenario: "one_waypoint" or "static_obstacle".
        action_type: "discrete", "discrete-16" or "continuous".
        decisions: to simulate, at least; the last generation may exceed them.
        seed: of all random choices.
        anew: do not start from the shipped front.
        episodes: sampled episodes per policy of the recorded runs; only for :meth:`command`.
    """

    scenario: str = "one_waypoint"
    action_type: str = "discrete"
    decisions: int = 300_000_000
    seed: int = 0
    anew: bool = False
    episodes: int = 8

    def command(self, runs: Sequence[str] = ()) -> str:
        """The command line that repeats the search, also from the named runs."""
        parts = [f"--scenario {self.scenario} --action-type {self.action_type}"]
        parts.append(f"--decisions {self.decisions} --seed {self.seed}")
        parts += ["--anew"] if self.anew else []
        parts += [f"--from {' '.join(runs)} --episodes {self.episodes}"] if runs else []
        return f"python scripts/bounds/front.py {' '.join(parts)}"


@dataclass(frozen=True)
class FrontImprovement:
    """The shipped front and the one that a search found.

    Attributes:
        settings: of the search.
        policies: of the front found.
        sizes: policies on the shipped front and on the one found, for each of CRITERIA.
        hypervolumes: of the shipped front and of the one found, for each of CRITERIA.
    """

    settings: FrontSearchSettings
    policies: list[KnownPolicy]
    sizes: list[tuple[int, int]]
    hypervolumes: list[tuple[float, float]]

    @property
    def loses_hypervolume(self) -> bool:
        """Whether the front found has a smaller hypervolume than the shipped one for any of CRITERIA."""
        return any(after < before for before, after in self.hypervolumes)

    def write(self, file: Path) -> int:
        """Write the front found to ``file``, atomically; its size in characters."""
        text = format_front(self.settings.scenario, self.settings.action_type, self.policies)
        atomic_write(file, text.encode())
        return len(text)


def shipped_front_file(scenario: str, action_type: str) -> Path:
    """Where the best-known front of a scenario and action set is shipped."""
    return Path(mo_deepdrive.__file__).parent / "data" / f"front_{scenario}_{action_type}.json"


def improve_front(
    settings: FrontSearchSettings,
    shipped: Path,
    recordings: Sequence[RunRecording] = (),
    on_progress: Callable[[int], None] = lambda _: None,
) -> FrontImprovement:
    """Search for a better front. The same arguments and shipped front give the same front.

    Args:
        settings: of the search.
        shipped: file of the shipped front, which may be missing.
        recordings: of trained runs, from which the search also starts.
        on_progress: called after every generation with the number of decisions simulated.
    """
    search = FrontSearch(settings.scenario, settings.action_type, settings.seed)
    evaluator, plan_format = search.evaluator, search.evaluator.format

    policies = read_front(shipped.read_text(encoding="utf-8")) if shipped.is_file() else ()
    sources = [policy.source for policy in policies]
    sequences = [decode_actions(policy.actions, settings.action_type) for policy in policies]
    before = evaluator.evaluate(plan_format.from_sequences(sequences), UNKNOWN_SOURCE)
    before.sources[:] = np.arange(len(policies))
    start = before.take(np.arange(0)) if settings.anew else before
    for recording in recordings:
        start = start.append(evaluator.evaluate(plan_format.from_sequences(recording.sequences), len(sources)))
        sources.append(recording.source)
    search.add(start)

    this_search = len(sources)
    sources.append(settings.command([recording.name for recording in recordings]))
    search.archive.sources[search.archive.sources == UNKNOWN_SOURCE] = this_search
    evaluator.simulated_decisions = 0
    while evaluator.simulated_decisions < settings.decisions:
        search.evolve(this_search)
        on_progress(evaluator.simulated_decisions)

    after = search.select_front(also=start)
    volumes = zip(search.hypervolumes(before), search.hypervolumes(after), strict=True)
    return FrontImprovement(
        settings=settings,
        policies=_known_policies(search, after, sources),
        sizes=list(zip(_nondominated_counts(before), _nondominated_counts(after), strict=True)),
        hypervolumes=list(volumes),
    )


def _nondominated_counts(evaluated: EvaluatedPlans) -> list[int]:
    """How many plans no other dominates, for each of CRITERIA."""
    return [int(moocore.is_nondominated(returns, maximise=True).sum()) for returns in evaluated.returns]


def _known_policies(search: FrontSearch, evaluated: EvaluatedPlans, sources: Sequence[str]) -> list[KnownPolicy]:
    """The plans as the policies of a front's file."""
    undiscounted, discounted = (
        np.round(evaluated.returns[CRITERIA.index(Criterion(gamma))], 6).tolist() for gamma in (1.0, GAMMA)
    )
    rows = zip(evaluated.plans, undiscounted, discounted, evaluated.sources, strict=True)
    return [
        KnownPolicy(
            actions=encode_actions(search.evaluator.format.to_sequence(plan)),
            undiscounted=tuple(whole),
            discounted=tuple(present),
            source=sources[source],
        )
        for plan, whole, present, source in rows
    ]


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """The options of this script."""
    open_roads = [name for name, scenario in SCENARIOS.items() if not (scenario.lanes or scenario.roads)]
    parser = make_parser("Search for a best-known front.")
    add = parser.add_argument
    add("--scenario", choices=open_roads, default="one_waypoint", help="(default: %(default)s)")
    add("--action-type", choices=get_args(ActionType), default="discrete", help="(default: %(default)s)")
    add("--decisions", type=int, default=300_000_000, metavar="N", help="to simulate (default: %(default)s)")
    add("--seed", type=int, default=0, metavar="S", help="of the search (default: %(default)s)")
    add("--anew", action="store_true", help="do not start from the shipped front")
    add("--from", dest="runs", nargs="+", default=[], metavar="RUN", help="also start from the policies of these runs")
    add("--episodes", type=int, default=8, metavar="N", help="sampled, of each policy of a run (default: %(default)s)")
    add("--output", type=Path, metavar="FILE", help="write to FILE instead of replacing the shipped front")
    TRUST.add_to(parser)
    options = parser.parse_args(arguments)
    check_least(parser, options, 0, "decisions", "seed", "episodes")
    check_folder(parser, options.output)
    return options


def main(arguments: list[str]) -> int:
    """Run the command line ``arguments``; the exit code."""
    options = vars(parse_arguments(arguments))
    runs, output, trust = options.pop("runs"), options.pop("output"), options.pop("trust")
    settings = FrontSearchSettings(**options)
    shipped = shipped_front_file(settings.scenario, settings.action_type)
    from scripts.bounds.trained_runs import record_run  # not earlier: it imports torch

    try:
        recordings = [
            record_run(run, settings.scenario, settings.action_type, settings.episodes, trust=trust) for run in runs
        ]
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("searching", total=settings.decisions)
        found = improve_front(settings, shipped, recordings, lambda done: progress.update(task, completed=done))

    console = Console(width=120)
    table = Table("gamma", "policies before", "after", "hypervolume before", "after", "change")
    for criterion, sizes, (before, after) in zip(CRITERIA, found.sizes, found.hypervolumes, strict=True):
        change = f"{after / before - 1.0:+.3%}" if before else "-"
        table.add_row(str(criterion), *map(str, sizes), f"{before:.6g}", f"{after:.6g}", change)
    console.print(table)
    if output is None and found.loses_hypervolume:
        console.print("The shipped front is larger; nothing is written.")
        return 0
    size = found.write(output or shipped)
    console.print(f"{len(found.policies)} policies written to {output or shipped} ({size / 1000:.0f} kB)")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
