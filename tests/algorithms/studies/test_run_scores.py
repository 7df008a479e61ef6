"""Scores of single runs."""

from __future__ import annotations

import csv
import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from algorithms.reporting.run_records import final_metrics
from algorithms.runs.jobs import Job, perform
from algorithms.studies.execution import read_score
from tests.helpers.short_runs import job

METRIC = "greedy/utility_esr"


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Job:
    """A finished run."""
    wanted = replace(job(tmp_path_factory.mktemp("finished")), id="whole")
    perform(wanted)
    return wanted


@pytest.fixture
def pruned(finished: Job, tmp_path: Path) -> Job:
    """A run that was pruned after its evaluations."""
    shutil.copytree(finished.path, tmp_path / "pruned")
    (tmp_path / "pruned" / "evaluation.json").unlink()
    values = json.loads((tmp_path / "pruned" / "status.json").read_text())
    (tmp_path / "pruned" / "status.json").write_text(json.dumps({**values, "state": "pruned"}))
    return replace(finished, path=tmp_path / "pruned", id="pruned")


def test_the_score_of_a_finished_run_is_that_of_its_final_evaluation(finished: Job) -> None:
    with (finished.path / "evaluation.csv").open(newline="") as file:
        written = {f"{row['policy']}/{row['metric']}": float(row["value"]) for row in csv.DictReader(file)}
    assert final_metrics(finished.path) == pytest.approx(written, nan_ok=True)
    for metric in (METRIC, "stochastic/return/distance"):
        assert read_score(finished.path, metric) == pytest.approx(written[metric])


def test_the_score_of_a_pruned_run_is_that_of_its_last_evaluation(finished: Job, pruned: Job) -> None:
    with (pruned.path / "metrics.csv").open(newline="") as file:
        cells = [row[f"eval/{METRIC}"] for row in csv.DictReader(file)]
    last = [float(cell) for cell in cells if cell][-1]
    assert read_score(pruned.path, METRIC) == pytest.approx(last)


@pytest.mark.parametrize("state", ["running", "trained", None])
def test_a_run_that_has_not_ended_has_no_score(pruned: Job, state: str | None) -> None:
    if state is None:
        (pruned.path / "status.json").unlink()
    else:
        (pruned.path / "status.json").write_text(json.dumps({"state": state, "step": 960}))
    assert math.isnan(read_score(pruned.path, METRIC) or 0.0)


def test_an_unknown_metric_is_refused_with_the_nearest_ones(finished: Job, pruned: Job) -> None:
    for wanted in (finished, pruned):
        with pytest.raises(ValueError, match="is not among those of the runs; did you mean") as error:
            read_score(wanted.path, "greedy/utility_ers")
        assert METRIC in str(error.value)


def test_results_that_cannot_be_read_are_refused_with_what_to_do(finished: Job, tmp_path: Path) -> None:
    unreadable, changed = (tmp_path / name for name in ("unreadable", "changed"))
    unreadable.mkdir()
    (unreadable / "status.json").write_text('{"state": "finished"}')
    (unreadable / "evaluation.json").write_text("{")
    shutil.copytree(finished.path, changed)
    (changed / "evaluation.json").write_text((changed / "evaluation.json").read_text() + "\n")
    for path, fault in (
        (unreadable, ".*is not a final evaluation.*; delete it, and it is made again"),
        (changed, "evaluation.json: .*; --remake makes it again"),
    ):
        with pytest.raises(ValueError, match=f"cannot use {path}: {fault}$"):
            read_score(path, METRIC)
