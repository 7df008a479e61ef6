"""The actions of the command suite that make and show results: run and table."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from algorithms.commands.study import add_study_arguments
from algorithms.commands.sweep import run_command
from algorithms.experiments.cli import check_file
from algorithms.experiments.config import parse_overrides
from algorithms.experiments.shipped import CONFIGS
from algorithms.sweeps.manifest import short_names

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace
    from collections.abc import Mapping, Sequence

    from rich.console import Console

    from algorithms.studies.plan import StudyPlan
    from algorithms.sweeps.runner import Backend, Runner
    from mo_deepdrive.suite import Row

REFERENCE = "studies/suite"  # the study of the reference results
PUBLISHED = CONFIGS.parent / "docs" / "results" / "suite.csv"  # these results
CORE, ALL = "core", "all"  # instead of tasks
OF_PUBLISHED = " (published)"  # after the name of a published learner that is also one of the results beside it


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
    from algorithms.sweeps.sweep_settings import key_problems, keys_in
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
    parser.add_argument("--published", action="store_true", help="beside the reference results, on tasks of RESULTS")
    parser.add_argument("--learners", nargs="+", action="extend", metavar="L", help="those to show (default: all)")
    parser.add_argument("--baseline", metavar="LEARNER", help="whom the others are compared with (default: lintune)")
    parser.add_argument("--figure", type=Path, metavar="FILE.png", help="draw the performance profiles")
    parser.add_argument("--output", type=Path, metavar="FILE", help="scores and differences as .csv, .tex or .md")


def suite_table(options: Namespace) -> int:
    """Print the tables of the suite, and write them if asked to; returns the exit code."""
    from algorithms.experiments.console import make_console, print_line
    from algorithms.reporting.table_files import FORMATS, write_files
    from algorithms.reporting.wide_tables import print_rows
    from algorithms.studies.settings import load_study
    from algorithms.studies.suite_tables import BASELINE, DIFFERENCES, NOTE, Scoreboard, tasks_by_learners
    from mo_deepdrive import suite

    check_file("--figure", options.figure)
    check_file("--output", options.output, *FORMATS)
    path = options.results or PUBLISHED
    results = suite.read_rows(path)
    if not results:
        raise ValueError(f"there are no results in {str(path)!r}; mo-deepdrive suite run writes a results.csv")
    for task in {row.task: None for row in results}:
        if task not in suite.load().tasks:
            raise ValueError(f"{str(path)!r} has results of task {task!r}, which the suite does not have")
    if options.published and options.results is not None:
        results = beside_published(results)
    console, board = make_console(), Scoreboard(results, suite.load())
    if options.learners:
        board.check_learners("--learners", options.learners)
        wanted = [row for name in dict.fromkeys(options.learners) for row in results if row.learner == name]
        board = Scoreboard(wanted, suite.load())
    tables = [*board.track_tables(options.baseline), ("Tasks", board.task_table())]
    tables.append(("Tasks, by the policy that is not ranked", board.task_table(ranked=False)))
    for title, rows in tables:
        print_rows(console, rows, title, 1)
    console.print(NOTE, highlight=False)
    baseline = options.baseline or (BASELINE if BASELINE in board.learners else board.learners[0])
    differences = board.tidy_differences(baseline)
    if len(differences) > 1:
        print_rows(console, tasks_by_learners(differences, {}), f"Differences to {baseline}", 1)
        console.print(DIFFERENCES.format(baseline), highlight=False)
    labels = load_study(REFERENCE).labels
    labels |= {f"{name}{OF_PUBLISHED}": f"{label}{OF_PUBLISHED}" for name, label in labels.items()}
    if options.figure is not None:
        board.draw_profiles(options.figure, labels)
        print_line(console, f"written: {options.figure}")
    if options.output is not None:
        scores = board.tidy_scores()
        if options.output.suffix.lower() != ".csv":
            scores, differences = (tasks_by_learners(each, labels) for each in (scores, differences))
        note = DIFFERENCES.format(labels.get(baseline, baseline))
        written = write_files(options.output, {"": (scores, 1, NOTE), "-differences": (differences, 1, note)})
        print_line(console, f"written: {', '.join(map(str, written))}")
    return 0


def beside_published(results: Sequence[Row]) -> list[Row]:
    """Results, and the published ones of the same tasks, whose learners are renamed where both have one of a name."""
    from mo_deepdrive import suite

    tasks, names = {row.task for row in results}, {row.learner for row in results}
    published = [row for row in suite.read_rows(PUBLISHED) if row.task in tasks]
    renamed = [
        replace(row, learner=f"{row.learner}{OF_PUBLISHED}") if row.learner in names else row for row in published
    ]
    return [*results, *renamed]
