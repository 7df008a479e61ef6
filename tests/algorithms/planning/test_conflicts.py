"""Correlations of returns over a population of drivers."""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING

import numpy as np
import pytest
import scipy

from algorithms.planning.conflicts import (
    Conflicts,
    RuleDrivers,
    correlations,
    find_conflicts,
    find_rule_conflicts,
    plot_conflicts,
    write_conflicts,
)
from algorithms.planning.driving_rules import random_rules

if TYPE_CHECKING:
    from pathlib import Path

SEED = 2_000_000


@pytest.mark.slow
def test_a_correlation_is_spearmans_with_an_interval_around_it() -> None:
    rng = np.random.default_rng(0)
    first = rng.normal(size=60)
    returns = np.stack([first, -first + rng.normal(size=60), np.round(first), np.ones(60)], axis=1)
    found = correlations(returns, ("a", "b", "c", "constant"))
    for (i, j), pair in {(0, 1): ("a", "b"), (0, 2): ("a", "c"), (1, 2): ("b", "c")}.items():
        expected = scipy.stats.spearmanr(returns[:, i], returns[:, j]).statistic
        assert found[pair].value == pytest.approx(expected)
        assert found[pair].low < expected < found[pair].high
    assert found["a", "b"].high < 0.0
    assert np.isnan(found["a", "constant"].value)
    assert np.isnan(correlations(returns[:5], ("a", "b", "c", "d"))["a", "b"].value)


@pytest.mark.parametrize("vehicles", [1, 2])
def test_a_driver_acts_in_a_batch_as_it_does_alone(vehicles: int) -> None:
    rng = np.random.default_rng(1)
    drivers = random_rules(20, rng)
    observations = rng.normal(size=(20, vehicles, 15) if vehicles > 1 else (20, 15)).astype(np.float32)
    discounts = np.full((20, vehicles) if vehicles > 1 else 20, 0.99**50)
    together = RuleDrivers(drivers)(observations, observations, discounts)
    assert together.shape == discounts.shape
    for i in range(20):
        rows = slice(i, i + 1)
        alone = RuleDrivers(drivers[rows])(observations[rows], observations[rows], discounts[rows])
        np.testing.assert_array_equal(alone[0], together[i])


@pytest.mark.slow
def test_the_fixed_rules_of_left_turn_trade_time_for_safety() -> None:
    found = find_rule_conflicts(rules=12, episodes=20, seed=SEED)
    assert found.population == "LeftTurn, fixed rules"
    assert found.correlations["collision", "time"].value < -0.3


@pytest.mark.slow
def test_the_same_population_gives_the_same_table_and_picture(tmp_path: Path) -> None:
    files = [tmp_path / "first.csv", tmp_path / "second.csv"]
    conflicts: list[Conflicts] = []
    for file in files:
        conflicts = [find_conflicts("static_obstacle", drivers=60, episodes=4, seed=SEED)]
        write_conflicts(file, conflicts)
    assert files[0].read_bytes() == files[1].read_bytes()
    with files[0].open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert {row["population"] for row in rows} == {"StaticObstacle"}
    assert len(rows) == 10
    plot_conflicts(tmp_path / "picture.png", conflicts, "a note")
    assert (tmp_path / "picture.png").stat().st_size > 1000
