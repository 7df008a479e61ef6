r"""Cross-play: every driver of vehicle 0 with every driver of the other vehicle, or of all others.

    python scripts/cross_play.py intersection_linear-mo_ppo intersection_linear-ppo --output cross_play
    python scripts/cross_play.py runs/a runs/b --vehicle-0 rule:gap_8 --vehicle-1 rule:straight_6 --output cross_play
    python scripts/cross_play.py runs/a --env mo-deepdrive-roundabout-v0 --vehicles 8 --others rule:drawn_{0..19} ...

A driver is a run or a policy of the zoo, which drives the vehicles that it learnt to drive; or a rule. At the
intersection rule:gap_3 turns left and waits for a gap of 3 s, rule:straight_6 drives straight on at 6 m/s,
rule:yields_6 also brakes for a vehicle in front of it, each with any number. In a roundabout rule:hurried,
rule:balanced and rule:careful drive any vehicle, rule:enters_3 enters with a gap of 3 s, rule:drawn_7 is the seventh of
the drawn ones that no learner trains with. The folder gets cross_play.csv and cross_play.png.

    python scripts/cross_play.py RUN --env mo-deepdrive-roundabout-v0 --vehicles 8 --preference hurried time=5 \
      --preference balanced --preference careful near_miss=5 jerk=5 --show vehicle_0/utility_esr --output matrix

RUN of conditioned MO-PPO is one driver for every preference: linear weights in units of its objective_scales, 1 for
objectives that are not named. Each meets every other one.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console

from algorithms import ConditionedMOPPO
from algorithms.reporting.cross_play_report import matrix_rows, plot_encounters, summary_rows, write_encounters
from algorithms.reporting.tables import print_rows
from algorithms.runs.build import load_policy, open_driver
from algorithms.runs.cli import TRUST, check_directory, make_parser, named_numbers
from algorithms.runs.config import find_environment, is_ours
from algorithms.runs.console import make_console
from algorithms.runs.run_directory import Run
from mo_deepdrive.evaluation.cross_play import cross_play, roles_of
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.metrics import vehicle_name
from mo_deepdrive.evaluation.splits import SPLITS, describe_episodes
from mo_deepdrive.utilities import make_utility
from mo_deepdrive.world.scenarios import SCENARIOS

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

    from mo_deepdrive.evaluation.policy import Policy


OWN = "own"
UTILITY_HELP = f"of all (default: the linear one of the scenario); {OWN!r} for the preference of each"


def parse_arguments(arguments: list[str] | None) -> argparse.Namespace:
    """The options of this script."""
    parser = make_parser(__doc__)
    parser.add_argument("runs", nargs="*", metavar="RUN", help="drivers of every vehicle that they learnt to drive")
    parser.add_argument("--vehicle-0", nargs="+", default=[], metavar="DRIVER", help="drivers of vehicle 0 alone")
    help_text = "drivers of vehicle 1 alone, or of all vehicles but 0"
    parser.add_argument("--vehicle-1", "--others", nargs="+", default=[], metavar="DRIVER", help=help_text)
    help_text = "environment of several vehicles (default: %(default)s)"
    parser.add_argument("--env", default=SCENARIOS["intersection"].id, metavar="ID", help=help_text)
    parser.add_argument("--vehicles", type=int, metavar="V", help="argument of the environment")
    help_text = "a driver of each RUN of conditioned MO-PPO: its name, and weights"
    parser.add_argument("--preference", nargs="+", action="append", default=[], metavar="NAME", help=help_text)
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder of the table and the picture")
    parser.add_argument("--episodes", type=int, default=200, metavar="N", help="per pair (default: %(default)s)")
    parser.add_argument("--split", choices=SPLITS, default="test", help="scenario seeds (default: %(default)s)")
    parser.add_argument("--utility", metavar="NAME", help=UTILITY_HELP)
    parser.add_argument(
        "--show", nargs="+", default=[], metavar="SCORE", help="print the matrix of a column of the CSV"
    )
    parser.add_argument("--greedy", action="store_true", help="the most likely actions instead of sampled ones")
    TRUST.add_to(parser)
    return parser.parse_args(arguments)


def open_env(options: argparse.Namespace) -> EnvAdapter:
    """The environment in which they meet."""
    if not is_ours(find_environment(options.env, "--env")):
        raise ValueError(f"--env = {options.env!r}: only this package's environments have several vehicles")
    env = EnvAdapter(make_env(options.env, 1, arguments_of(options)))
    if env.vehicles == 1:
        raise ValueError(f"--env {options.env} has one vehicle; cross-play needs several")
    return env


def arguments_of(options: argparse.Namespace) -> dict[str, int]:
    """The arguments of the environment."""
    return {} if options.vehicles is None else {"vehicles": options.vehicles}


def open_drivers(options: argparse.Namespace, env: EnvAdapter) -> list[dict[str, Policy]]:
    """The drivers of each role by name; the folder that all runs are in is left out of the names."""
    opened_runs = {name: Run.open(name, trust=options.trust) for name in options.runs}
    learnt = {name: set(run.experiment.training.partners) for name, run in opened_runs.items()}
    given = [options.vehicle_0, options.vehicle_1]
    runs = [Path(name).absolute() for name in (*options.runs, *given[0], *given[1]) if Path(name).is_dir()]
    shared = os.path.commonpath([run.parent for run in runs]) if runs else ""
    found = []
    for role, own, seats in zip(roles_of(env.vehicles), given, ([0], range(1, env.vehicles)), strict=True):
        names = [name for name in options.runs if not learnt[name] & {vehicle_name(v) for v in seats}]
        names += own
        if not names:
            raise ValueError(f"{role} has no driver")
        opened: dict[str, Policy] = {}
        for name in names:
            shown = os.path.relpath(name, shared) if Path(name).is_dir() else name
            if shown in opened:
                raise ValueError(f"{role} has two drivers {shown!r}; the second is {name!r}")
            if not shown.isprintable():
                raise ValueError(f"driver {shown!r} has characters in its name that cannot be printed")
            if options.preference and name in opened_runs and not opened_runs[name].experiment.known_utility:
                opened |= conditioned_drivers(opened_runs[name], options)
                continue
            for v in seats:
                opened[shown] = open_driver(name, v, env, "discrete", trust=options.trust)
        found.append(opened)
    return found


def conditioned_drivers(run: Run, options: argparse.Namespace) -> dict[str, Policy]:
    """The drivers of a run of conditioned MO-PPO by the names of their preferences."""
    agent = load_policy(run)
    if not isinstance(agent, ConditionedMOPPO):
        raise ValueError(f"{run.path} has no preferences; --preference needs a run of conditioned MO-PPO")
    found: dict[str, Policy] = {}
    for name, weights in weights_of(options, agent.env.objectives).items():
        row = agent.preferences.condition("linear", weights)
        policy = agent.policy(np.tile(row, agent.env.vehicles))
        found[name] = policy
    return found


def weights_of(options: argparse.Namespace, objectives: Sequence[str]) -> dict[str, dict[str, float]]:
    """The weights of every objective by the name of the preference."""
    return {
        name: dict.fromkeys(objectives, 1.0) | named_numbers(f"--preference {name}", pairs, objectives)
        for name, *pairs in options.preference
    }


def utilities_of(options: argparse.Namespace, env: EnvAdapter, drivers: list[dict[str, Policy]]) -> Any:
    """The utility by which all are judged, or by name those of the preferences."""
    made: Any = env.vector_env.unwrapped
    if options.utility != OWN:
        return options.utility or f"{made.config.scenario}_linear"
    found = {}
    for name, weights in weights_of(options, env.objectives).items():
        policy: Any = (drivers[0] | drivers[1]).get(name)
        if policy is not None:
            scaled = np.array([weights[each] for each in env.objectives]) / policy.agent.scales
            found[name] = make_utility("linear", env.objectives, weights=(scaled / sum(weights.values())).tolist())
    for name in (*drivers[0], *drivers[1]):
        if name not in found:
            raise ValueError(f"--utility {OWN}: {name!r} has no preference")
    return found


def main(arguments: list[str] | None = None) -> int:
    """Run the command line ``arguments``, those of the process if None, and return the exit code."""
    options = parse_arguments(arguments)
    console = make_console()
    try:
        check_directory("--output", options.output)
        env = open_env(options)
        drivers = open_drivers(options, env)
        utility = utilities_of(options, env, drivers)
        pairs = len(drivers[0]) * len(drivers[1])
        with console.status("") as status:
            done = 0

            def progress() -> None:
                nonlocal done
                done += 1
                status.update(f"{done} of {pairs} pairs")

            encounters = cross_play(
                drivers,
                options.env,
                utility=utility,
                env_kwargs=arguments_of(options),
                split=options.split,
                episodes=options.episodes,
                greedy=options.greedy,
                progress=progress,
            )
        options.output.mkdir(parents=True, exist_ok=True)
        episodes = describe_episodes(options.episodes, SPLITS[options.split].start)
        kind = "greedy" if options.greedy else "sampled"
        name = OWN if isinstance(utility, dict) else utility
        note = f"{episodes} per pair, {kind} actions, utility {name}"
        write_encounters(options.output / "cross_play.csv", encounters)
        plot_encounters(options.output / "cross_play.png", encounters, note)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for k, role in enumerate(encounters[0].roles):
        print_rows(Console(), summary_rows(encounters, k), f"{role} with those that it met: {note}", 1)
    for score in options.show:
        print_rows(Console(), matrix_rows(encounters, score), "", 1)
    print(f"written: {options.output / 'cross_play.csv'}, {options.output / 'cross_play.png'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
