"""Run directories: what they store, who may write to them, and which are refused."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import gymnasium
import pytest

from algorithms.runs.config import Experiment, make_experiment
from algorithms.runs.run_directory import Run, default_directory, imported_paths, versions
from mo_deepdrive.support.atomic_io import write_json
from mo_deepdrive.support.yaml import dump

VALUES: dict[str, Any] = {
    "environment": {"id": "mo-deepdrive-one-waypoint-v0"},
    "utility": {"name": "one_waypoint_linear"},
    "algorithm": {"name": "a2c"},
    "training": {"total_timesteps": 1000, "num_envs": 2, "seed": 3},
}


@pytest.fixture
def experiment() -> Experiment:
    return make_experiment(VALUES)


def test_a_new_run_stores_its_experiment_and_versions_of_which_changes_are_named(
    tmp_path: Path, experiment: Experiment
) -> None:
    run = Run.create(experiment, tmp_path / "a" / "run")
    run.unlock()
    assert Run.open(run.path).experiment == experiment
    assert run.status["state"] == "running"
    assert run.status["total_timesteps"] == 1000
    assert run.versions == versions()
    assert run.changed_versions() == []
    then = run.versions
    then["packages"]["torch"] = "0.1"
    write_json(run.path / "versions.json", then)
    (change,) = run.changed_versions()
    assert change.startswith("torch: 0.1 then")


def test_the_directory_of_a_run_is_refused_with_the_options_that_resume_it(
    tmp_path: Path, experiment: Experiment
) -> None:
    path = tmp_path / "a run"
    Run.create(experiment, path).unlock()
    with pytest.raises(ValueError, match=rf"is not empty; choose another, or use --resume '{path}'$"):
        Run.create(experiment, path)
    values = experiment.to_dict()
    values["algorithm"]["network"] = "my_networks:deep"
    (path / "config.yaml").write_text(dump(values))
    with pytest.raises(ValueError, match=rf"or use --resume '{path}' --trust$"):
        Run.create(experiment, path)
    (path / "config.yaml").write_text("{")
    with pytest.raises(ValueError, match=r"choose another$"):
        Run.create(experiment, path)


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


@pytest.mark.parametrize("name", [".lock", "checkpoint.safetensors"])
def test_a_run_with_a_link_is_not_locked_and_the_target_is_kept(
    tmp_path: Path, experiment: Experiment, name: str
) -> None:
    run = Run.create(experiment, tmp_path / "run")
    run.unlock()
    target = tmp_path / "target"
    target.mkdir()
    (run.path / name).unlink(missing_ok=True)
    (run.path / name).symlink_to(target)
    (tmp_path / "link").symlink_to(run.path)
    linked = Run.open(tmp_path / "link")
    with pytest.raises(ValueError, match=rf"{name}' leads to '.*target'; nothing is written or deleted through a link"):
        linked.lock()
    assert list(target.iterdir()) == []


OWN: dict[str, Any] = {"name": "own_code:utility"}


@pytest.mark.parametrize(
    ("sections", "key", "path"),
    [
        ({"utility": OWN}, "utility.name", "own_code:utility"),
        (
            {"utility": {"name": "one_waypoint_linear", "vehicles": {"vehicle_0": OWN}}},
            "utility.vehicles.vehicle_0.name",
            "own_code:utility",
        ),
        ({"environment": {"id": "own_code:own-v0"}}, "environment.id", "own_code:own-v0"),
        ({"algorithm": {"name": "own_code:Own"}}, "algorithm.name", "own_code:Own"),
        ({"algorithm": {"name": "a2c", "network": "own_code:network"}}, "algorithm.network", "own_code:network"),
    ],
)
def test_a_run_that_names_code_is_opened_only_if_it_is_trusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sections: dict[str, Any], key: str, path: str
) -> None:
    (tmp_path / "own_code.py").write_text(
        f"open({str(tmp_path / 'imported')!r}, 'w').close()\ndef utility(returns):\n    return returns[..., 0]\n"
        "from algorithms import A2C\nclass Own(A2C):\n    pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own_code", raising=False)
    monkeypatch.setitem(gymnasium.registry, "own-v0", gymnasium.registry["deep-sea-treasure-v0"])  # removed afterwards
    write_json(tmp_path / "config.yaml", {**VALUES, **sections})
    with pytest.raises(ValueError, match=rf"config\.yaml' has {key} = '{path}', code that .*; add --trust if"):
        Run.open(tmp_path)
    assert not (tmp_path / "imported").exists()
    assert Run.open(tmp_path, trust=True).path == tmp_path


def test_no_module_is_imported_that_hides_behind_one_of_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env_id = "gymnasium:evil:mo-deepdrive-one-waypoint-v0"
    (tmp_path / "gymnasium:evil.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'w').close()\n")
    monkeypatch.syspath_prepend(tmp_path)
    write_json(tmp_path / "config.yaml", {**VALUES, "environment": {"id": env_id}})
    with pytest.raises(ValueError, match=f"has environment.id = '{env_id}', code that .*; add --trust if"):
        Run.open(tmp_path)
    with pytest.raises(ValueError, match=f"environment.id = '{env_id}' must be an id, or of the form module:id"):
        Run.open(tmp_path, trust=True)
    assert not (tmp_path / "imported").exists()


def test_what_an_experiment_would_import_is_found_whatever_its_form() -> None:
    assert imported_paths(VALUES) == {}
    assert imported_paths({"environment": {"id": "mo_deepdrive:mo-deepdrive-one-waypoint-v0"}}) == {}
    assert imported_paths({"environment": {"id": "mo_deepdrive.own:x-v0"}}) == {
        "environment.id": "mo_deepdrive.own:x-v0"
    }
    for evil in ("gymnasium:evil:x-v0", "mo_deepdrive:mo_gymnasium:x-v0", ":x-v0"):
        assert imported_paths({"environment": {"id": evil}}) == {"environment.id": evil}
    assert imported_paths({"environment": 3, "utility": ["a:b"]}) == {}
    assert imported_paths({"utility": {"name": "mo_deepdrive:f"}}) == {"utility.name": "mo_deepdrive:f"}
    assert imported_paths({"algorithm": {"name": 3, "network": ["a:b"]}}) == {}
    assert imported_paths({"algorithm": ["a:b"]}) == {}
    assert imported_paths({"environment": {"id": 3}, "utility": {"name": None, "vehicles": "a:b"}}) == {}
