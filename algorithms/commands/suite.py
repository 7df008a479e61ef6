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

import secrets
from collections import Counter
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from algorithms.commands.study import add_study_arguments, study_runner
from algorithms.commands.sweep import ENVIRONMENT as ENVIRONMENT
from algorithms.commands.sweep import run_command
from algorithms.runs.cli import TRUST, check_file, exit_on_error, make_parser
from algorithms.runs.config import parse_overrides
from algorithms.studies import ALL, CORE, REFERENCE

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace
    from collections.abc import Callable, Mapping

    from rich.table import Table

    from algorithms.runs.suite_entries import Entry
    from mo_deepdrive.suite import Row


def parse_arguments(arguments: list[str]) -> Namespace:
    """The options."""
    parser = make_parser(__doc__, "suite")
    actions = parser.add_subparsers(required=True, metavar="ACTION")

    def add(name: str, summary: str, run: Callable[[Namespace], int]) -> ArgumentParser:
        action: ArgumentParser = actions.add_parser(name, help=summary, description=summary, allow_abbrev=False)
        action.set_defaults(run=run)
        return action

    add("list", "the tasks, with what each tests, its floor and its ceiling", suite_list)

    score = add("score", "score policies, trained here or by any library", suite_score)
    source = (
        "a run, a policy of the zoo, policy.py, policy.py:name or package.module:name; a class is made of a task's id"
    )
    score.add_argument("policies", nargs="+", metavar="POLICY", help=source)
    tasks = f"their ids, {CORE}, or {ALL} that count (default: those of a run; {ALL} for others)"
    score.add_argument("--tasks", nargs="+", metavar="TASK", help=tasks)
    score.add_argument("--episodes", type=int, metavar="N", help="instead of those of a task")
    score.add_argument("--no-perturbations", action="store_true", help="leave out the columns of generalisation")
    score.add_argument("--output", metavar="CSV", help="also write the rows, from which suite verify reads them")
    TRUST.add_to(score)

    verify = add("verify", "score an entry again, and compare", suite_verify)
    verify.add_argument("entry", metavar="ENTRY", help="a CSV of suite score, or a run that was scored as a task")
    verify.add_argument("--tasks", nargs="+", metavar="TASK", help="verify these alone")
    scenarios = "from which fresh scenarios follow (default: drawn)"
    verify.add_argument("--scenarios", type=int, metavar="NUMBER", help=scenarios)
    TRUST.add_to(verify)

    run = add("run", "train learners on tasks of the suite, with the help that all learners get", suite_run)
    learner = (
        "YAML file with an algorithm, the name of a shipped one, an own package.module:Class, or a learner of the "
        f"reference study ({REFERENCE}), which is tuned as there, as are all beside it"
    )
    run.add_argument("--learner", nargs="+", action="extend", required=True, metavar="L", help=learner)
    tasks = f"their ids, {CORE} (the default), or {ALL} that count"
    run.add_argument("--tasks", nargs="+", action="extend", metavar="TASK", help=tasks)
    run.add_argument("--seeds", type=int, default=10, metavar="N", help="seeds of each task (default: %(default)s)")
    add_study_arguments(run)

    table = add("table", "normalised scores per task and learner, and per track", suite_table)
    results = "of a study (default: the reference results)"
    table.add_argument("results", nargs="?", type=Path, metavar="RESULTS.csv", help=results)
    table.add_argument("--against", metavar="LEARNER", help="whom the others are compared with (default: lintune)")
    table.add_argument("--figure", type=Path, metavar="FILE.png", help="draw the performance profiles")
    table.add_argument("--published", action="store_true", help="beside the reference results")
    baseline = "whom the others are compared with task by task, over the tasks of all"
    table.add_argument("--baseline", metavar="LEARNER", help=baseline)
    output = "write the tables (.md), or scores and differences (.tex, .csv)"
    table.add_argument("--output", type=Path, metavar="FILE", help=output)

    options, overrides = parser.parse_known_args(arguments)
    if overrides and options.run is not suite_run:
        parser.error(f"unrecognized arguments: {' '.join(overrides)}")
    options.overrides = overrides
    return options


# -------------------------------------------------------------------------------------------------------------- list


def minutes_per_run(rows: list[Row]) -> dict[str, float]:
    """The median minutes of a core that a run takes, by task, of those for which they are known."""
    seconds: dict[str, dict[tuple[str, int], float]] = {}
    for row in rows:
        if row.cpu_seconds is not None and row.state == "finished":
            seconds.setdefault(row.task, {})[row.learner, row.seed] = row.cpu_seconds
    return {task_id: median(runs.values()) / 60.0 for task_id, runs in seconds.items()}


def task_table(minutes: Mapping[str, float]) -> Table:
    """The tasks, one a row, with the minutes that a run takes where they are known."""
    from rich.table import Table

    from mo_deepdrive import suite

    columns = ("task", "track", "title", "steps", "minutes", "floor", "ceiling", "", "what it tests")
    table = Table(*columns, title="The suite")
    for name, task in suite.load().tasks.items():
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
    version = suite.load().version
    table.caption = f"version {version}; * of the core subset; minutes of one core, the median of published runs"
    return table


def suite_list(_options: Namespace) -> int:
    """Print the tasks; returns the exit code."""
    from algorithms.runs.console import make_console
    from algorithms.studies.suite_plan import PUBLISHED
    from mo_deepdrive import suite

    make_console().print(task_table(minutes_per_run(suite.read_rows(PUBLISHED)) if PUBLISHED.is_file() else {}))
    return 0


# ------------------------------------------------------------------------------------------------------------- score


def suite_score(options: Namespace) -> int:
    """Score policies; returns the exit code."""
    from algorithms.runs.console import make_console, print_line
    from algorithms.runs.progress import compilation_noted
    from algorithms.runs.suite_entries import open_entry
    from algorithms.studies.suite_plan import selected_tasks
    from mo_deepdrive import suite

    check_file("--output", options.output, ".csv")
    if options.episodes is not None and options.episodes < 1:
        raise ValueError(f"--episodes {options.episodes} must be at least 1")
    wanted = selected_tasks(options.tasks or ())
    entries = [open_entry(source, trust=options.trust) for source in options.policies]
    pairs = [(entry, task_id) for entry in entries for task_id in (wanted or entry.tasks or selected_tasks([ALL]))]
    runs = Counter((task_id, entry.learner, entry.seed) for entry, task_id in pairs)
    if options.output and (twice := [run for run, count in runs.items() if count > 1]):
        task_id, learner, seed = twice[0]
        raise ValueError(
            f"--output {options.output!r}: two policies are {learner!r} with seed {seed} on {task_id}; a file for each"
        )
    console, rows = make_console(), []
    with compilation_noted(lambda text: print_line(console, text)):
        policies = [checked_policy(entry, task_id) for entry, task_id in pairs]
        for (entry, task_id), policy in zip(pairs, policies, strict=True):
            with console.status(f"{entry.source} on {task_id}"):
                scores = entry.score(policy, task_id, episodes=options.episodes, perturbed=not options.no_perturbations)
            console.print(score_table(scores, f"{task_id}: {suite.load().task(task_id).title}; {entry.source}"))
            rows += scores
            if options.output:
                suite.write_rows(options.output, rows)
    if options.output:
        print(f"written: {options.output}")
    return 0


def checked_policy(entry: Entry, task_id: str) -> Any:
    """The policy of an entry for a task, which can drive there."""
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
        normalised = "" if row.normalised is None else f"{row.normalised:.3f}"
        interval = Estimate(row.value, row.low, row.high).text().replace("[", r"\[")
        table.add_row(row.column, row.policy, interval, normalised)
    return table


# ------------------------------------------------------------------------------------------------------------ verify


def suite_verify(options: Namespace) -> int:
    """Score an entry again, on the scenarios of the test split and on fresh ones; 0 if everything agrees, else 1."""
    from rich.table import Table

    from algorithms.runs.console import make_console
    from algorithms.runs.suite_entries import disagreement, fresh_seed, is_own_code, open_entry, recorded_rows
    from mo_deepdrive import suite

    wanted = options.tasks or ()
    for task_id in wanted:
        suite.load().task(task_id)
    recorded = [row for row in recorded_rows(options.entry, trust=options.trust) if not wanted or row.task in wanted]
    if not recorded:
        raise ValueError(f"{options.entry!r} has no scores of {', '.join(wanted)}")
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
        claims = [row for row in recorded if (row.source, row.task) == (source, task_id)]
        first = fresh_seed(number, suite.load().task(task_id).episodes)
        for scenarios, start in (("test split", None), (f"fresh: {number}", first)):
            with console.status(f"{source} on {task_id}"):
                scored = opened[source].score(policy, task_id, first_episode=start)
            again = {(row.policy, row.column): row for row in scored}
            for claim in claims:
                found = again.get((claim.policy, claim.column))
                wrong = disagreement(claim, found, fresh=start is not None)
                value = "" if found is None or found.value is None else f"{found.value:.4f}"
                verdict = "differs" if wrong else "agrees" if start is not None else "reproduced"
                column = f"{claim.column} ({claim.policy})"
                table.add_row(source, task_id, column, scenarios, f"{claim.value:.4f}", value, verdict)
                if wrong:
                    faults.append(f"{source} on {task_id}, {column}, {scenarios}: {wrong}")
    console.print(table)
    for fault in faults:
        print(fault)
    return 1 if faults else 0


# ------------------------------------------------------------------------------------------------------------ run


def suite_run(options: Namespace) -> int:
    """Train learners on tasks of the suite, and score them; returns the exit code."""
    from algorithms.studies.manifest import short_names
    from algorithms.studies.suite_plan import plan_of

    overrides = dict(parse_overrides(options.overrides))
    make = study_runner(lambda: plan_of(options.learner, options.tasks or [CORE], options.seeds, overrides), options)
    name = "-".join(["suite", *short_names(options.learner).values()]).replace("/", "-")
    return run_command(options, options.output or Path("runs") / "studies" / name, make)


# ------------------------------------------------------------------------------------------------------------- table


def suite_table(options: Namespace) -> int:
    """Print the tables of the suite, and write them if asked to; returns the exit code."""
    from algorithms.reporting.tables import FORMATS, markdown, print_rows, write_table
    from algorithms.runs.console import make_console, print_line
    from algorithms.studies.settings import load_study
    from algorithms.studies.suite_plan import PUBLISHED
    from algorithms.studies.suite_tables import MEANS_NOTE, NOTE, Scoreboard
    from mo_deepdrive import suite
    from mo_deepdrive.support.atomic_io import atomic_write

    check_file("--figure", options.figure)
    check_file("--output", options.output, *FORMATS)
    if options.published and options.results is None:
        raise ValueError("--published puts results of yours beside the reference results: name their CSV")
    results = _read_results(options.results or PUBLISHED)
    own = {row.learner for row in results} if options.published else set()
    if options.published:
        reference = _read_results(PUBLISHED)
        if both := own & {row.learner for row in reference}:
            raise ValueError(
                f"{str(options.results)!r} has the learner {min(both)!r}, as the reference results; rename"
            )
        results += reference
    console, board = make_console(), Scoreboard(results, suite.load())
    tables = [*board.track_tables(options.against), ("Tasks", board.task_table())]
    tables.append(("Tasks, by the policy that is not ranked", board.task_table(ranked=False)))
    scores, differences = board.comparison(options.baseline, own)
    tables += [("Scores", scores), ("Differences", differences)] if options.published or options.baseline else []
    for title, rows in tables:
        print_rows(console, rows, title, 1)
    console.print(NOTE, highlight=False)
    written: list[Path] = []
    if options.figure is not None:
        board.draw_profiles(options.figure, load_study(REFERENCE).labels)
        written.append(options.figure)
    if options.output is not None and options.output.suffix == ".md":
        text = "\n".join(f"## {title}\n\n{markdown(rows, 1, NOTE)}" for title, rows in tables)
        atomic_write(options.output, text.encode())
        written.append(options.output)
    elif options.output is not None:
        for ending, rows in (("", scores), ("-differences", differences)):
            written.append(options.output.with_stem(options.output.stem + ending))
            write_table(written[-1], rows, 1, MEANS_NOTE)
    for path in written:
        print_line(console, f"written: {path}")
    return 0


def _read_results(path: Path) -> list[Row]:
    """The rows of a table of results of the suite."""
    from mo_deepdrive import suite

    rows = suite.read_rows(path)
    if not rows:
        raise ValueError(f"there are no results in {str(path)!r}; mo-deepdrive suite run writes a results.csv")
    for row in rows:
        try:
            suite.check_of_suite(row)
        except ValueError as error:
            raise ValueError(f"{str(path)!r} has {error}") from None
    return rows


def main(arguments: list[str]) -> int:
    """Run the command line ``arguments``; returns the exit code."""
    options = parse_arguments(arguments)
    with exit_on_error(ValueError, OSError):
        code: int = options.run(options)
    return code
