"""Run directories and atomic files."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from algorithms.common.atomic_io import atomic_write, write_json
from algorithms.experiments.config import Experiment, make_experiment
from algorithms.experiments.run_directory import Run, default_directory, versions

VALUES: dict[str, Any] = {
    "environment": {"id": "mo-deepdrive-one-waypoint-v0"},
    "utility": {"name": "one_waypoint_linear"},
    "algorithm": {"name": "a2c"},
    "training": {"total_timesteps": 1000, "num_envs": 2, "seed": 3},
}


@pytest.fixture
def experiment() -> Experiment:
    return make_experiment(VALUES)


def test_an_atomic_write_replaces_the_file_and_leaves_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "file"
    atomic_write(path, b"old")
    path.chmod(0o640)
    atomic_write(path, b"new")
    assert path.read_bytes() == b"new"
    assert path.stat().st_mode & 0o777 == 0o640
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("function", ["fsync", "replace"])
def test_a_full_disk_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, function: str) -> None:
    path = tmp_path / "file"
    atomic_write(path, b"old")

    def full(*arguments: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, function, full)
    with pytest.raises(OSError, match="No space left"):
        atomic_write(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(sys.platform == "win32", reason="needs file size limits")
def test_a_file_that_may_not_grow_leaves_the_old_one(tmp_path: Path, run_python: Callable[[str], str]) -> None:
    path = tmp_path / "file"
    atomic_write(path, b"old")
    said = run_python(
        "import resource\n"
        "from algorithms.common.atomic_io import atomic_write\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "try:\n"
        f"    atomic_write({str(path)!r}, b'x' * 100_000)\n"
        "except OSError as error:\n"
        "    print(error.strerror)\n"
    )
    assert said == "File too large\n"
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_new_run_holds_what_determines_it(tmp_path: Path, experiment: Experiment) -> None:
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


def test_a_directory_with_something_in_it_is_refused(tmp_path: Path, experiment: Experiment) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ValueError, match=r"is not empty.*--resume"):
        Run.create(experiment, tmp_path)
    assert (tmp_path / "file").read_text() == "mine"
    assert len(list(tmp_path.iterdir())) == 1


def test_a_place_that_cannot_be_written_is_refused(tmp_path: Path, experiment: Experiment) -> None:
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


def test_default_directories_say_what_they_hold_and_never_meet(tmp_path: Path, experiment: Experiment) -> None:
    paths = [default_directory(tmp_path, "configs/x/fast.yaml", experiment) for _ in range(3)]
    assert len(set(paths)) == 3
    for path in paths:
        assert path.parent == tmp_path / "fast"
        assert path.name.startswith("a2c-seed3-")
        assert path.is_dir()


def test_what_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"is not a run directory: it has no config\.yaml"):
        Run.open(tmp_path)
    (tmp_path / "config.yaml").write_text("algorithm: 3\n")
    with pytest.raises(ValueError, match=r"config\.yaml.*'environment' is missing"):
        Run.open(tmp_path)


def test_a_run_opens_on_another_device(tmp_path: Path) -> None:
    write = {**VALUES, "training": {**VALUES["training"], "device": "cuda:99"}}
    write_json(tmp_path / "config.yaml", write)  # JSON is YAML
    with pytest.raises(ValueError, match="cuda:99"):
        Run.open(tmp_path)
    assert Run.open(tmp_path, device="cpu").experiment.training.device == "cpu"
