"""The suite: tasks with a floor and a ceiling, and what a policy scores on them.

mo-deepdrive suite list
mo-deepdrive suite score policy.py --tasks K1 K5 --output scores.csv
mo-deepdrive suite verify scores.csv --scenarios 20260101        # again, and on scenarios that follow from a number
mo-deepdrive suite run --learner suite/ppo                       # train a learner on the core tasks
mo-deepdrive suite run --learner my_package.my_module:MyAgent mo_ppo --tasks K1 K3 --seeds 5 --algorithm.gamma=0.98
mo-deepdrive suite table                                         # the reference results
mo-deepdrive suite table runs/studies/suite-ppo/results.csv --figure profile.png

Where a learner of the reference study is trained, all beside it are tuned by its rule. A key of an experiment, such as
--algorithm.gamma=0.98, is for every learner that has the setting.
"""

from __future__ import annotations

from statistics import median
from typing import TYPE_CHECKING

from algorithms.commands.suite_results import PUBLISHED, add_suite_run, add_suite_table, suite_run, suite_table
from algorithms.commands.suite_score import add_suite_score, add_suite_verify, suite_score, suite_verify
from algorithms.commands.sweep import ENVIRONMENT as ENVIRONMENT
from algorithms.runs.cli import exit_on_error, make_parser

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Mapping

    from rich.table import Table

    from mo_deepdrive.suite import Row, Suite


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """The options."""
    parser = make_parser(__doc__, "suite")
    actions = parser.add_subparsers(required=True, metavar="ACTION")

    def add(name: str, what: str, run: Callable[[argparse.Namespace], int]) -> argparse.ArgumentParser:
        action: argparse.ArgumentParser = actions.add_parser(name, help=what, description=what, allow_abbrev=False)
        action.set_defaults(run=run)
        return action

    add("list", "the tasks, with what each tests, its floor and its ceiling", _list)
    add_suite_score(add("score", "score policies, trained here or by any library", suite_score))
    add_suite_verify(add("verify", "score an entry again, and compare", suite_verify))
    add_suite_run(add("run", "train learners on tasks of the suite, with the help that all learners get", suite_run))
    add_suite_table(add("table", "normalised scores per task and learner, and per track", suite_table))
    options, overrides = parser.parse_known_args(arguments)
    if overrides and options.run is not suite_run:
        parser.error(f"unrecognized arguments: {' '.join(overrides)}")
    options.overrides = overrides
    return options


def minutes_per_run(rows: list[Row]) -> dict[str, float]:
    """The median minutes of a core that a run takes, by task, of those for which they are known."""
    seconds: dict[str, dict[tuple[str, int], float]] = {}
    for row in rows:
        if row.cpu_seconds is not None and row.state == "finished":
            seconds.setdefault(row.task, {})[row.learner, row.seed] = row.cpu_seconds
    return {task_id: median(runs.values()) / 60.0 for task_id, runs in seconds.items()}


def task_table(suite: Suite, minutes: Mapping[str, float]) -> Table:
    """The tasks, one a row, with the minutes that a run takes where they are known."""
    from rich.table import Table

    columns = ("task", "track", "title", "steps", "minutes", "floor", "ceiling", "", "what it tests")
    table = Table(*columns, title="The suite")
    for name, task in suite.tasks.items():
        table.add_row(
            f"{name}{' *' if task.core else ''}",
            task.track if task.counted else "(not counted)",
            task.title,
            f"{task.steps / 1e6:g} M",
            f"{minutes[name]:.1f}" if name in minutes else "",
            f"{task.floor.value:.4g}",
            f"{task.ceiling.value:.4g}",
            task.ceiling.kind,
            task.tests,
        )
    table.caption = f"version {suite.version}; * of the core subset; minutes of one core, the median of published runs"
    return table


def _list(_options: argparse.Namespace) -> int:
    from algorithms.runs.console import make_console
    from mo_deepdrive.suite import load, read_rows

    known = minutes_per_run(read_rows(PUBLISHED)) if PUBLISHED.is_file() else {}
    make_console().print(task_table(load(), known))
    return 0


def main(arguments: list[str]) -> int:
    """Run the command line ``arguments``; returns the exit code."""
    options = parse_arguments(arguments)
    with exit_on_error(ValueError, OSError):
        code: int = options.run(options)
    return code
