"""Search for a best-known front: policies of one scenario, the same in every episode, that no known policy dominates.

    python scripts/bounds/front.py --scenario one_waypoint --action-type discrete --decisions 300000000 --seed 0
    python scripts/bounds/front.py --scenario static_obstacle --from RUN RUN ...

An evolutionary search over action sequences that starts from the shipped front, from the policies of trained runs and
from random driving rules. Every sequence is evaluated in the simulation. The policies that make up most of the
hypervolume replace the shipped front, unless that would make its hypervolume smaller. The same arguments, runs and
shipped front give the same front.

The algorithm is in the manner of epsilon-MOEA (Deb, Mohan and Mishra 2005): parents are drawn from an archive and,
mostly, from the plans that would make up the front; offspring enter the archive if no other plan epsilon-dominates
them. Random driving rules make the first generations and take over from some of the offspring later. The archive keeps
one plan of every box of the objective space that no other box dominates (Laumanns et al. 2002, "Combining convergence
and diversity in evolutionary multiobjective optimization"), which bounds it and spreads it over the front. The front is
selected by hypervolume contribution (Guerreiro, Fonseca and Paquete 2016, "Greedy hypervolume subset selection in low
dimensions") with lazy updates: a contribution can only shrink as others are selected (Minoux 1978).
"""

from __future__ import annotations

import heapq
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, get_args

import moocore
import numpy as np
import torch
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from algorithms.agent import FrontAgent
from algorithms.runs import cli
from algorithms.runs.build import build
from algorithms.runs.config import find_environment
from algorithms.runs.run_directory import Run
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.policy import drive
from mo_deepdrive.fronts.reference_fronts import DATA, GAMMA, KnownPolicy, front_config, reference_point
from mo_deepdrive.fronts.reference_fronts import read as read_front
from mo_deepdrive.fronts.reference_fronts import write as format_front
from mo_deepdrive.support.atomic_io import atomic_write
from mo_deepdrive.world.action_sequences import decode as decode_actions
from mo_deepdrive.world.action_sequences import encode as encode_actions
from mo_deepdrive.world.config import ActionType
from mo_deepdrive.world.objectives import scales
from mo_deepdrive.world.scenarios import SCENARIOS
from scripts.bounds.plans import CRITERIA, Criterion, EvaluatedPlans, PlanEvaluator, random_calm_rules

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.policy import Policy

POPULATION = 4096  # plans per generation
RULE_GENERATIONS = 5  # first generations, of rules only
TAKEOVER_RATE = 0.1  # share of the offspring that a rule takes over
FRONT_RATE = 0.8  # share of the parents that are drawn from the front
FRONT_GENERATIONS = 50  # until the front is selected again
# Long episodes cost time: above SHORT_EPISODE decisions a plan becomes a parent in inverse proportion to its length,
# but at least with probability LEAST_PARENT_RATE.
SHORT_EPISODE = 60
LEAST_PARENT_RATE = 0.2
UNKNOWN_SOURCE = -1
EPSILON = 0.005  # edge of a box, as a share of each objective's nominal scale
# For each of CRITERIA, the most plans that are selected for it and those after it.
FRONT_SIZES = (350, 150, 100)


class FrontSearch:
    """A search for the front of one scenario and action set.

    Attributes:
        references: the reference point (d,) of hypervolumes for each of CRITERIA.
        archive: the plans that are kept; at first one that idles, of UNKNOWN_SOURCE.
        front: those of them that made up the front when it was last selected.
    """

    def __init__(self, scenario: str, action_type: str, seed: int):
        self.objectives = [criterion.objectives(scenario) for criterion in CRITERIA]
        self.references = [
            reference_point(scenario, action_type, criterion.gamma, names).values
            for criterion, names in zip(CRITERIA, self.objectives, strict=True)
        ]
        self.evaluator = PlanEvaluator(front_config(scenario, action_type))
        self.rng = np.random.default_rng(seed)
        self.generations = 0
        self.archive = self.evaluator.evaluate(self.evaluator.format.idle_plans(1), UNKNOWN_SOURCE)
        self.front = self.archive

    def add(self, evaluated: EvaluatedPlans) -> None:
        """Update the archive with plans."""
        candidates = self.archive.append(evaluated)
        self.archive = candidates.take(epsilon_nondominated(candidates, self.objectives))

    def evolve(self, source: int) -> None:
        """Make and evaluate one generation of plans and update the archive; ``source`` is the index of their source."""
        plan_format = self.evaluator.format
        rules = random_calm_rules(POPULATION, self.rng)
        if self.generations < RULE_GENERATIONS:
            plans = plan_format.idle_plans(POPULATION)
        else:
            if (self.generations - RULE_GENERATIONS) % FRONT_GENERATIONS == 0:
                self.front = self.select_front()
            candidates = self.archive.append(self.front)
            parents, mates = self._select_parents(candidates), self._select_parents(candidates)
            n = min(len(parents), len(mates))
            parents, mates, rules = parents[:n], mates[:n], rules[:n]
            plans = self.evaluator.offspring(candidates.plans, candidates.lengths, parents, mates, self.rng)
            lengths = candidates.lengths[parents]
            rules["first_decision"] = self.evaluator.takeovers(lengths, TAKEOVER_RATE, self.rng)
        self.generations += 1
        self.add(self.evaluator.evaluate(plans, source, rules))

    def _select_parents(self, candidates: EvaluatedPlans) -> NDArray[np.int64]:
        """Random rows of archive and front, at most POPULATION; plans of long episodes are selected less often."""
        archived = len(self.archive.lengths)
        from_front = self.rng.random(POPULATION) < FRONT_RATE
        first, last = np.where(from_front, archived, 0), np.where(from_front, len(candidates.lengths), archived)
        rows = self.rng.integers(first, last)
        rates = np.maximum(SHORT_EPISODE / candidates.lengths[rows], LEAST_PARENT_RATE)
        return rows[self.rng.random(POPULATION) < rates]

    def select_front(self, also: EvaluatedPlans | None = None) -> EvaluatedPlans:
        """The plans that make up the front, of those in the archive, on the front of before, and ``also``."""
        # The archive keeps one plan per box, and may have dropped one that adds more hypervolume.
        candidates = self.archive.append(self.front)
        return select_front(candidates if also is None else candidates.append(also), self.references)

    def hypervolumes(self, evaluated: EvaluatedPlans) -> list[float]:
        """The hypervolume of plans for each of CRITERIA."""
        return [dominated_volume(*each) for each in zip(evaluated.returns, self.references, strict=True)]


def epsilon_nondominated(evaluated: EvaluatedPlans, objectives: Sequence[tuple[str, ...]]) -> NDArray[np.int64]:
    """Sorted rows of the plans that the archive keeps, by the names of the objectives for each of CRITERIA.

    For each of CRITERIA, one plan of every box of returns that no other box dominates. In a box the greatest sum of
    scaled returns wins, then the shortest episode.
    """
    kept = []
    for returns, names in zip(evaluated.returns, objectives, strict=True):
        scaled = returns / scales(names)
        boxes = np.floor(scaled / EPSILON)
        order = np.lexsort((evaluated.lengths, -scaled.sum(axis=1)))
        _, best = np.unique(boxes[order], axis=0, return_index=True)
        rows = order[best]
        kept.append(rows[moocore.is_nondominated(boxes[rows], maximise=True)])
    return np.unique(np.concatenate(kept))


def dominated_volume(returns: NDArray[Any], reference: NDArray[Any]) -> float:
    """The hypervolume of ``returns`` (n, d) above ``reference`` (d,), maximised; 0 where no return dominates it."""
    return float(moocore.hypervolume(returns, ref=reference, maximise=True))


def greedy_hypervolume_subset(returns: NDArray[Any], reference: NDArray[Any], size: int) -> list[int]:
    """At most ``size`` rows of ``returns`` (n, d), each the one that adds most hypervolume to those before it."""
    selected: list[int] = []
    volume = 0.0
    # Minus the contribution, the row, and how many rows were selected when the contribution was computed.
    queue = [(-dominated_volume(returns[[row]], reference), row, 0) for row in range(len(returns))]
    heapq.heapify(queue)
    while queue and len(selected) < size:
        loss, row, selected_then = heapq.heappop(queue)
        if loss >= 0.0:
            break
        if selected_then == len(selected):
            selected.append(row)
            volume -= loss
        else:
            loss = volume - dominated_volume(returns[[*selected, row]], reference)
            heapq.heappush(queue, (loss, row, len(selected)))
    return selected


def select_front(evaluated: EvaluatedPlans, references: Sequence[NDArray[Any]]) -> EvaluatedPlans:
    """The plans of a front, the greatest discounted return of the first objective first.

    For each of CRITERIA, from the last to the first: the best plan of each objective, then those that add most
    hypervolume. Only plans that dominate the reference points of all CRITERIA are selected.
    """
    pairs = zip(evaluated.returns, references, strict=True)
    dominating = [(returns >= reference).all(axis=1) for returns, reference in pairs]
    evaluated = evaluated.take(np.flatnonzero(np.all(dominating, axis=0)))
    rows: set[int] = set()
    for returns, reference, size in zip(evaluated.returns[::-1], references[::-1], FRONT_SIZES[::-1], strict=True):
        front = np.flatnonzero(moocore.is_nondominated(returns, maximise=True))
        rows |= set(front[returns[front].argmax(axis=0)].tolist())
        for row in front[greedy_hypervolume_subset(returns[front], reference, size)].tolist():
            if len(rows) < size:
                rows.add(row)
    selected = evaluated.take(np.array(sorted(rows)))
    return selected.take(np.lexsort(selected.returns[0].T[::-1])[::-1])


class RunRecording(NamedTuple):
    """What the policies of a run do in the scenario of a front."""

    name: str
    source: str  # the run as that of a policy of a front
    sequences: list[NDArray[Any]]  # (t,) or (t, 3) environment actions per episode


def record_run(path: str, scenario: str, action_type: str, episodes: int, *, trust: bool = False) -> RunRecording:
    """Record one greedy episode and then ``episodes`` sampled ones of the policy of a run, or of all of its front."""
    run = Run.open(path, trust=trust)
    settings = run.experiment.environment
    for name, expected, found in (
        ("scenario", scenario, find_environment(settings.id).kwargs.get("scenario")),
        ("action_type", action_type, settings.arguments.get("action_type", "discrete")),
    ):
        if found != expected:
            raise ValueError(f"run {path!r} has {name} = {found!r}; the front needs {expected!r}")
    agent = build(run.experiment, num_envs=1, guides=False)
    agent.load(run.checkpoint, policy_only=True)
    # The fixed scenario of the front, with the rewards that the run was trained on.
    arguments: dict[str, Any] = front_config(scenario, action_type).model_dump(mode="json", exclude={"scenario"})
    arguments |= {name: settings.arguments[name] for name in ("objectives", "cost_sign") if name in settings.arguments}
    sequences = []
    generator = torch.Generator(agent.device).manual_seed(0)
    for repeats, random in ((1, None), (episodes, generator)) if episodes else ((1, None),):
        policy: Policy = agent
        num_envs = repeats
        if isinstance(agent, FrontAgent):
            conditions = np.repeat(agent.conditions(), repeats, axis=0)
            policy, num_envs = agent.policies(conditions), len(conditions)
        sequences += record_episodes(policy, EnvAdapter(make_env(settings.id, num_envs, arguments)), random)
    name, training = "/".join(run.path.absolute().parts[-3:]), run.experiment.training
    learner = f"{run.experiment.algorithm.name}, seed {training.seed}, {training.total_timesteps} steps"
    return RunRecording(name, f"run {name}: {learner}", sequences)


def record_episodes(policy: Policy, env: EnvAdapter, generator: torch.Generator | None) -> list[NDArray[Any]]:
    """The actions, (t,) or (t, 3) as the environment takes them, of the first episode of each of ``env``'s copies."""
    taken: list[NDArray[Any]] = []
    lengths = np.zeros(env.num_envs, dtype=np.int64)
    for actions, _, counted, _ in drive(policy, env, env.reset(0), generator):
        taken.append(env.environment_actions(actions))
        lengths += counted[:, 0]
    return [np.stack(taken)[:length, row] for row, length in enumerate(lengths)]


@dataclass(frozen=True)
class FrontSearchSettings:
    """Settings of a search, as on the command line; the last generation may exceed the decisions."""

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
    """The front that a search found; sizes and hypervolumes before and after, for each of CRITERIA."""

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
    return Path(str(DATA / f"front_{scenario}_{action_type}.json"))


def improve_front(
    settings: FrontSearchSettings,
    shipped: Path,
    recordings: Sequence[RunRecording] = (),
    on_progress: Callable[[int], None] = lambda _: None,
) -> FrontImprovement:
    """Search for a better front than the ``shipped`` one; its file may be missing. Progress is in decisions."""
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
    volumes = list(zip(search.hypervolumes(before), search.hypervolumes(after), strict=True))
    sizes = list(zip(_nondominated_counts(before), _nondominated_counts(after), strict=True))
    return FrontImprovement(settings, _known_policies(search, after, sources), sizes, volumes)


def _nondominated_counts(evaluated: EvaluatedPlans) -> list[int]:
    """How many plans no other dominates, for each of CRITERIA."""
    return [int(moocore.is_nondominated(returns, maximise=True).sum()) for returns in evaluated.returns]


def _known_policies(search: FrontSearch, evaluated: EvaluatedPlans, sources: Sequence[str]) -> list[KnownPolicy]:
    """The plans as the policies of a front's file."""
    undiscounted, discounted = (
        np.round(evaluated.returns[CRITERIA.index(Criterion(gamma))], 6).tolist() for gamma in (1.0, GAMMA)
    )
    actions = [encode_actions(search.evaluator.format.to_sequence(plan)) for plan in evaluated.plans]
    rows = zip(actions, map(tuple, undiscounted), map(tuple, discounted), evaluated.sources, strict=True)
    return [KnownPolicy(text, whole, present, sources[source]) for text, whole, present, source in rows]


def run_search(options: argparse.Namespace) -> int:
    """Search for a better front, print what it gained, and write it."""
    cli.check_at_least(options, 0, "decisions", "seed", "episodes")
    cli.check_file("--output", options.output)
    values = vars(options)
    settings = FrontSearchSettings(**{field.name: values[field.name] for field in fields(FrontSearchSettings)})
    shipped = shipped_front_file(settings.scenario, settings.action_type)
    scene = settings.scenario, settings.action_type, settings.episodes
    recordings = [record_run(run, *scene, trust=options.trust) for run in options.runs]
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("searching", total=settings.decisions)
        found = improve_front(settings, shipped, recordings, lambda done: progress.update(task, completed=done))

    console = Console(width=120)
    table = Table("gamma", "policies before", "after", "hypervolume before", "after", "change")
    for criterion, sizes, (before, after) in zip(CRITERIA, found.sizes, found.hypervolumes, strict=True):
        change = f"{after / before - 1.0:+.3%}" if before else "-"
        table.add_row(str(criterion), *map(str, sizes), f"{before:.6g}", f"{after:.6g}", change)
    console.print(table)
    if options.output is None and found.loses_hypervolume:
        console.print("The shipped front is larger; nothing is written.")
        return 0
    file = options.output or shipped
    size = found.write(file)
    console.print(f"{len(found.policies)} policies written to {file} ({size / 1000:.0f} kB)")
    return 0


OPEN_ROADS = [name for name, scenario in SCENARIOS.items() if not (scenario.lanes or scenario.roads)]
OPTIONS = (
    cli.option("--scenario", None, "(default: %(default)s)", choices=OPEN_ROADS, default="one_waypoint"),
    cli.option("--action-type", None, "(default: %(default)s)", choices=get_args(ActionType), default="discrete"),
    cli.option("--decisions", "N", "to simulate (default: %(default)s)", type=int, default=300_000_000),
    cli.option("--seed", "S", "of the search (default: %(default)s)", type=int, default=0),
    cli.flag("--anew", "do not start from the shipped front"),
    cli.option("--from", "RUN", "also start from the policies of these runs", dest="runs", nargs="+", default=[]),
    cli.option("--episodes", "N", "sampled, of each policy of a run (default: %(default)s)", type=int, default=8),
    cli.option("--output", "FILE", "write to FILE instead of replacing the shipped front", type=Path),
    cli.TRUST,
)
main = cli.Command("", __doc__, OPTIONS, run_search)

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
