"""``scripts/esr_comparison.py``: what the methods share and in what they differ."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from algorithms.experiments.config import load_experiment
from tests.helpers.script_runs import refused

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import ModuleType

    from tests.helpers.script_runs import Call


@pytest.fixture
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """The script as a module."""
    return load_script("esr_comparison")


def experiment_of(script: ModuleType, task: str, method: str, rate: float = 1.0, seed: int = 20) -> dict[str, Any]:
    values: dict[str, Any] = script.make_run_experiment(script.Run(task, method, rate, seed, 5000)).to_dict()
    return values


def test_methods_have_the_settings_of_the_shipped_files(script: ModuleType) -> None:
    for title, task in script.TASKS.items():
        shipped = {name: load_experiment(getattr(task, name), []).to_dict() for name in ("ppo", "mo_ppo")}
        for method in script.METHODS:
            found = experiment_of(script, title, method)
            wanted = shipped["ppo" if method == script.PPO else "mo_ppo"]
            assert found["environment"] == wanted["environment"]
            assert found["utility"]["name"] == title
            assert found["training"] == wanted["training"] | {"total_timesteps": 5000, "seed": 20}
            different = {
                key for key, value in found["algorithm"].items() if wanted["algorithm"].get(key, value) != value
            }
            if method == script.MOCAC:
                assert different <= {"name", "gamma", "observe_discount"}
                assert found["algorithm"]["objective_scales"] == wanted["algorithm"]["objective_scales"]
            elif method == script.UNDISCOUNTED:
                assert different <= {"advantage", "gamma"}
                assert found["algorithm"]["gamma"] == found["algorithm"]["accrued_gamma"] == 1.0
            else:
                assert different <= {"advantage"}


def test_rates_and_splits_are_those_of_tuning(script: ModuleType) -> None:
    task = "static_obstacle_nonlinear"
    one, three = (experiment_of(script, task, "mocac", rate) for rate in (1.0, 3.0))
    assert three["algorithm"]["learning_rate"] == pytest.approx(3.0 * one["algorithm"]["learning_rate"])
    seeds = script.TUNING_SEED, 20
    splits = [script.make_run_experiment(script.Run(task, "ppo", 1.0, seed, 5000)).evaluation.split for seed in seeds]
    assert splits == ["validation", "test"]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ppo", "expected_utility"])
def test_a_run_is_trained_and_scored(script: ModuleType, method: str) -> None:
    found = script.learn(script.Run("one_waypoint_nonlinear", method, 3.0, 20, 8192))
    assert (found.learner, found.rate, found.seed, found.taken) == (method, "3", 20, 8192)
    assert found.first < 30.0
    assert 0.0 <= found.second <= 1.0
    assert found.seconds > 0.0


def test_the_table_leaves_tuning_out(script: ModuleType) -> None:
    runs = [("1", script.TUNING_SEED, 9.0), ("1", 20, 1.0), ("1", 21, 2.0)]
    results = [
        script.Result("one_waypoint_nonlinear", "ppo", rate, seed, 500, 500, utility, 0.5, 2.0)
        for rate, seed, utility in runs
    ]
    [row] = script.table_rows(results)
    assert row[:6] == ["one_waypoint_nonlinear", "ppo", "1", "2", "500", "2"]
    assert row[7:] == ["1.00, 2.00", "50.0"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--steps", "0"], "--steps 0 must be at least 1"),
        (["--only", "one_waypoint_linear"], "invalid choice: 'one_waypoint_linear'"),
    ],
)
@pytest.mark.usefixtures("script")
def test_invalid_arguments_are_refused(call: Call, arguments: list[str], message: str) -> None:
    refused(call("esr_comparison", "--output", "found.csv", *arguments), message)
