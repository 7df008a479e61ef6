"""Which runs differ in their seed alone, and which have comparable scores."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest

from algorithms.reporting.run_records import (
    RunRecord,
    distinct_labels,
    experiment_record,
    group_by_experiment,
    identifying_settings,
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
    ("key", "value"),
    [
        ("training.device", "cuda"),
        ("training.threads", 4),
        ("logging.interval", 1),
        ("logging.wandb", {"project": "p"}),
    ],
)
def test_where_a_run_was_made_and_what_it_logged_does_not_matter(key: str, value: Any) -> None:
    other = changed(key, value)
    other["training"]["seed"] = 1
    assert groups(CONFIG, other) == [[0, 1]]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("environment.arguments", {"time_limit": 30.0}),
        ("environment.id", "b-v0"),
        ("utility.name", "nonlinear"),
        ("algorithm.name", "a2c"),
        ("algorithm.hidden", [64, 32]),
        ("training.total_timesteps", 2000),
        ("training.num_envs", 4),
        ("evaluation.gamma", 1.0),
        ("evaluation.reference_point", [0.0, 0.0]),
    ],
)
def test_everything_else_separates_runs(key: str, value: Any) -> None:
    assert groups(CONFIG, changed(key, value)) == [[0], [1]]


def test_groups_and_their_runs_keep_the_order() -> None:
    other = changed("algorithm.name", "a2c")
    seeds = [changed("training.seed", seed) for seed in (3, 1)]
    assert groups(seeds[0], other, seeds[1]) == [[0, 2], [1]]


def test_the_order_of_keys_does_not_matter() -> None:
    backwards = {name: dict(reversed(section.items())) for name, section in reversed(CONFIG.items())}
    backwards["training"]["seed"] = 1
    assert groups(CONFIG, backwards) == [[0, 1]]
    settings = [list(identifying_settings(experiment_record(config))) for config in (backwards, CONFIG)]
    assert settings[0] == sorted(settings[1])


def test_a_repeated_seed_is_refused_naming_both_runs() -> None:
    with pytest.raises(ValueError, match="runs 'run0' and 'run2' are the same experiment with the same seed, 0"):
        groups(CONFIG, changed("training.seed", 1), changed("training.device", "cuda"))


@pytest.mark.parametrize(
    ("key", "value", "comparable"),
    [
        ("environment.arguments", {"time_limit": 30.0}, False),
        ("utility.arguments", {"weights": [1.0, 2.0]}, False),
        ("evaluation.gamma", 1.0, False),
        ("evaluation.reference_point", [0.0, 0.0], False),
        ("algorithm.name", "a2c", True),
        ("training.total_timesteps", 2000, True),
    ],
)
def test_scores_are_comparable_in_one_environment_under_one_utility(key: str, value: Any, comparable: bool) -> None:
    keys = [experiment_record(config).task_key for config in (CONFIG, changed(key, value))]
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
