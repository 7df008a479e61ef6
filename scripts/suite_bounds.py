"""The floors and ceilings of the suite, computed anew.

python scripts/suite_bounds.py plan K1 --scenarios 128           # search for drives, and write them into the package
python scripts/suite_bounds.py floor K1 K3
python scripts/suite_bounds.py ceiling K1 K5

What is printed belongs into mo_deepdrive/data/suite.yaml.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from result_file import check_least
from rich.console import Console
from rich.progress import track

from algorithms.experiments.cli import make_parser
from algorithms.planning.suite_bounds import ceiling, floor
from algorithms.planning.suite_plans import (
    HORIZON,
    plan_file,
    plan_task,
    with_spare_preferences,
    worth_driving,
    write_plans,
)
from mo_deepdrive import suite
from mo_deepdrive.evaluation.splits import SPLITS

if TYPE_CHECKING:
    import argparse


def parse_arguments(arguments: list[str] | None) -> argparse.Namespace:
    """The options of this script."""
    parser = make_parser(__doc__)
    parser.add_argument("what", choices=("plan", "floor", "ceiling"))
    parser.add_argument("tasks", nargs="+", choices=suite.load().tasks, metavar="TASK")
    parser.add_argument("--scenarios", type=int, default=128, help="of the test split (default: %(default)s)")
    parser.add_argument("--generations", type=int, default=20, help="of a search (default: %(default)s)")
    parser.add_argument("--horizon", type=float, default=HORIZON, help="s of a planned drive (default: %(default)s)")
    parser.add_argument("--from", dest="start", metavar="TASK", help="start from the plans of another task")
    options = parser.parse_args(arguments)
    check_least(parser, options, 1, "scenarios", "generations", "horizon")
    return options


def plan(task_id: str, options: argparse.Namespace) -> None:
    """Search for the drives of a task, and write them."""
    task = suite.load().task(task_id)
    progress = track(SPLITS["test"][: options.scenarios], "planning", console=Console(stderr=True))
    drawn = with_spare_preferences(task)
    texts, values = plan_task(drawn, progress, options.generations, options.horizon, options.start)
    if task.preferences is not None:
        kept, left_out = worth_driving(task, values.mean(axis=0))
        texts, values = [[each[k] for k in kept.tolist()] for each in texts], values[:, kept]
        print(f"preferences.left_out: {left_out}")
    write_plans(plan_file(task_id), task, texts)
    print(f"{task_id}: {values.mean():.4f} over {len(values)} scenarios", flush=True)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line ``arguments``; those of the process if None."""
    options = parse_arguments(arguments)
    for task_id in options.tasks:
        if options.what == "plan":
            plan(task_id, options)
        else:
            found = (floor if options.what == "floor" else ceiling)(task_id)
            print(f"{task_id}: {options.what}: {{value: {found.value:.4g}, by: {found.by!r}}}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
