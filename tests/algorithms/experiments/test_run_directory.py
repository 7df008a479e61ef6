"""Run directories: what they store, who may write to them, and which are refused."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import pytest

from algorithms.common.atomic_io import write_json
from algorithms.experiments.config import Experiment, make_experiment
from algorithms.experiments.run_directory import Run, default_directory, versions

if TYPE_CHECKING:
    from pathlib import Path

VALUES: dict[str, Any] = {
    "environment": {"id": "mo-deepdrive-one-waypoint-v0"},
    "utility": {"name": "one_waypoint_linear"},
    "algorithm": {"name": "a2c"},
    "training": {"total_timesteps": 1000, "num_envs": 2, "seed": 3},
}


@pytest.fixture
def experiment() -> Experiment:
    return make_experiment(VALUES)


def test_a_new_run_stores_its_experiment_and_versions(tmp_path: Path, experiment: Experiment) -> None:
    run = Run.create(experiment, tmp_path / "a" / "run")
    run.unlock()
    assert Run.open(run.path).experiment == experiment
    assert run.status["state"] == "running"
    assert run.status["total_timesteps"] == 1000
    assert run.versions == versions()
    assert run.versions["packages"]["torch"] is not None
    assert run.changed_versions() == []


def test_changed_versions_are_named(tmp_path: Path, experiment: Experiment) -> None:
    run = Run.create(experiment, tmp_path / "run")
    then = run.versions
    then["packages"]["torch"] = "0.1"
    write_json(run.path / "versions.json", then)
    (change,) = run.changed_versions()
    assert change.startswith("torch: 0.1 then")


def test_a_directory_that_is_not_empty_is_refused(tmp_path: Path, experiment: Experiment) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ValueError, match=r"is not empty.*--resume"):
        Run.create(experiment, tmp_path)
    assert (tmp_path / "file").read_text() == "mine"
    assert len(list(tmp_path.iterdir())) == 1


def test_a_path_that_cannot_be_written_is_refused(tmp_path: Path, experiment: Experiment) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="cannot be written"):
        Run.create(experiment, tmp_path / "file" / "run")
    with pytest.raises(ValueError, match="cannot be made"):
        default_directory(tmp_path / "file", "config.yaml", experiment)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_directory_is_refused(tmp_path: Path, experiment: Experiment) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(ValueError, match="cannot be written"):
        Run.create(experiment, tmp_path / "run")


@pytest.mark.skipif(os.name != "posix", reason="runs are locked on POSIX systems")
def test_two_processes_do_not_train_in_one_directory(tmp_path: Path, experiment: Experiment) -> None:
    first = Run.create(experiment, tmp_path / "run")
    second = Run.open(tmp_path / "run")
    with pytest.raises(ValueError, match="in use by another process"):
        second.lock()
    first.unlock()
    second.lock()
    second.unlock()


def test_default_directories_are_named_after_the_run_and_are_unique(tmp_path: Path, experiment: Experiment) -> None:
    paths = [default_directory(tmp_path, "configs/x/fast.yaml", experiment) for _ in range(3)]
    assert len(set(paths)) == 3
    for path in paths:
        assert path.parent == tmp_path / "fast"
        assert path.name.startswith("a2c-seed3-")
        assert path.is_dir()


def test_a_directory_without_a_valid_config_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"is not a run directory: it has no config\.yaml"):
        Run.open(tmp_path)
    (tmp_path / "config.yaml").write_text("algorithm: 3\n")
    with pytest.raises(ValueError, match=r"config\.yaml.*'environment' is missing"):
        Run.open(tmp_path)


def test_a_run_can_be_opened_on_another_device(tmp_path: Path) -> None:
    write = {**VALUES, "training": {**VALUES["training"], "device": "cuda:99"}}
    write_json(tmp_path / "config.yaml", write)  # JSON is YAML
    with pytest.raises(ValueError, match="cuda:99"):
        Run.open(tmp_path)
    assert Run.open(tmp_path, device="cpu").experiment.training.device == "cpu"
