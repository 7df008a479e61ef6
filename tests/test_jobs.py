"""Jobs: runs are made once, gone on with where they were stopped, and never mixed up."""

from __future__ import annotations

import io
import multiprocessing
import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from safetensors.numpy import load_file

from algorithms.experiment import make_experiment
from algorithms.jobs import Job, differences, perform, perform_all

VALUES = {
    "environment": {"id": "mo-deepdrive-one-waypoint-v0", "arguments": {"time_limit": 1}},
    "utility": {"name": "one_waypoint_linear"},
    "algorithm": {"name": "mo_a2c", "steps": 8, "hidden": [8]},
    "training": {"total_timesteps": 960, "num_envs": 4},
    "evaluation": {"episodes": 2, "final_episodes": 4, "interval": 480},
    "logging": {"interval": 5, "checkpoint_interval": 320, "pictures": False},
}


def job(folder: Path, seed: int = 0, **training: int) -> Job:
    values = {**VALUES, "training": {**VALUES["training"], "seed": seed, **training}}
    return Job(f"seed {seed}", make_experiment(values), folder / f"seed{seed}")


def quiet() -> Console:
    return Console(file=io.StringIO(), width=200)


def test_a_job_is_trained_and_evaluated_without_pictures_and_then_left_alone(tmp_path: Path) -> None:
    wanted = job(tmp_path)
    assert not wanted.finished
    assert perform(wanted) == "trained"
    assert wanted.finished
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
        perform_all([fresh, other], 1, quiet())
    assert not fresh.path.exists()


def test_where_a_run_is_made_does_not_make_it_another(tmp_path: Path) -> None:
    first, second = job(tmp_path, threads=1).experiment.to_dict(), job(tmp_path, threads=2).experiment.to_dict()
    second["logging"]["interval"] = 77
    assert differences(first, second) == []
    second["algorithm"]["gamma"] = 0.5
    assert differences(first, second) == ["algorithm.gamma = 0.99 there, 0.5 wanted"]


def test_several_jobs_give_what_each_alone_gives(tmp_path: Path) -> None:
    together = [job(tmp_path / "together", seed) for seed in (0, 1, 2)]
    assert perform_all(together, 2, quiet()) == []
    alone = job(tmp_path / "alone", 1)
    perform(alone)
    for name in ("metrics.csv", "checkpoint.safetensors"):
        mine, theirs = (each.path / name for each in (together[1], alone))
        if name.endswith("csv"):
            columns = [[line.split(",") for line in path.read_text().splitlines()] for path in (mine, theirs)]
            timed = columns[0][0].index("time/steps_per_second")
            kept = [[row[:timed] + row[timed + 1 :] for row in rows] for rows in columns]
            assert kept[0] == kept[1]
        else:
            first, second = load_file(mine), load_file(theirs)
            assert all(np.array_equal(first[key], second[key]) for key in second)
    console = quiet()
    assert perform_all(together, 2, console) == []
    assert console.file.getvalue() == ""  # nothing left to do


def test_a_job_that_fails_is_named_and_the_others_are_made(tmp_path: Path) -> None:
    good, bad = job(tmp_path, 0), job(tmp_path, 1)
    bad.path.mkdir()
    (bad.path / "something").touch()
    ((failed, error),) = perform_all([bad, good], 1, quiet())
    assert failed is bad
    assert "is not empty" in error
    assert good.finished


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_jobs_that_are_interrupted_are_saved_and_end_as_if_they_had_not_been(tmp_path: Path) -> None:
    wanted = job(tmp_path / "stopped", total_timesteps=120_000)

    def stop() -> None:
        deadline = time.monotonic() + 120
        while not (wanted.path / "checkpoint.safetensors").exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    watcher = threading.Thread(target=stop)
    watcher.start()
    waiting = [job(tmp_path / "waiting", seed) for seed in (1, 2, 3)]
    with pytest.raises(KeyboardInterrupt):
        perform_all([wanted, *waiting], 1, quiet())
    watcher.join()
    assert not multiprocessing.active_children()
    assert not any(other.path.exists() for other in waiting)  # nothing else was begun
    assert not wanted.finished
    assert perform_all([wanted], 1, quiet()) == []
    assert wanted.finished
    whole = job(tmp_path / "whole", total_timesteps=120_000)
    perform(whole)
    first, second = (load_file(each.path / "checkpoint.safetensors") for each in (wanted, whole))
    assert first.keys() == second.keys()
    assert all(np.array_equal(first[key], second[key]) for key in second)
