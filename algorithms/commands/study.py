"""Train all runs of a study, and write its tables: on this machine, on Ray or on Slurm.

    mo-deepdrive study --config studies/suite                       # train what is missing, then write the tables
    mo-deepdrive study --config studies/suite --tasks K1 K3         # train on these tasks; --learners ppo: this learner
    mo-deepdrive study --config studies/suite --tables              # tables of what has finished by now
    mo-deepdrive study --config studies/suite --on slurm            # as Slurm job arrays
    mo-deepdrive study --config studies/suite --status              # show the progress

A study trains some learners on some tasks; it may first choose the settings of each, on the validation split. Run the
same command again to resume: finished runs are skipped, interrupted ones continue from their checkpoints.

The study's directory is like that of a sweep, which mo-deepdrive table and mo-deepdrive plot read. It also gets
results.csv (a row per number of a run), tuning.csv and results.md.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from algorithms.commands.sweep import ENVIRONMENT as ENVIRONMENT
from algorithms.commands.sweep import add_run_arguments, run_command
from algorithms.runs.cli import make_parser, refuse_beside

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace
    from collections.abc import Callable

    from rich.console import Console

    from algorithms.studies.backends import Backend
    from algorithms.studies.execution import Runner
    from algorithms.studies.plan import StudyPlan


def add_study_arguments(parser: ArgumentParser) -> None:
    """The options of what trains a study."""
    instead = add_run_arguments(parser, "study")
    instead.add_argument("--tables", action="store_true", help="write the tables of what has finished")


def parse_arguments(arguments: list[str]) -> Namespace:
    """The options."""
    parser = make_parser(__doc__, "study")
    parser.add_argument("--config", metavar="FILE", help="YAML file of the study, or the name of a shipped one")
    parser.add_argument(
        "--tasks", nargs="+", action="extend", metavar="TASK", help="train on some of its tasks (default: all)"
    )
    parser.add_argument(
        "--learners", nargs="+", action="extend", metavar="NAME", help="train some of its learners (default: all)"
    )
    add_study_arguments(parser)
    options = parser.parse_args(arguments)
    if options.config is None and not ((options.status or options.verify) and options.output):
        parser.error("--config is required, except for --status and --verify with --output")
    if options.status or options.verify:
        refuse_beside(parser, options, "--status" if options.status else "--verify", "tasks", "learners")
    return options


def study_runner(make_plan: Callable[[], StudyPlan], options: Namespace) -> Callable[..., Runner]:
    """What makes the runner of a study for :func:`run_command`."""

    def make(directory: Path, backend: Backend, console: Console) -> Runner:
        from algorithms.studies.runner import StudyRunner

        return StudyRunner(make_plan(), directory, backend, console, train=not options.tables)

    return make


def main(arguments: list[str]) -> int:
    """Run the command line ``arguments`` and return the exit code."""
    options = parse_arguments(arguments)

    def make_plan() -> StudyPlan:
        from algorithms.studies.plan import StudyPlan
        from algorithms.studies.settings import load_study

        plan = StudyPlan(load_study(options.config), options.tasks, options.learners)
        if plan.idle:
            raise ValueError(f"invalid study {options.config!r}: {'; '.join(plan.idle)}")
        return plan

    directory = options.output or Path("runs") / "studies" / Path(options.config).stem
    return run_command(options, directory, study_runner(make_plan, options))
