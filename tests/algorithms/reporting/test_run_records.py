"""Runs as they are read: what they are called, which are found, and which differ in their seed alone."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest

from algorithms.reporting.run_records import (
    RunRecord,
    distinct_labels,
    experiment_record,
    find_runs,
    group_by_experiment,
)

CONFIG: dict[str, Any] = {
    "environment": {"id": "a-v0", "arguments": {"time_limit": 60.0}},
    "utility": {"name": "linear", "arguments": {}, "vehicles": {}},
    "algorithm": {"name": "mo_a2c", "hidden": [64, 64]},
    "training": {"total_timesteps": 1000, "num_envs": 2, "seed": 0, "device": "cpu", "threads": 1},
    "evaluation": {"gamma": 0.99, "reference_point": None},
    "logging": {"interval": 10, "wandb": None},
}


def changed(key: str, value: Any) -> dict[str, Any]:
    """The config with another value of ``section.key``."""
    config = copy.deepcopy(CONFIG)
    section, name = key.split(".")
    config[section][name] = value
    return config


def groups(*configs: dict[str, Any]) -> list[list[int]]:
    runs = [RunRecord(Path(f"run{i}"), experiment_record(config), {}, {}) for i, config in enumerate(configs)]
    return [[runs.index(run) for run in members] for members in group_by_experiment(runs)]


@pytest.mark.parametrize(
    ("key", "value", "together", "comparable"),
    [
        ("training.device", "cuda", True, True),
        ("training.threads", 4, True, True),
        ("logging.wandb", {"project": "p"}, True, True),
        ("algorithm.name", "a2c", False, True),
        ("algorithm.hidden", [64, 32], False, True),
        ("training.total_timesteps", 2000, False, True),
        ("environment.arguments", {"time_limit": 30.0}, False, False),
        ("environment.id", "b-v0", False, False),
        ("utility.name", "nonlinear", False, False),
        ("utility.arguments", {"weights": [1.0, 2.0]}, False, False),
        ("evaluation.gamma", 1.0, False, False),
        ("evaluation.reference_point", [0.0, 0.0], False, False),
    ],
)
def test_what_differs_decides_whether_runs_are_one_experiment_and_whether_their_scores_are_comparable(
    key: str, value: Any, together: bool, comparable: bool
) -> None:
    other = changed(key, value)
    other["training"]["seed"] = 1
    assert groups(CONFIG, other) == ([[0, 1]] if together else [[0], [1]])
    keys = [experiment_record(config).task_key for config in (CONFIG, other)]
    assert (keys[0] == keys[1]) is comparable


def test_sections_of_one_name_are_told_apart_by_what_differs() -> None:
    sections: list[Any] = [
        {"name": "linear", "arguments": {"weights": [100, 1], "scale": 2}},
        {"name": "linear", "arguments": {"weights": [1, 1], "scale": 2}},
        {"name": "owa", "arguments": {"weights": [1, 1]}},
        None,
    ]
    found = distinct_labels([section["name"] if section else "" for section in sections], sections)
    assert found == ["linear weights=[100, 1]", "linear weights=[1, 1]", "owa", ""]


def test_files_below_a_run_are_no_runs(tmp_path: Path) -> None:
    run = tmp_path / "run"
    of_wandb = run / "wandb/run-1/files"
    of_wandb.mkdir(parents=True)
    for folder in (run, of_wandb):
        (folder / "config.yaml").write_text("_wandb: {}")
    assert find_runs([tmp_path], pytest.fail) == find_runs([run], pytest.fail) == [run]
