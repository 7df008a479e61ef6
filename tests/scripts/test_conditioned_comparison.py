"""``scripts/conditioned_comparison.py``: fronts of conditioned MO-PPO beside the best-known fronts."""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING

import pytest

from algorithms.experiments.config import load_experiment

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from types import ModuleType


@pytest.fixture
def comparison(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """The script as a module."""
    return load_script("conditioned_comparison")


def test_the_configs_are_those_of_the_algorithm(comparison: ModuleType) -> None:
    for config in comparison.CONFIGS:
        assert load_experiment(config).algorithm["name"] == "conditioned_mo_ppo"


def test_a_run_is_measured_against_the_best_known_front(comparison: ModuleType) -> None:
    found = comparison.learn("one_waypoint/conditioned", 3, 8192)
    assert (found.config, found.seed, found.steps) == ("one_waypoint/conditioned", 3, 8192)
    assert 0.0 <= found.hypervolume < 1.0
    assert found.expected_utility < 1.0
    assert found.policies >= 1


def test_the_table_has_means_and_ranges_and_the_file_every_run(comparison: ModuleType, tmp_path: Path) -> None:
    name = comparison.CONFIGS[0]
    results = [comparison.Result(name, 0, 100, 0.5, 0.7, 4, 2.0), comparison.Result(name, 1, 100, 0.6, 0.9, 6, 4.0)]
    assert comparison.rows(results) == [
        [name, "2", "100", "55.0% (50.0% to 60.0%)", "80.0% (70.0% to 90.0%)", "3"],
    ]
    comparison.write_results(tmp_path / "runs.csv", results)
    with (tmp_path / "runs.csv").open(newline="") as file:
        written = list(csv.DictReader(file))
    assert [row["hypervolume"] for row in written] == ["0.5000", "0.6000"]
    assert [row["seed"] for row in written] == ["0", "1"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--steps", "0"], "--steps 0 must be at least 1"),
        (["--output", "nowhere/runs.csv"], "there is no folder nowhere"),
    ],
)
def test_invalid_options_are_refused(
    comparison: ModuleType, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        comparison.main(arguments)
    assert message in capsys.readouterr().err
