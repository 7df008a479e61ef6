"""The results of a study: a tidy table of the runs that count, one of the tuning, and a page of tables."""

from __future__ import annotations

import json
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.reporting.run_records import experiment_record, read_evaluation
from algorithms.reporting.table_files import markdown
from algorithms.runs.run_directory import read_status
from algorithms.studies.manifest import label
from mo_deepdrive import suite
from mo_deepdrive.evaluation.front import EVALUATION_FILE
from mo_deepdrive.evaluation.metrics import SUITE, split_name
from mo_deepdrive.evaluation.statistics import mean
from mo_deepdrive.suite import Row, write_rows
from mo_deepdrive.suite.scoring import FAILED
from mo_deepdrive.support.atomic_io import atomic_write, csv_bytes, own_path

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from algorithms.reporting.wide_tables import Rows
    from algorithms.studies.manifest import ManifestRow
    from algorithms.studies.plan import ArmRuns, StudyPlan
    from mo_deepdrive.evaluation.statistics import Estimate

RESULTS_FILE, TUNING_FILE, TABLES_FILE = "results.csv", "tuning.csv", "results.md"
FINISHED, WAITING = "finished", "waiting"
NOTE = (
    "Means over seeds with 95% bootstrap intervals. Runs that failed or are not finished have no score and are counted."
)


def results_of(plan: StudyPlan, runs: Sequence[ArmRuns], directory: Path) -> list[Row]:
    """The results of the runs that count, in the order of the study.

    Args:
        plan: of the study.
        runs: that are known by now.
        directory: of the study.

    Raises:
        ValueError: if a finished run cannot be read, or has no value of its metric.
    """
    return [result for arm in runs for seed in arm.arm.seeds for result in _results_of(plan, arm, seed, directory)]


def _results_of(plan: StudyPlan, arm: ArmRuns, seed: int, directory: Path) -> list[Row]:
    """The results of one seed of an arm; an arm whose tuning failed has failed for every seed."""
    task, learner = arm.arm.key
    row = next((row for row in arm.final if row.seed == seed), None)
    if row is None:
        state = FAILED if arm.given_up else WAITING
        return [Row(task, learner, seed, "", "", None, state=state)]
    path = directory / row.directory
    status = read_status(path)
    state = str(status.get("state", WAITING))
    about: dict[str, Any] = {"state": state, "cpu_seconds": status.get("cpu_seconds"), "source": row.directory}
    about["steps"] = row.config["training"]["total_timesteps"]
    about["environment"] = experiment_record(row.config).environment.label
    evaluation = read_evaluation(path) if state == FINISHED else None
    if evaluation is None:
        return [Row(task, learner, seed, "", "", None, **about)]
    if arm.arm.metric not in evaluation.scores:
        raise ValueError(f"run {str(path)!r} has no {arm.arm.metric!r} in its final evaluation")
    version = evaluation.suite_version
    if version not in (None, suite.load().version):
        raise ValueError(
            f"run {str(path)!r} was scored as version {version} of the suite, which is now {suite.load().version}; "
            f"delete its {EVALUATION_FILE}, and --remake scores it again"
        )
    return [
        Row(
            task,
            learner,
            seed,
            split_name(name).policy,
            column,
            each.value,
            each.low,
            each.high,
            version=version or 0,
            **about,
        )
        for name, each in evaluation.scores.items()
        if (column := _column(plan, arm, name)) is not None
    ]


def _column(plan: StudyPlan, arm: ArmRuns, name: str) -> str | None:
    """The column of a metric of the final evaluation; None for one that the results leave out."""
    rest = name.partition("/")[2]
    if rest.startswith(SUITE):
        return rest.removeprefix(SUITE)
    metric = arm.arm.metric.partition("/")[2]
    return rest if rest in (metric, *plan.study.columns) else None


def write_results(plan: StudyPlan, runs: Sequence[ArmRuns], directory: Path) -> list[Row]:
    """Write the tables of a study into its directory; returns the results.

    Raises:
        ValueError: as :func:`results_of`, or if one of the files is a link.
        OSError: if a file cannot be written; it is then unchanged.
    """
    results = results_of(plan, runs, directory)
    write_rows(own_path(directory, RESULTS_FILE), results)
    if plan.study.tuning is not None:
        atomic_write(own_path(directory, TUNING_FILE), csv_bytes(tuning_rows(runs, directory)))
    parts = [f"# {plan.study.title or directory.name}"]
    for title, rows, which in study_tables(plan, runs, results):
        parts.append(f"## {title}\n\n{markdown(rows, 1, f'{which} {NOTE}')}")
    atomic_write(own_path(directory, TABLES_FILE), ("\n\n".join(parts)).encode())
    return results


def tuning_rows(runs: Sequence[ArmRuns], directory: Path) -> list[list[Any]]:
    """A row per run of the tuning: its settings and state, the mean score of these, and whether they were chosen."""
    rows: list[list[Any]] = [
        ["task", "learner", "trial", "settings", "seed", "state", "metric", "mean_score", "chosen"]
    ]
    for arm in runs:
        for trial, (of_point, score) in enumerate(zip(arm.tuning, arm.scores, strict=True)):
            known = "" if score is None or np.isnan(score) else f"{score:.7g}"
            for row in of_point:
                settings = json.dumps(arm.arm.points[trial], sort_keys=True)
                about = [*arm.arm.key, trial, settings, row.seed, _state(row, directory)]
                rows.append([*about, arm.arm.metric, known, int(trial == arm.chosen)])
    return rows


def _state(row: ManifestRow, directory: Path) -> str:
    return str(read_status(directory / row.directory).get("state", WAITING))


def study_tables(plan: StudyPlan, runs: Sequence[ArmRuns], results: Sequence[Row]) -> list[tuple[str, Rows, str]]:
    """The tables of a study, one per task with its title and which numbers to cite: a row per learner, the best first.

    Args:
        plan: of the study.
        runs: that are known by now.
        results: of these.
    """
    found = []
    for name, task in plan.study.tasks.items():
        mine = [result for result in results if result.task == name]
        # The details of a scorer are in the tidy table alone.
        shown = [result for result in mine if result.column and not (task.task and "/" in result.column)]
        columns = list(dict.fromkeys((result.policy, result.column) for result in shown))
        if not (arms := [arm for arm in runs if arm.arm.task == name]):
            continue
        rows = [["learner", "seeds", "CPU minutes", *(f"{column} ({policy})" for policy, column in columns), "chosen"]]
        for arm in arms:
            of_arm = [result for result in mine if result.learner == arm.arm.learner]
            states = Counter({result.seed: result.state for result in of_arm}.values())
            others = ", ".join(f"{number} {state}" for state, number in sorted(states.items()) if state != FINISHED)
            seeds = f"{sum(states.values())}" + (f" ({others})" if others else "")
            minutes = [
                seconds / 60
                for seconds in {result.seed: result.cpu_seconds for result in of_arm}.values()
                if seconds is not None
            ]
            cells = [_text(score_of(of_arm, policy, column)) for policy, column in columns]
            chosen = "" if arm.chosen is None else label(arm.arm.points[arm.chosen])
            rows.append([arm.arm.label, seeds, f"{np.mean(minutes):.1f}" if minutes else "", *cells, chosen])
        found.append((task.title or name, rows, _to_cite(task.task, arms)))
    return found


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


def score_of(results: Iterable[Row], policy: str, column: str) -> Estimate | None:
    """The mean over seeds of a column of one policy; None if no run has it."""
    values = [
        each.value for each in results if (each.policy, each.column) == (policy, column) and each.value is not None
    ]
    return mean(np.array(values)) if values else None


def _text(score: Estimate | None) -> str:
    return "" if score is None else score.text()
