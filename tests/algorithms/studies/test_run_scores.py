"""Scores of single runs."""

from __future__ import annotations

import csv
import json
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
        assert read_score("whole", finished.path, metric) == {"whole": pytest.approx(written[metric])}


def test_the_score_of_a_pruned_run_is_that_of_its_last_evaluation(finished: Job, pruned: Job) -> None:
    with (pruned.path / "metrics.csv").open(newline="") as file:
        cells = [row[f"eval/{METRIC}"] for row in csv.DictReader(file)]
    last = [float(cell) for cell in cells if cell][-1]
    with (pruned.path / "metrics.csv").open("a") as file:
        file.write("99999" + "," * (len(file_columns(pruned)) - 1) + "\n")
    assert read_score("pruned", pruned.path, METRIC) == {"pruned": pytest.approx(last)}


def file_columns(wanted: Job) -> list[str]:
    """The columns of a run's metrics.csv."""
    return (wanted.path / "metrics.csv").read_text().splitlines()[0].split(",")


@pytest.mark.parametrize("state", ["running", "trained", None])
def test_a_run_that_has_not_ended_has_no_score(pruned: Job, state: str | None) -> None:
    if state is None:
        (pruned.path / "status.json").unlink()
    else:
        (pruned.path / "status.json").write_text(json.dumps({"state": state, "step": 960}))
    assert read_score("pruned", pruned.path, METRIC) == {}


def test_an_unknown_metric_is_refused_with_the_nearest_ones(finished: Job, pruned: Job) -> None:
    for wanted in (finished, pruned):
        with pytest.raises(ValueError, match="is not among those of the runs; did you mean") as error:
            read_score("run", wanted.path, "greedy/utility_ers")
        assert METRIC in str(error.value)


def test_a_changed_evaluation_is_refused(finished: Job, tmp_path: Path) -> None:
    changed = shutil.copytree(finished.path, tmp_path / "changed")
    path = changed / "evaluation.json"
    path.write_text(path.read_text() + "\n")
    with pytest.raises(ValueError, match=f"cannot use {changed}: evaluation.json: .*; --remake makes it again"):
        read_score("run", changed, METRIC)


def test_results_that_cannot_be_read_are_refused_with_what_to_do(finished: Job, pruned: Job, tmp_path: Path) -> None:
    (pruned.path / "metrics.csv").write_text("\n")
    unreadable = replace(finished, path=tmp_path / "finished")
    unreadable.path.mkdir()
    (unreadable.path / "status.json").write_text('{"state": "finished"}')
    (unreadable.path / "evaluation.json").write_text("{")
    for wanted, fault in ((pruned, "its columns must be 'step'"), (unreadable, "is not a final evaluation")):
        with pytest.raises(
            ValueError, match=f"cannot use {wanted.path}: .*{fault}.*; delete it, and it is made again$"
        ):
            read_score("run", wanted.path, METRIC)
