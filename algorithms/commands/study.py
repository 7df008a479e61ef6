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

from typing import TYPE_CHECKING

from algorithms.commands.sweep import ENVIRONMENT as ENVIRONMENT
from algorithms.commands.sweep import directory_of, run_command, run_options
from algorithms.runs.cli import Command, Options, flag, many, option
from algorithms.runs.console import print_line

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from algorithms.studies.execution import Runner
    from algorithms.studies.plan import StudyPlan

STUDY_OPTIONS = run_options("study", "studies", flag("--tables", "write the tables of what has finished"))


def write_tables(plan: StudyPlan, runner: Runner, directory: Path, console: Console) -> None:
    """Write and print the tables: of the arms that were selected, and of others that were begun before."""
    from algorithms.reporting.tables import print_rows
    from algorithms.runs.run_directory import is_run
    from algorithms.studies.manifest import is_sweep
    from algorithms.studies.results import NOTE, RESULTS_FILE, TABLES_FILE, write_results

    if not is_sweep(directory):
        raise ValueError(f"there is no study in {str(directory)!r} yet; leave out --tables to train its runs")
    runs = [
        arm
        for arm in plan.runs(runner)
        if arm.arm.key in plan.selected or any(is_run(directory / row.directory) for row in arm.rows)
    ]
    for table in write_results(plan, runs, directory):
        print_rows(console, table.rows, table.title, 1)
        console.print(table.to_cite, highlight=False)
    console.print(NOTE, highlight=False)
    print_line(console, f"written: {directory / RESULTS_FILE}, {directory / TABLES_FILE}")


def train_study(options: Options) -> int:
    """Do what the options say; returns the exit code."""

    def make_plan() -> StudyPlan:
        from algorithms.studies.plan import StudyPlan
        from algorithms.studies.settings import load_study

        plan = StudyPlan(load_study(options.config), options.tasks, options.learners)
        if plan.idle:
            raise ValueError(f"invalid study {options.config!r}: {'; '.join(plan.idle)}")
        return plan

    directory = directory_of(options, "studies")
    for name in ("tasks", "learners"):
        if (options.status or options.verify) and getattr(options, name):
            raise ValueError(f"--{name} has no effect beside {'--status' if options.status else '--verify'}")
    return run_command(options, directory, make_plan, write_tables)


OPTIONS = (
    option("--config", "FILE", "YAML file of the study, or the name of a shipped one"),
    many("--tasks", "TASK", "train on some of its tasks (default: all)"),
    many("--learners", "NAME", "train some of its learners (default: all)"),
    *STUDY_OPTIONS,
)
main = Command("study", __doc__, OPTIONS, train_study)
