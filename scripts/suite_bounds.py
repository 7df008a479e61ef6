"""The floors and ceilings of the suite, computed anew.

    python scripts/suite_bounds.py plan K1 --scenarios 200

``plan`` searches for the best drives in scenarios of the test split and writes them into the package.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from result_file import check_least
from rich.console import Console
from rich.progress import track

from algorithms.experiments.cli import make_parser
from algorithms.planning.suite_plans import plan_file, plan_task, with_spare_preferences, worth_driving, write_plans
from mo_deepdrive import suite
from mo_deepdrive.evaluation.splits import SPLITS

if TYPE_CHECKING:
    import argparse


def parse_arguments(arguments: list[str] | None) -> argparse.Namespace:
    """The options of this script."""
    parser = make_parser(__doc__)
    parser.add_argument("what", choices=("plan",))
    parser.add_argument("task", choices=suite.load().tasks)
    parser.add_argument("--scenarios", type=int, default=200, help="of the test split (default: %(default)s)")
    parser.add_argument("--generations", type=int, default=20, help="of a search (default: %(default)s)")
    parser.add_argument("--from", dest="start", metavar="TASK", help="start from the plans of another task")
    options = parser.parse_args(arguments)
    check_least(parser, options, 1, "scenarios", "generations")
    return options


def main(arguments: list[str] | None = None) -> int:
    """Run the command line ``arguments``; those of the process if None."""
    options = parse_arguments(arguments)
    task = suite.load().task(options.task)
    seeds = SPLITS["test"][: options.scenarios]
    drawn = with_spare_preferences(task)
    progress = track(seeds, "planning", console=Console(stderr=True))
    texts, values = plan_task(drawn, progress, options.generations, options.start)
    if task.preferences is not None:
        kept, left_out = worth_driving(task, values.mean(axis=0))
        texts, values = [[each[k] for k in kept.tolist()] for each in texts], values[:, kept]
        print(f"preferences.left_out: {left_out}")
    write_plans(plan_file(options.task), task, texts)
    print(f"{options.task}: {values.mean():.4f} over {len(values)} scenarios")
    return 0


if __name__ == "__main__":
    sys.exit(main())
