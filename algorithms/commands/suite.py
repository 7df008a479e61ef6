"""The suite: tasks with a floor and a ceiling, and what a policy scores on them.

mo-deepdrive suite list
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from algorithms.experiments.cli import INSTALLED, exit_on_error, make_parser

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable

    from rich.table import Table

    from mo_deepdrive.suite import Suite


def parse_arguments(arguments: list[str], program: str) -> argparse.Namespace:
    """The options."""
    parser = make_parser(__doc__, program, "suite")
    actions = parser.add_subparsers(required=True, metavar="ACTION")

    def add(name: str, what: str, run: Callable[[argparse.Namespace], int]) -> argparse.ArgumentParser:
        action: argparse.ArgumentParser = actions.add_parser(name, help=what, description=what, allow_abbrev=False)
        action.set_defaults(run=run)
        return action

    add("list", "the tasks, with what each tests, its floor and its ceiling", _list)
    return parser.parse_args(arguments)


def task_table(suite: Suite) -> Table:
    """The tasks, one a row."""
    from rich.table import Table

    table = Table("task", "track", "title", "steps", "floor", "ceiling", "", "what it tests", title="The suite")
    for name, task in suite.tasks.items():
        table.add_row(
            f"{name}{' *' if task.core else ''}",
            task.track if task.counted else "(not counted)",
            task.title,
            f"{task.steps / 1e6:g} M",
            f"{task.floor.value:.4g}",
            f"{task.ceiling.value:.4g}",
            task.ceiling.kind,
            task.tests,
        )
    table.caption = f"version {suite.version}; * of the core subset"
    return table


def _list(_options: argparse.Namespace) -> int:
    from algorithms.experiments.console import make_console
    from mo_deepdrive.suite import load

    make_console().print(task_table(load()))
    return 0


def main(arguments: list[str], program: str = INSTALLED) -> int:
    """Run the command line ``arguments``; returns the exit code."""
    options = parse_arguments(arguments, program)
    with exit_on_error(ValueError, OSError, program=program):
        code: int = options.run(options)
    return code
