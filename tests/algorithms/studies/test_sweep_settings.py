"""The settings of a sweep: what its YAML file may contain."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from algorithms.studies.manifest import Scores
from algorithms.studies.plan import SweepPlan
from algorithms.studies.settings import load_sweep
from tests.helpers.sweep_files import write_sweep

RATE = "algorithm.learning_rate"
METRIC = "greedy/utility_esr"


def refused(folder: Path, **settings: Any) -> str:
    """Why a sweep's file is refused."""
    with pytest.raises(ValueError, match="invalid sweep") as error:
        load_sweep(write_sweep(folder, **settings))
    return str(error.value)


@pytest.mark.parametrize(
    ("settings", "messages"),
    [
        ({"seedz": 3}, ["'seedz' is unknown", "did you mean 'seeds'?"]),
        ({"overrides": {RATE: 0.1}}, [f"'{RATE}' is in overrides and in grid"]),
        ({"grid": {"seed": [1, 2]}}, ["'seed' in grid: set seeds with the key 'seeds'"]),
        ({"overrides": {"training": {"seed": 1}}}, ["'training.seed' in overrides: set seeds with the key 'seeds'"]),
        (
            {"search": {"space": {RATE: [1, 2]}, "metric": METRIC, "trials": 1, "sampler": "random", "batch": 2}},
            ["'batch' has no effect with the sampler 'random'"],
        ),
        ({"seeds": [3, 5, 3]}, ["'seeds' = [3, 5, 3]: it has a duplicate"]),
        ({"grid": {RATE: []}}, [f"'grid.{RATE}' = []"]),
        ({"resources": {"cpus": 0}}, ["'resources.cpus' = 0"]),
        (
            {"grid": {RATE: [1]}, "search": {"space": {RATE: [1, 2]}, "metric": METRIC, "trials": 1}},
            [f"'{RATE}' is in grid and in search.space"],
        ),
        ({"search": {"space": {RATE: [1, 2]}}}, ["'search.metric' is missing", "'search.trials' is missing"]),
    ],
)
def test_an_invalid_setting_is_refused_with_its_name(
    tmp_path: Path, settings: dict[str, Any], messages: list[str]
) -> None:
    said = refused(tmp_path, **settings)
    assert "short.yaml" in said
    for message in messages:
        assert message in said


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"low": 3, "high": 2}, "(low=3, high=2)"),
        ({"low": 1.0, "high": 8, "log": True, "step": 2}, "log"),
        ({"low": 1, "high": 8, "step": 0}, "step"),
        ({"choices": [1, 2], "low": 0}, "'choices' excludes the other keys"),
        ({"low": 1}, "needs 'low' and 'high'"),
    ],
)
def test_an_invalid_range_is_refused_with_its_key(tmp_path: Path, values: Any, message: str) -> None:
    file = write_sweep(tmp_path, search={"space": {RATE: values}, "metric": METRIC, "trials": 1})
    with pytest.raises(ValueError, match=r"search\.space") as error:
        SweepPlan(load_sweep(file)).rows(Scores())
    said = str(error.value)
    assert f"search.space.{RATE}" in said
    assert message in said


def test_a_number_of_seeds_is_short_for_that_many_from_zero(tmp_path: Path) -> None:
    number, listed = (load_sweep(write_sweep(tmp_path, seeds=seeds)) for seeds in (3, [0, 1, 2]))
    assert number.seeds == listed.seeds == [0, 1, 2]
    assert load_sweep(write_sweep(tmp_path, seeds=[7, 2])).seeds == [7, 2]


def test_a_single_config_and_a_list_of_choices_are_short_forms(tmp_path: Path) -> None:
    settings = load_sweep(write_sweep(tmp_path, search={"space": {RATE: [1, 2]}, "metric": METRIC, "trials": 1e1}))
    assert settings.config == [str(tmp_path / "base.yaml")]
    assert settings.search is not None
    assert settings.search.space[RATE].choices == [1, 2]
    assert settings.search.trials == 10


def test_the_file_of_an_experiment_is_refused_with_the_command_for_it() -> None:
    message = "'one_waypoint/pcn' is the file of an experiment; mo-deepdrive train --config one_waypoint/pcn trains it"
    with pytest.raises(ValueError, match=message):
        load_sweep("one_waypoint/pcn")
