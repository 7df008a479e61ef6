"""Cross-play at the intersection: every driver of vehicle 0 with every driver of vehicle 1.

    python scripts/cross_play.py intersection_linear-mo_ppo intersection_linear-ppo --output cross_play
    python scripts/cross_play.py runs/a runs/b --vehicle-0 rule:gap_8 --vehicle-1 rule:straight_6 --output cross_play

A driver is a run or a policy of the zoo, which drives the vehicles that it learnt to drive; or a rule for one of them:
rule:gap_3 turns left and waits for a gap of 3 s, rule:straight_6 drives straight on at 6 m/s, rule:yields_6 also brakes
for a vehicle in front of it, each with any number. The folder gets cross_play.csv and cross_play.png.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from algorithms.driving.intersection_rules import SCENARIO
from algorithms.experiments.build import open_driver
from algorithms.experiments.cli import add_trust_argument, check_directory, make_parser
from algorithms.experiments.console import make_console
from algorithms.experiments.run_directory import Run
from algorithms.reporting.cross_play_report import plot_encounters, summary_rows, write_encounters
from algorithms.reporting.wide_tables import print_rows
from mo_deepdrive.evaluation.cross_play import ROLES, cross_play
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.metrics import vehicle_name
from mo_deepdrive.evaluation.splits import SPLITS, describe_episodes

if TYPE_CHECKING:
    import argparse

    from mo_deepdrive.evaluation.policy import Policy


def parse_arguments(arguments: list[str] | None) -> argparse.Namespace:
    """The options of this script."""
    parser = make_parser(__doc__)
    parser.add_argument("runs", nargs="*", metavar="RUN", help="drivers of every vehicle that they learnt to drive")
    for v in range(ROLES):
        parser.add_argument(
            f"--vehicle-{v}", nargs="+", default=[], metavar="DRIVER", help=f"drivers of vehicle {v} alone"
        )
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder of the table and the picture")
    parser.add_argument("--episodes", type=int, default=200, metavar="N", help="per pair (default: %(default)s)")
    parser.add_argument("--split", choices=SPLITS, default="test", help="scenario seeds (default: %(default)s)")
    parser.add_argument(
        "--utility", default="intersection_linear", metavar="NAME", help="of both (default: %(default)s)"
    )
    parser.add_argument("--greedy", action="store_true", help="the most likely actions instead of sampled ones")
    add_trust_argument(parser)
    return parser.parse_args(arguments)


def open_drivers(options: argparse.Namespace) -> list[dict[str, Policy]]:
    """The drivers of each vehicle by name; the folder that all runs are in is left out of the names.

    Raises:
        ValueError: for a driver that does not exist or cannot drive, or a vehicle without drivers.
    """
    env = EnvAdapter(make_env(SCENARIO.id, 1))
    opened_runs = {name: Run.open(name, trust=options.trust) for name in options.runs}
    learnt = {name: set(run.experiment.training.partners) for name, run in opened_runs.items()}
    found = []
    every = [*options.runs, *(name for v in range(ROLES) for name in getattr(options, vehicle_name(v)))]
    runs = [Path(name).absolute() for name in every if Path(name).is_dir()]
    shared = os.path.commonpath([run.parent for run in runs]) if runs else ""
    for v in range(ROLES):
        names = [name for name in options.runs if vehicle_name(v) not in learnt[name]]
        names += getattr(options, vehicle_name(v))
        if not names:
            raise ValueError(f"{vehicle_name(v)} has no driver")
        opened = {}
        for name in names:
            shown = os.path.relpath(name, shared) if Path(name).is_dir() else name
            if shown in opened:
                raise ValueError(f"{vehicle_name(v)} has two drivers {shown!r}; the second is {name!r}")
            if not shown.isprintable():
                raise ValueError(f"driver {shown!r} has characters in its name that cannot be printed")
            opened[shown] = open_driver(name, v, env, "discrete", trust=options.trust)
        found.append(opened)
    return found


def main(arguments: list[str] | None = None) -> int:
    """Run the command line ``arguments``, those of the process if None, and return the exit code."""
    options = parse_arguments(arguments)
    console = make_console()
    try:
        check_directory("--output", options.output)
        drivers = open_drivers(options)
        pairs = len(drivers[0]) * len(drivers[1])
        with console.status("") as status:
            done = 0

            def progress() -> None:
                nonlocal done
                done += 1
                status.update(f"{done} of {pairs} pairs")

            encounters = cross_play(
                drivers,
                SCENARIO.id,
                utility=options.utility,
                split=options.split,
                episodes=options.episodes,
                greedy=options.greedy,
                progress=progress,
            )
        options.output.mkdir(parents=True, exist_ok=True)
        episodes = describe_episodes(options.episodes, SPLITS[options.split].start)
        kind = "greedy" if options.greedy else "sampled"
        note = f"{episodes} per pair, {kind} actions, utility {options.utility}"
        write_encounters(options.output / "cross_play.csv", encounters)
        plot_encounters(options.output / "cross_play.png", encounters, note)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for v in range(ROLES):
        print_rows(Console(), summary_rows(encounters, v), f"{vehicle_name(v)} with those that it met: {note}", 1)
    print(f"written: {options.output / 'cross_play.csv'}, {options.output / 'cross_play.png'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
