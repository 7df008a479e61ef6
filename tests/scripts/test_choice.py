"""Intervals and ties of preferences over the policies of a front."""

from __future__ import annotations

import numpy as np
import pytest

from algorithms.commands.choose import distance_to_target, expected_utility, rank_policies, weighted_sum
from mo_deepdrive.evaluation.statistics import mean
from mo_deepdrive.utilities import make_utility

NAMES = ("distance", "destination", "g_force", "jerk")


@pytest.mark.parametrize("kind", ["weights", "utility", "target"])
def test_the_value_of_one_policy_has_an_interval_over_its_episodes(kind: str) -> None:
    preference = {
        "weights": weighted_sum({"distance": 1.0, "g_force": 2.0}, NAMES),
        "utility": expected_utility(make_utility("one_waypoint_nonlinear", NAMES)),
        "target": distance_to_target({"distance": 5.0}, NAMES, np.ones(4)),
    }[kind]
    returns = np.random.default_rng(1).normal(0.0, [20.0, 1.0, 5.0, 500.0], (400, 4))
    found = preference.estimate(returns)
    assert found.value == preference.values(returns[None])[0]
    assert found.low is not None
    assert found.high is not None
    assert found.low < found.value < found.high
    if kind == "weights":
        plain = mean(returns @ [1.0, 0.0, 2.0, 0.0])
        assert (found.low, found.high) == pytest.approx((plain.low, plain.high), abs=0.15)
    assert preference.estimate(returns[:2]).low is None


def test_policies_are_ranked_by_value_and_equal_ones_by_the_sum_of_scaled_returns() -> None:
    values = np.array([1.0, 3.0, 3.0 + 1e-12, 2.0])
    returns = np.array([[9.0, 9.0], [4.0, 0.0], [0.0, 2.0], [0.0, 0.0]])
    assert rank_policies(values, returns, np.array([1.0, 1.0])).tolist() == [1, 2, 3, 0]
    assert rank_policies(values, returns, np.array([4.0, 1.0])).tolist() == [2, 1, 3, 0]
    assert rank_policies(np.zeros(4), returns, np.array([1.0, 1.0])).tolist() == [0, 1, 2, 3]
