"""The actions of the command suite that make and show results: run and table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from algorithms.commands.study import add_study_arguments
from algorithms.commands.sweep import run_command
from algorithms.runs.cli import check_file
from algorithms.runs.config import parse_overrides
from algorithms.runs.shipped import CONFIGS
from algorithms.studies.manifest import short_names

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace
    from collections.abc import Mapping

    from rich.console import Console

    from algorithms.studies.backends import Backend
    from algorithms.studies.execution import Runner
    from algorithms.studies.plan import StudyPlan
    from mo_deepdrive.suite import Row

REFERENCE = "studies/suite"  # the study of the reference results
# These results, in a checkout and in an installed package.
PUBLISHED = next(
    (path for path in (CONFIGS.parent / "docs" / "results" / "suite.csv",) if path.is_file()),
    CONFIGS / "suite" / "published.csv",
)
CORE, ALL = "core", "all"  # instead of tasks


def add_suite_run(parser: ArgumentParser) -> None:
    """The options of ``suite run``."""
    parser.add_argument(
        "--learner",
        nargs="+",
        action="extend",
        required=True,
        metavar="L",
        help="YAML file with an algorithm, the name of a shipped one, an own package.module:Class, or a learner of the "
        f"reference study ({REFERENCE}), which is tuned as there, as are all beside it",
    )
    tasks = "their ids, core (the default), or all that count"
    parser.add_argument("--tasks", nargs="+", action="extend", metavar="TASK", help=tasks)
    parser.add_argument("--seeds", type=int, default=10, metavar="N", help="seeds of each task (default: %(default)s)")
    add_study_arguments(parser)


def suite_run(options: Namespace) -> int:
    """Train learners on tasks of the suite, and score them; returns the exit code."""

    def make(directory: Path, backend: Backend, console: Console) -> Runner:
        from algorithms.studies.runner import StudyRunner

        plan = plan_of(
            options.learner, options.tasks or [CORE], options.seeds, dict(parse_overrides(options.overrides))
        )
        return StudyRunner(plan, directory, backend, console, train=not options.tables)

    name = "-".join(["suite", *short_names(options.learner).values()]).replace("/", "-")
    return run_command(options, options.program, options.output or Path("runs") / "studies" / name, make)


def plan_of(learners: list[str], tasks: list[str], seeds: int, overrides: Mapping[str, Any] | None = None) -> StudyPlan:
    """The study of some learners on tasks of the suite, with the help of the reference study.

    Args:
        learners: learners of the reference study, configs and paths of classes. If one of them is of the reference
            study, all are tuned by its rule; else none is.
        tasks: their ids, "core" or "all".
        seeds: number of seeds.
        overrides: as of :class:`algorithms.studies.plan.StudyPlan`.

    Raises:
        ValueError: naming what is unknown, or has no effect.
    """
    from algorithms.studies.plan import StudyPlan
    from algorithms.studies.settings import ELSEWHERE, Learner, StudyTask, load_study, problems_of
    from algorithms.studies.sweep_settings import key_problems, keys_in
    from mo_deepdrive import suite

    if seeds < 1:
        raise ValueError(f"--seeds {seeds} must be at least 1")
    known = suite.load().tasks
    groups = {CORE: [key for key in known if known[key].core], ALL: [key for key in known if known[key].counted]}
    wanted = [key for name in tasks for key in groups.get(name, [name])]
    for key in wanted:
        suite.load().task(key)
    reference = load_study(REFERENCE)
    planned = {key for task in reference.tasks for key in reference.learners_of(task)} & {*learners}
    found = {name: each for name, each in reference.learners.items() if name in planned}
    names = short_names(learners)
    for name in (name for name in learners if name not in planned):
        found[names[name]] = Learner(overrides={"algorithm.name": name}) if ":" in name else Learner(config=name)
    own = {}
    for key, task in known.items():
        given = reference.tasks.get(key, StudyTask(task=key))
        mine = {name: each for name, each in given.learners.items() if name in planned}
        own[key] = given.model_copy(update={"learners": mine, "title": task.title})
    tuning = reference.tuning if planned else None
    changes = {"seeds": list(range(seeds)), "tasks": own, "learners": found, "tuning": tuning}
    study = reference.model_copy(update=changes)
    problems = [f"--learner {name} is given twice" for name in names if learners.count(name) > 1]
    problems += key_problems({"the options": keys_in(overrides or {})}, ELSEWHERE)
    asked = {key: own[key] for key in wanted if study.learners_of(key)}
    problems += problems_of(study.model_copy(update={"tasks": asked}))
    if problems:
        raise ValueError("; ".join(problems))
    return StudyPlan(study, wanted, [*names.values()], overrides)


def add_suite_table(parser: ArgumentParser) -> None:
    """The options of ``suite table``."""
    parser.add_argument(
        "results", nargs="?", type=Path, metavar="RESULTS.csv", help="of a study (default: the reference results)"
    )
    parser.add_argument("--against", metavar="LEARNER", help="whom the others are compared with (default: lintune)")
    parser.add_argument("--figure", type=Path, metavar="FILE.png", help="draw the performance profiles")
    parser.add_argument("--published", action="store_true", help="beside the reference results")
    parser.add_argument(
        "--baseline", metavar="LEARNER", help="whom the others are compared with task by task, over the tasks of all"
    )
    parser.add_argument(
        "--output", type=Path, metavar="FILE", help="write the tables (.md), or scores and differences (.tex, .csv)"
    )


def suite_table(options: Namespace) -> int:
    """Print the tables of the suite, and write them if asked to; returns the exit code."""
    from algorithms.reporting.table_files import FORMATS, markdown, write_table
    from algorithms.reporting.wide_tables import print_rows
    from algorithms.runs.console import make_console, print_line
    from algorithms.studies.settings import load_study
    from algorithms.studies.suite_tables import MEANS_NOTE, NOTE, Scoreboard
    from mo_deepdrive import suite
    from mo_deepdrive.support.atomic_io import atomic_write

    check_file("--figure", options.figure)
    check_file("--output", options.output, *FORMATS)
    if options.published and options.results is None:
        raise ValueError("--published puts results of yours beside the reference results: name their CSV")
    paths = [options.results or PUBLISHED, *([PUBLISHED] if options.published else [])]
    results: list[Row] = []
    for path in paths:
        found = suite.read_rows(path)
        if not found:
            raise ValueError(f"there are no results in {str(path)!r}; mo-deepdrive suite run writes a results.csv")
        for row in found:
            try:
                suite.check_of_suite(row)
            except ValueError as error:
                raise ValueError(f"{str(path)!r} has {error}") from None
        if both := {row.learner for row in found} & {row.learner for row in results}:
            raise ValueError(
                f"{str(options.results)!r} has the learner {min(both)!r}, as the reference results; rename"
            )
        results += found
    console, board = make_console(), Scoreboard(results, suite.load())
    tables = [*board.track_tables(options.against), ("Tasks", board.task_table())]
    tables.append(("Tasks, by the policy that is not ranked", board.task_table(ranked=False)))
    scores, differences = board.comparison(options.baseline, {row.learner for row in results if row not in found})
    tables += [("Scores", scores), ("Differences", differences)] if options.published or options.baseline else []
    for title, rows in tables:
        print_rows(console, rows, title, 1)
    console.print(NOTE, highlight=False)
    if options.figure is not None:
        board.draw_profiles(options.figure, load_study(REFERENCE).labels)
        print_line(console, f"written: {options.figure}")
    if options.output is not None:
        if options.output.suffix == ".md":
            text = "\n".join(f"## {title}\n\n{markdown(rows, 1, NOTE)}" for title, rows in tables)
            atomic_write(options.output, text.encode())
            print_line(console, f"written: {options.output}")
        else:
            parts = {"": scores, "-differences": differences}
            for ending, rows in parts.items():
                file = options.output.with_name(f"{options.output.stem}{ending}{options.output.suffix}")
                write_table(file, rows, 1, MEANS_NOTE)
                print_line(console, f"written: {file}")
    return 0
