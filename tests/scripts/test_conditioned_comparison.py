"""``scripts/conditioned_comparison.py``: fronts of conditioned MO-PPO beside the best-known fronts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from algorithms.experiments.config import load_experiment
from tests.helpers.script_runs import refused

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from types import ModuleType

    from tests.helpers.script_runs import Call

SHORT = ("training.total_timesteps=8192", "algorithm.max_policies=20")


@pytest.fixture
def comparison(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """The script as a module."""
    return load_script("conditioned_comparison")


def test_the_configs_are_those_of_the_algorithm(comparison: ModuleType) -> None:
    for config in comparison.CONFIGS:
        assert load_experiment(config).algorithm.name == "conditioned_mo_ppo"


def test_a_run_is_measured_against_the_best_known_front(comparison: ModuleType) -> None:
    found = comparison.learn("one_waypoint/conditioned", SHORT, 3)
    assert (found.config, found.changed, found.seed) == ("one_waypoint/conditioned", " ".join(SHORT), 3)
    assert found.steps == 8192
    assert 0.0 <= found.hypervolume < 1.0
    assert found.expected_utility < 1.0
    assert found.policies >= 1


def test_the_table_has_means_and_ranges_and_the_file_every_run(comparison: ModuleType, tmp_path: Path) -> None:
    name = comparison.CONFIGS[0]
    results = [
        comparison.Result(name, "", 0, 100, 0.5, 0.7, 4, 2.0),
        comparison.Result(name, "", 1, 100, 0.6, 0.9, 6, 4.0),
        comparison.Result(name, "algorithm.switching=0", 1, 100, 0.1, 0.2, 6, 9.0),
    ]
    assert comparison.rows(results) == [
        [name, "", "2", "100", "55.0% (50.0% to 60.0%)", "80.0% (70.0% to 90.0%)", "3"],
        [name, "algorithm.switching=0", "1", "100", "10.0% (10.0% to 10.0%)", "20.0% (20.0% to 20.0%)", "9"],
    ]
    comparison.write_results(tmp_path / "runs.csv", results)
    assert comparison.read_results(tmp_path / "runs.csv", comparison.Result) == results


def test_a_comparison_is_continued(comparison: ModuleType, call: Call, tmp_path: Path) -> None:
    file = tmp_path / "runs.csv"
    name, changed = comparison.CONFIGS[0], " ".join(SHORT)
    known = [comparison.Result(name, each, 0, 8192, 0.25, 0.5, 4, 2.0) for each in (changed, "")]
    comparison.write_results(file, known)
    arguments = "--only", name, "--change", *SHORT, "--seeds", 0, 1, "--output", file
    code, shown, _ = call("conditioned_comparison", *arguments)
    assert code is None
    assert "25.0%" in shown
    results = comparison.read_results(file, comparison.Result)
    assert results[:2] == known
    assert [(each.changed, each.seed) for each in results[2:]] == [(changed, 1)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--output", "nowhere/runs.csv"], "there is no folder nowhere"),
        (["--change", "algorithm.switch=0"], "'switch'"),
        (["--change", "training.total_timesteps=0"], "'training.total_timesteps' = 0"),
        (["--change", "environment.arguments={}"], "no best-known front is shipped for it"),
    ],
)
@pytest.mark.usefixtures("comparison")
def test_invalid_options_are_refused(call: Call, arguments: list[str], message: str) -> None:
    refused(call("conditioned_comparison", "--only", "one_waypoint/conditioned", *arguments), message)
