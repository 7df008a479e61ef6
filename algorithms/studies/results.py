"""The results of a study: a tidy table of the runs that count, one of the tuning, and a page of tables."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import astuple, fields
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import polars as pl

from algorithms.reporting.run_records import experiment_record, read_evaluation
from algorithms.reporting.tables import markdown, write_table
from algorithms.runs.run_directory import read_status
from algorithms.runs.suite_entries import rows_of
from algorithms.studies.execution import read_score
from algorithms.studies.manifest import label
from mo_deepdrive import suite
from mo_deepdrive.evaluation.front import EVALUATION_FILE
from mo_deepdrive.evaluation.statistics import mean
from mo_deepdrive.suite import Row, write_rows
from mo_deepdrive.suite.results import FAILED
from mo_deepdrive.support.atomic_io import atomic_write, own_path

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from algorithms.reporting.tables import Rows
    from algorithms.studies.plan import ArmRuns, StudyPlan

RESULTS_FILE, TUNING_FILE, TABLES_FILE = "results.csv", "tuning.csv", "results.md"
FINISHED, WAITING = "finished", "waiting"
NOTE = (
    "Means over seeds with 95% bootstrap intervals. Runs that failed or are not finished have no score and are counted."
)
ROW_TYPES = {"str": pl.String, "int": pl.Int64, "FiniteFloat": pl.Float64}


def frame_of(rows: Sequence[Row]) -> pl.DataFrame:
    """The rows as a data frame, with a column for each attribute."""
    schema = {field.name: ROW_TYPES[str(field.type).partition(" ")[0]] for field in fields(Row)}
    return pl.DataFrame([astuple(row) for row in rows], schema, orient="row")


def results_of(plan: StudyPlan, runs: Sequence[ArmRuns], directory: Path) -> list[Row]:
    """The results of the runs that count and are known by now, in the order of the study."""
    return [row for arm in runs for seed in arm.arm.seeds for row in _rows_of_run(plan, arm, seed, directory)]


def _rows_of_run(plan: StudyPlan, arm: ArmRuns, seed: int, directory: Path) -> list[Row]:
    """The results of one seed of an arm; an arm whose tuning failed has failed for every seed."""
    key = (*arm.arm.key, seed)
    run = next((run for run in arm.final if run.seed == seed), None)
    if run is None:
        return [Row(*key, "", "", None, state=FAILED if arm.given_up else WAITING)]
    path = directory / run.directory
    status = read_status(path)
    state = str(status.get("state", WAITING))
    about: dict[str, Any] = {
        "source": run.directory,
        "state": state,
        "cpu_seconds": status.get("cpu_seconds"),
        "steps": run.config["training"]["total_timesteps"],
        "environment": experiment_record(run.config).environment.label,
    }
    evaluation = read_evaluation(path) if state == FINISHED else None
    if evaluation is None:
        return [Row(*key, "", "", None, **about)]
    if arm.arm.metric not in evaluation.scores:
        raise ValueError(f"run {str(path)!r} has no {arm.arm.metric!r} in its final evaluation")
    version = evaluation.suite_version
    if version not in (None, suite.load().version):
        raise ValueError(
            f"run {str(path)!r} was scored as version {version} of the suite, which is now {suite.load().version}; "
            f"delete its {EVALUATION_FILE}, and --remake scores it again"
        )
    return rows_of(evaluation, key, arm.arm.metric.partition("/")[2], *plan.study.columns, **about)


def samples_of_runs(runs: Sequence[ArmRuns], directory: Path) -> suite.Samples:
    """The samples of the scores of the runs that count, as far as they are kept."""
    return {
        (*arm.arm.key, run.seed): part
        for arm in runs
        for run in arm.final
        for (task, *_), part in suite.read_samples(directory / run.directory / EVALUATION_FILE).items()
        if task == run.config["evaluation"].get("task")
    }


def write_results(plan: StudyPlan, runs: Sequence[ArmRuns], directory: Path) -> list[StudyTable]:
    """Write the results of a study into its directory; returns its tables."""
    results = results_of(plan, runs, directory)
    write_rows(own_path(directory, RESULTS_FILE), results)
    suite.write_samples(own_path(directory, RESULTS_FILE), samples_of_runs(runs, directory))
    if plan.study.tuning is not None:
        write_table(own_path(directory, TUNING_FILE), tuning_rows(runs, directory), 4, "")
    tables = study_tables(plan, runs, results)
    parts = [f"# {plan.study.title or directory.name}"]
    parts += [f"## {table.title}\n\n{markdown(table.rows, 1, f'{table.to_cite} {NOTE}')}" for table in tables]
    atomic_write(own_path(directory, TABLES_FILE), ("\n\n".join(parts)).encode())
    return tables


def tuning_rows(runs: Sequence[ArmRuns], directory: Path) -> list[list[Any]]:
    """A row per run of the tuning: its settings, rung and score, its price, and whether the settings were chosen."""
    about = ["task", "learner", "candidate", "settings", "rung", "steps", "seed"]
    rows: list[list[Any]] = [[*about, "state", "metric", "score", "cpu_seconds", "chosen"]]
    for arm, run in ((its, run) for its in runs for run in its.tuning):
        settings = json.dumps(arm.arm.candidates[run.trial or 0], sort_keys=True)
        path, metric = directory / run.directory, arm.arm.metric
        status, score = read_status(path), read_score(path, metric)
        tried = [run.trial, settings, run.cell["rung"], run.config["training"]["total_timesteps"], run.seed]
        ended = [status.get("state", WAITING), metric, "" if score is None or np.isnan(score) else f"{score:.7g}"]
        price = status.get("cpu_seconds", "")
        rows.append([*arm.arm.key, *tried, *ended, price, int(run.trial == arm.chosen)])
    return rows


class StudyTable(NamedTuple):
    """The table of a task: a row per learner; and which of the study's numbers to cite."""

    title: str
    rows: Rows
    to_cite: str


def study_tables(plan: StudyPlan, runs: Sequence[ArmRuns], results: Sequence[Row]) -> list[StudyTable]:
    """The tables of the results of a study, one per task."""
    frame, tables = frame_of(results), []
    for name, task in plan.study.tasks.items():
        arms, of_task = [arm for arm in runs if arm.arm.task == name], frame.filter(task=name)
        if not arms:
            continue
        scored = of_task.filter(pl.col("column") != "")
        if task.task:  # the details of its scorer are in the tidy table alone
            scored = scored.filter(~pl.col("column").str.contains("/", literal=True))
        columns = scored.select("policy", "column").unique(maintain_order=True).rows()
        rows = [["learner", "seeds", "CPU minutes", *(f"{column} ({policy})" for policy, column in columns), "chosen"]]
        for arm in arms:
            of_arm = of_task.filter(learner=arm.arm.learner)
            runs_of_arm = of_arm.unique("seed")
            states = Counter(runs_of_arm["state"])
            others = ", ".join(f"{number} {state}" for state, number in sorted(states.items()) if state != FINISHED)
            seconds = runs_of_arm["cpu_seconds"].drop_nulls().to_numpy()
            scores = [of_arm.filter(policy=policy, column=column)["value"].drop_nulls() for policy, column in columns]
            count = f"{len(runs_of_arm)}" + (f" ({others})" if others else "")
            minutes = f"{seconds.mean() / 60:.1f}" if len(seconds) else ""
            texts = [mean(values.to_numpy()).text() if len(values) else "" for values in scores]
            chosen = "" if arm.chosen is None else label(arm.arm.candidates[arm.chosen])
            rows.append([arm.arm.label, count, minutes, *texts, chosen])
        tables.append(StudyTable(task.title or name, rows, _to_cite(task.task, arms)))
    return tables


def _to_cite(task: str | None, arms: Sequence[ArmRuns]) -> str:
    """Which numbers of a table to cite: those of the suite where it has the task, else the final evaluations."""
    evaluations = {experiment_record(row.config).evaluation.label for arm in arms for row in arm.final} - {""}
    final = f"final evaluations ({' or '.join(sorted(evaluations)) or 'episodes that are not known'})"
    if task is None:
        return f"Cite these numbers of the {final}, which mo-deepdrive table shows, too."
    return (
        f"Cite the score and its perturbations, which are of {suite.load().task(task).episodes} scenarios of the test "
        f"split, as on the scoreboard. Other columns, and mo-deepdrive table, are of the {final}; intervals are over "
        "seeds alone, so that those of the two need not meet."
    )
