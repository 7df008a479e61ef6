"""Jobs: runs are made once, gone on with where they were stopped, and never mixed up."""

from __future__ import annotations

from pathlib import Path

import pytest
from short_runs import job, quiet

from algorithms.jobs import Job, differences, perform
from algorithms.monitor import Monitor
from algorithms.pool import perform_all


def test_a_job_is_trained_and_evaluated_without_pictures_and_then_left_alone(tmp_path: Path) -> None:
    wanted = job(tmp_path)
    assert not wanted.done
    assert perform(wanted) == "trained"
    assert wanted.done
    names = {path.name for path in wanted.path.iterdir()}
    assert {"evaluation.json", "metrics.csv", "checkpoint.safetensors", "train.log"} <= names
    assert not {"video.mp4", "curves.png"} & names
    before = {path: path.stat().st_mtime_ns for path in wanted.path.rglob("*") if path.is_file()}
    assert perform(wanted) == "already there"
    assert before == {path: path.stat().st_mtime_ns for path in wanted.path.rglob("*") if path.is_file()}


def test_a_directory_with_another_experiment_is_refused_before_anything_starts(tmp_path: Path) -> None:
    perform(job(tmp_path))
    other = Job("other", job(tmp_path, total_timesteps=961).experiment, tmp_path / "seed0")
    fresh = job(tmp_path, seed=1)
    with pytest.raises(ValueError, match=r"training.total_timesteps = 960 there, 961 wanted"):
        perform_all([fresh, other], 1, Monitor([], quiet()))
    assert not fresh.path.exists()


def test_where_a_run_is_made_does_not_make_it_another(tmp_path: Path) -> None:
    first, second = job(tmp_path, threads=1).experiment.to_dict(), job(tmp_path, threads=2).experiment.to_dict()
    second["logging"]["interval"] = 77
    assert differences(first, second) == []
    second["algorithm"]["gamma"] = 0.5
    assert differences(first, second) == ["algorithm.gamma = 0.99 there, 0.5 wanted"]
