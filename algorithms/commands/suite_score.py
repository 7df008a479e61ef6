"""The actions of the command suite that score policies: score and verify."""

from __future__ import annotations

import secrets
from collections import Counter
from typing import TYPE_CHECKING, Any

from algorithms.runs.cli import TRUST, check_file

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace

    from rich.table import Table

    from algorithms.runs.suite_entries import Entry
    from mo_deepdrive.suite import Row


def add_suite_score(parser: ArgumentParser) -> None:
    """The options of ``suite score``."""
    parser.add_argument(
        "policies",
        nargs="+",
        metavar="POLICY",
        help="a run, a policy of the zoo, policy.py, policy.py:name or package.module:name; a class is made of the "
        "id of a task",
    )
    parser.add_argument(
        "--tasks",
        nargs="+",
        metavar="TASK",
        help="their ids, or core (default: those of a run; all that count for others)",
    )
    parser.add_argument("--episodes", type=int, metavar="N", help="instead of those of a task")
    parser.add_argument("--no-perturbations", action="store_true", help="leave out the columns of generalisation")
    parser.add_argument("--output", metavar="CSV", help="also write the rows, from which suite verify reads them")
    TRUST.add_to(parser)


def add_suite_verify(parser: ArgumentParser) -> None:
    """The options of ``suite verify``."""
    parser.add_argument("entry", metavar="ENTRY", help="a CSV of suite score, or a run that was scored as a task")
    parser.add_argument("--tasks", nargs="+", metavar="TASK", help="verify these alone")
    parser.add_argument(
        "--scenarios",
        type=int,
        metavar="NUMBER",
        help="from which fresh scenarios follow (default: drawn)",
    )
    TRUST.add_to(parser)


def suite_score(options: Namespace) -> int:
    """Score policies; returns the exit code."""
    from algorithms.commands.suite_results import CORE
    from algorithms.runs.console import make_console, print_line
    from algorithms.runs.progress_bar import compilation_noted
    from algorithms.runs.suite_entries import open_entry
    from mo_deepdrive import suite

    check_file("--output", options.output, ".csv")
    if options.episodes is not None and options.episodes < 1:
        raise ValueError(f"--episodes {options.episodes} must be at least 1")
    tasks = suite.load().tasks
    options.tasks = dict.fromkeys(
        each
        for task_id in options.tasks or ()
        for each in ([name for name, task in tasks.items() if task.core] if task_id == CORE else [task_id])
    )
    for task_id in options.tasks:
        suite.load().task(task_id)
    entries = [open_entry(source, trust=options.trust) for source in options.policies]
    runs = Counter((task_id, each.learner, each.seed) for each in entries for task_id in _tasks(each, options))
    if options.output and (twice := [run for run, count in runs.items() if count > 1]):
        task_id, learner, seed = twice[0]
        raise ValueError(
            f"--output {options.output!r}: two policies are {learner!r} with seed {seed} on {task_id}; a file for each"
        )
    console, rows = make_console(), []
    with compilation_noted(lambda text: print_line(console, text)):
        found = [
            (entry, task_id, checked_policy(entry, task_id)) for entry in entries for task_id in _tasks(entry, options)
        ]
        for entry, task_id, policy in found:
            with console.status(f"{entry.source} on {task_id}"):
                mine = entry.score(policy, task_id, episodes=options.episodes, perturbed=not options.no_perturbations)
            console.print(score_table(mine, f"{task_id}: {suite.load().task(task_id).title}; {entry.source}"))
            rows += mine
            if options.output:
                suite.write_rows(options.output, rows)
    if options.output:
        print(f"written: {options.output}")
    return 0


def _tasks(entry: Entry, options: Namespace) -> list[str]:
    from mo_deepdrive import suite

    if options.tasks:
        return list(options.tasks)
    if entry.tasks:
        return list(entry.tasks)
    return [task_id for task_id, task in suite.load().tasks.items() if task.counted]


def checked_policy(entry: Entry, task_id: str) -> Any:
    """The policy of an entry for a task, which can drive there.

    Raises:
        ValueError: if it cannot.
    """
    from mo_deepdrive import suite

    policy = entry.policy(task_id)
    try:
        suite.check_policy(policy, task_id)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{entry.source!r} on {error}") from None
    return policy


def score_table(rows: list[Row], title: str) -> Table:
    """The rows of one policy on one task."""
    from rich.table import Table

    from mo_deepdrive.evaluation.statistics import Estimate

    table = Table("column", "policy", "value, 95% interval", "normalised", title=title, title_justify="left")
    for row in rows:
        assert row.value is not None
        shown = "" if row.normalised is None else f"{row.normalised:.3f}"
        interval = Estimate(row.value, row.low, row.high).text().replace("[", r"\[")
        table.add_row(row.column, row.policy, interval, shown)
    return table


def suite_verify(options: Namespace) -> int:
    """Score an entry again, on the scenarios of the test split and on fresh ones; 0 if everything agrees, else 1."""
    from rich.table import Table

    from algorithms.runs.console import make_console
    from algorithms.runs.suite_entries import disagreement, fresh_seed, is_own_code, open_entry, recorded_rows
    from mo_deepdrive import suite

    for task_id in options.tasks or ():
        suite.load().task(task_id)
    recorded = [
        row
        for row in recorded_rows(options.entry, trust=options.trust)
        if not options.tasks or row.task in options.tasks
    ]
    if not recorded:
        raise ValueError(f"{options.entry!r} has no scores of {', '.join(options.tasks)}")
    pairs = dict.fromkeys((row.source, row.task) for row in recorded)
    own = [source for source, _ in pairs if is_own_code(source)]
    if own and not options.trust:  # before anything of it is imported
        raise ValueError(f"{options.entry!r} names code to run, {own[0]!r}; --trust runs it")
    number = secrets.randbelow(10**8) if options.scenarios is None else options.scenarios
    opened = {source: open_entry(source, trust=options.trust) for source, _ in pairs}
    policies = {(source, task_id): checked_policy(opened[source], task_id) for source, task_id in pairs}
    console, faults = make_console(), []
    table = Table("policy", "task", "column", "scenarios", "recorded", "found", "", title=f"{options.entry}")
    for (source, task_id), policy in policies.items():
        mine = [row for row in recorded if (row.source, row.task) == (source, task_id)]
        first = fresh_seed(number, suite.load().task(task_id).episodes)
        for scenarios, start in (("test split", None), (f"fresh: {number}", first)):
            with console.status(f"{source} on {task_id}"):
                again = {
                    (row.policy, row.column): row for row in opened[source].score(policy, task_id, first_episode=start)
                }
            for row in mine:
                found = again.get((row.policy, row.column))
                wrong = disagreement(row, found, fresh=start is not None)
                shown = "" if found is None or found.value is None else f"{found.value:.4f}"
                verdict = "differs" if wrong else "agrees" if start is not None else "reproduced"
                table.add_row(
                    source, task_id, f"{row.column} ({row.policy})", scenarios, f"{row.value:.4f}", shown, verdict
                )
                if wrong:
                    faults.append(f"{source} on {task_id}, {row.column} ({row.policy}), {scenarios}: {wrong}")
    console.print(table)
    for fault in faults:
        print(fault)
    return 1 if faults else 0
