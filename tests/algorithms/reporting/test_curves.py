"""Learning curves: how runs are grouped and aligned, and what is drawn in one panel."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from algorithms.reporting.curves import (
    CurveGroup,
    curve,
    curve_panels,
    load_groups,
)
from algorithms.reporting.run_records import experiment_record
from algorithms.reporting.style import MAX_POINTS
from algorithms.reporting.training_log import MetricsFile
from algorithms.runs.config import make_experiment
from mo_deepdrive.support.yaml import dump

Make = Callable[..., Path]


@pytest.fixture
def make(tmp_path: Path) -> Make:
    """Make the directory of a run, with metrics."""

    def make(name: str, algorithm: str = "mo_a2c", seed: int = 0, **hyperparameters: Any) -> Path:
        values = {
            "environment": {"id": "mo-deepdrive-one-waypoint-v0"},
            "utility": {"name": "one_waypoint_linear"},
            "algorithm": {"name": algorithm, **hyperparameters},
            "training": {"total_timesteps": 1000, "num_envs": 2, "seed": seed},
        }
        path = tmp_path / name
        path.mkdir()
        (path / "config.yaml").write_text(dump(make_experiment(values).to_dict()))
        metrics = MetricsFile(path / "metrics.csv")
        for step in range(5):
            metrics.write(10 * step, {"eval/greedy/utility_esr": step + seed, "eval/greedy/success": 0.5})
        return path

    return make


def test_runs_that_differ_in_their_seed_alone_are_one_group(make: Make) -> None:
    runs = [make("a", seed=0), make("b", seed=1), make("c", "a2c", seed=0), make("d", seed=2, gamma=0.9)]
    groups = load_groups(runs)
    assert [len(group.runs) for group in groups] == [1, 2, 1]
    assert [group.label for group in groups] == ["a2c", "mo_a2c algorithm.gamma=0.99", "mo_a2c algorithm.gamma=0.9"]


def test_a_curve_is_the_mean_within_its_interval() -> None:
    steps = np.arange(5.0)
    runs = [{"step": steps, "a": steps + offset} for offset in (-1.0, 0.0, 1.0)]
    found = curve(runs, "a")
    assert found is not None
    grid, mean, low, high = found
    np.testing.assert_array_equal(grid, steps)
    np.testing.assert_allclose(mean, steps)
    assert (low < mean).all()
    assert (mean < high).all()


def test_runs_of_different_length_are_compared_up_to_the_shortest() -> None:
    runs = [
        {"step": np.array([0.0, 10.0, 20.0]), "a": np.zeros(3)},
        {"step": np.array([0.0, 5.0, 15.0]), "a": np.ones(3)},
    ]
    found = curve(runs, "a")
    assert found is not None
    np.testing.assert_array_equal(found[0], [0.0, 10.0])


def test_rows_without_a_value_are_skipped_and_long_curves_averaged() -> None:
    steps = np.arange(1000.0)
    values = np.where(steps % 2 == 0, steps, np.nan)
    found = curve([{"step": steps, "a": values}], "a")
    assert found is not None
    assert len(found[0]) == MAX_POINTS
    np.testing.assert_allclose(found[0], found[1])
    assert np.isnan(found[2]).all()
    assert curve([{"step": steps, "a": np.full(1000, np.nan)}], "a") is None
    assert curve([{"step": steps}], "a") is None


def test_scores_under_other_arguments_have_separate_panels_that_name_them() -> None:
    def group(algorithm: str, size: int = 8, weight: int = 1, gamma: float = 0.99, split: str = "test") -> CurveGroup:
        config = {
            "environment": {"id": "theirs-v0", "arguments": {"size": size}},
            "utility": {"name": "linear", "arguments": {"weights": [weight, 1]}, "vehicles": {}},
            "algorithm": {"name": algorithm},
            "training": {"seed": 0},
            "evaluation": {"gamma": gamma, "reference_point": None, "split": split},
        }
        return CurveGroup(
            algorithm, experiment_record(config), ({"step": np.zeros(1), "eval/greedy/utility_esr": np.ones(1)},)
        )

    def panels(other: CurveGroup) -> dict[str, tuple[int, ...]]:
        return {panel.title: panel.groups for panel in curve_panels([group("ppo"), other])}

    assert panels(group("mo_ppo")) == {"Utility per episode": (0, 1)}
    for other, key, first, second in (
        (group("mo_ppo", weight=9), "utility.arguments.weights", [1, 1], [9, 1]),
        (group("mo_ppo", size=9), "environment.arguments.size", 8, 9),
        (group("mo_ppo", gamma=1.0), "evaluation.gamma", 0.99, 1.0),
    ):
        assert panels(other) == {f"Utility: {key}={first}": (0,), f"Utility: {key}={second}": (1,)}
    assert panels(group("mo_ppo", split="validation")) == {"Utility per episode": (0, 1)}, "of the final scores alone"
