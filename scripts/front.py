"""Search for a best-known front: policies of one scenario, the same in every episode, that no known policy dominates.

    python scripts/front.py --scenario one_waypoint --action-type discrete --decisions 300000000 --seed 0
    python scripts/front.py --scenario static_obstacle --from RUN RUN ...

An evolutionary search over action sequences (`scripts.bounds`) that starts from the shipped front, from the
policies of trained runs and from random driving rules. Every sequence is evaluated in the simulation. The policies
that make up most of the hypervolume replace the shipped front, unless that would make its hypervolume smaller. The
same arguments, runs and shipped front give the same front.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from result_file import check_folder, check_least
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from algorithms.runs.cli import TRUST, make_parser
from mo_deepdrive.world.config import ActionType
from mo_deepdrive.world.scenarios import SCENARIOS
from scripts.bounds.front_improvement import FrontSearchSettings, improve_front, shipped_front_file
from scripts.bounds.plans import CRITERIA

if TYPE_CHECKING:
    import argparse


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
