"""LeftTurn's best-known front: which fixed rules and learnt policies no other of them dominates.

    python scripts/left_turn_front.py --output docs/results/left_turn_front.csv
    python scripts/left_turn_front.py runs/left_turn/* --episodes 200 --split validation

Without runs, the policies of the zoo. All drive the same episodes; the file has the mean undiscounted returns of each
with their 95% intervals.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from algorithms.experiments.cli import add_trust_argument, check_file, make_parser
from algorithms.experiments.run_directory import Run
from algorithms.planning.left_turn_front import JointFront, drive_rules, drive_run
from algorithms.reporting.wide_tables import print_rows
from mo_deepdrive.evaluation.splits import SPLITS, describe_episodes, first_seed

if TYPE_CHECKING:
    import argparse

ZOO = ("left_turn_linear-ppo", "left_turn_linear-mo_ppo", "left_turn_front-conditioned_mo_ppo")
GAPS = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 5.5, 6.0, 7.0, 8.0)


def parse_arguments(arguments: list[str] | None) -> argparse.Namespace:
    """The options of this script."""
    parser = make_parser(__doc__)
    parser.add_argument("runs", nargs="*", default=ZOO, metavar="RUN", help="run directories or names in the zoo")
    parser.add_argument("--gaps", type=float, nargs="+", default=GAPS, metavar="S", help="gaps of the rules in s")
    parser.add_argument("--episodes", type=int, default=2000, metavar="N", help="per driver (default: %(default)s)")
    parser.add_argument("--split", choices=SPLITS, default="test", help="scenario seeds (default: %(default)s)")
    parser.add_argument("--output", type=Path, metavar="FILE", help="CSV with a row per driver")
    add_trust_argument(parser)
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line ``arguments``, those of the process if None, and return the exit code."""
    options = parse_arguments(arguments)
    try:
        if options.output is not None:
            check_file("--output", options.output)
        runs = [Run.open(path, device="cpu", trust=options.trust) for path in options.runs]
        drivers = drive_rules(options.gaps, episodes=options.episodes, split=options.split)
        for run in runs:
            drivers += drive_run(run, episodes=options.episodes, split=options.split)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    seed = first_seed(options.split, None, options.episodes)
    front = JointFront.of(drivers, seed)
    if options.output is not None:
        front.write(options.output)
    print_rows(Console(), front.summary(), f"LeftTurn: {describe_episodes(options.episodes, seed)}", 1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
