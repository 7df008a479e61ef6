"""The actions of the command suite that score policies: score and verify."""

from __future__ import annotations

import secrets
from collections import Counter
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from algorithms.experiments.cli import add_trust_argument, check_file, warn

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace
    from collections.abc import Iterator

    from rich.table import Table

    from algorithms.experiments.suite_entries import Entry
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
    tasks = "their ids, core, or all that count (default: those of a run; all for others)"
    parser.add_argument("--tasks", nargs="+", action="extend", metavar="TASK", help=tasks)
    parser.add_argument("--episodes", type=int, metavar="N", help="instead of those of a task")
    parser.add_argument("--no-perturbations", action="store_true", help="leave out the columns of generalisation")
    parser.add_argument("--output", metavar="CSV", help="also write the rows, from which suite verify reads them")
    add_trust_argument(parser)


def add_suite_verify(parser: ArgumentParser) -> None:
    """The options of ``suite verify``."""
    parser.add_argument("entry", metavar="ENTRY", help="a CSV of suite score, or a run that was scored as a task")
    parser.add_argument("--tasks", nargs="+", action="extend", metavar="TASK", help="verify these alone")
    scenarios = "the seeds of the fresh scenarios follow from this number (default: a random one, which is printed)"
    parser.add_argument("--scenarios", type=int, metavar="NUMBER", help=scenarios)
    add_trust_argument(parser)


def suite_score(options: Namespace) -> int:
    """Score policies; returns the exit code."""
    from algorithms.experiments.console import make_console, print_line
    from algorithms.experiments.progress_bar import compilation_noted
    from algorithms.experiments.suite_entries import open_entry
    from mo_deepdrive import suite

    check_file("--output", options.output, ".csv")
    if options.episodes is not None and options.episodes < 1:
        raise ValueError(f"--episodes {options.episodes} must be at least 1")
    asked = suite.load().named(options.tasks or [])
    entries = [open_entry(source, trust=options.trust) for source in dict.fromkeys(options.policies)]
    made = [
        (entry, task_id, made_policy(entry, task_id))
        for entry in entries
        for task_id in asked or entry.tasks or suite.load().named(["all"])
    ]
    if options.output:
        labels = Counter((entry.learner, entry.seed, task_id) for entry, task_id, _ in made)
        for (learner, seed, task_id), count in labels.items():
            if count > 1:
                raise ValueError(
                    f"--output {options.output!r}: {count} of the policies are {learner!r} with seed {seed} on "
                    f"{task_id}; score them into a file each"
                )
    console, rows = make_console(), []
    with compilation_noted(lambda what: print_line(console, what)):
        for entry, task_id, policy in made:
            check_policy(entry, task_id, policy)
        for entry, task_id, policy in made:
            with console.status(f"{entry.source} on {task_id}"):
                mine = scored(entry, task_id, policy, episodes=options.episodes, perturbed=not options.no_perturbations)
            console.print(score_table(mine, f"{task_id}: {suite.load().task(task_id).title}; {entry.source}"))
            rows += mine
            if options.output:
                suite.write_rows(options.output, rows)
    if options.output:
        print(f"written: {options.output}")
    return 0


def made_policy(entry: Entry, task_id: str) -> Any:
    """The policy of an entry for a task, of which the form is checked.

    Raises:
        ValueError: if it cannot be one.
    """
    from mo_deepdrive import suite

    policy = entry.policy(task_id)
    with _naming(entry):
        suite.check_form(policy, task_id)
    return policy


def check_policy(entry: Entry, task_id: str, policy: Any) -> None:
    """Refuse a policy that cannot drive, with ValueError."""
    from mo_deepdrive import suite

    with _naming(entry):
        suite.check_policy(policy, task_id)


def scored(entry: Entry, task_id: str, policy: Any, **options: Any) -> list[Row]:
    """The rows of a policy; what goes wrong in the middle of an episode is a ValueError that names the entry."""
    with _naming(entry):
        return entry.score(policy, task_id, **options)


@contextmanager
def _naming(entry: Entry) -> Iterator[None]:
    """Say of which entry an error is."""
    try:
        yield
    except (TypeError, ValueError) as error:
        raise ValueError(f"{entry.source!r} on {error}") from None


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
    """Score an entry again, on the test split and on fresh scenarios; 0 if everything agrees, else 1."""
    from rich.table import Table

    from algorithms.experiments.console import make_console, print_line
    from algorithms.experiments.progress_bar import compilation_noted
    from algorithms.experiments.suite_entries import compare, fresh_seed, open_entry, recorded_rows
    from mo_deepdrive import suite

    number = secrets.randbelow(2**31) if options.scenarios is None else options.scenarios
    if number < 0:
        raise ValueError(f"--scenarios {number} must be at least 0")
    wanted = suite.load().named(options.tasks or [])
    recorded = [row for row in recorded_rows(options.entry, trust=options.trust) if not wanted or row.task in wanted]
    if not recorded:
        raise ValueError(f"{options.entry!r} has no scores of {', '.join(wanted)}")
    pairs = dict.fromkeys((row.source, row.task) for row in recorded)
    entries = {source: open_entry(source, trust=options.trust) for source, _ in pairs}
    policies = {(source, task_id): made_policy(entries[source], task_id) for source, task_id in pairs}
    console, faults = make_console(), []
    table = Table("policy", "task", "column", "scenarios", "recorded", "found", "", title=f"{options.entry}")
    with compilation_noted(lambda what: print_line(console, what)):
        for (source, task_id), policy in policies.items():
            check_policy(entries[source], task_id, policy)
        for (source, task_id), policy in policies.items():
            mine = [row for row in recorded if (row.source, row.task) == (source, task_id)]
            episodes = suite.load().task(task_id).episodes
            perturbed = any(row.column in suite.load().perturbations for row in mine)
            with console.status(f"{source} on {task_id}"):
                again, fresh = (
                    scored(entries[source], task_id, policy, first_episode=first, perturbed=perturbed)
                    for first in (None, fresh_seed(number, episodes))
                )
            for each in compare(mine, again, fresh, episodes, len(recorded)):
                row, found = each.recorded, "" if each.found is None else f"{each.found.value:.4f}"
                what, where = f"{row.column} ({row.policy})", f"of {number}" if each.fresh else "test split"
                table.add_row(source, task_id, what, where, f"{row.value:.4f}", found, each.verdict)
                if not each.agrees:
                    told = f"{row.value:g} {each.verdict}" + (f" from {found} ({where})" if found else "")
                    faults.append(f"{source!r} on {task_id}: {what} = {told}")
    console.print(table)
    print_line(console, f"fresh scenarios: those of --scenarios {number}")
    if faults:
        warn("\n".join(faults), options.program)
    return 1 if faults else 0
