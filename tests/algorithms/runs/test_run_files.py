"""The files of finished runs: recorded when a run finishes, and compared afterwards."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from algorithms.runs.config import make_experiment
from algorithms.runs.jobs import perform
from algorithms.runs.run_directory import Run
from algorithms.runs.run_files import RECORDED, changed_files
from tests.helpers.short_runs import VALUES, job


@pytest.fixture
def finished(tmp_path: Path) -> Path:
    """A run with made-up files that has just been finished."""
    run = Run.create(make_experiment(VALUES), tmp_path / "run")
    for name in RECORDED[1:]:
        (run.path / name).write_bytes(name.encode() * 10)
    run.set_status("finished", 960)
    run.unlock()
    return run.path


def test_missing_cut_and_edited_files_are_named(finished: Path) -> None:
    (finished / "checkpoint.safetensors").unlink()
    os.truncate(finished / "metrics.csv", 8)
    edited = finished / "evaluation.json"
    edited.write_bytes(edited.read_bytes().replace(b"evaluation", b"EVALUATION", 1))
    assert changed_files(finished) == [
        "checkpoint.safetensors: missing",
        "metrics.csv: 8 bytes, recorded 110",
        "evaluation.json: changed since the run finished",
    ]
    assert changed_files(finished, ["evaluation.json", "front.csv"]) == [
        "evaluation.json: changed since the run finished"
    ]
    assert changed_files(finished, ["front.csv"]) == []


def test_a_run_that_is_not_finished_has_no_record(finished: Path) -> None:
    Run.open(finished).set_status("running", 0)
    (finished / "metrics.csv").unlink()
    assert changed_files(finished) == []


def test_training_records_its_files_when_it_finishes(tmp_path: Path) -> None:
    wanted = job(tmp_path)
    assert perform(wanted) == "trained"
    recorded = json.loads((wanted.path / "status.json").read_text())["files"]
    assert list(recorded) == ["config.yaml", "checkpoint.safetensors", "metrics.csv", "evaluation.json"]
    assert changed_files(wanted.path) == []
