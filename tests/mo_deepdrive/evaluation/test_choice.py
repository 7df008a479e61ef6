"""Preferences over the policies of a front, against plain computations over their episodes."""

from __future__ import annotations

import numpy as np
import pytest

from mo_deepdrive.evaluation.choice import distance_to_target, expected_utility, rank_policies, weighted_sum
from mo_deepdrive.evaluation.statistics import mean
from mo_deepdrive.utilities import make_utility

NAMES = ("distance", "destination", "g_force", "jerk")
RETURNS = np.random.default_rng(0).normal(0.0, [20.0, 1.0, 5.0, 500.0], (6, 8, 4))  # policies, episodes, objectives


def test_a_utility_is_averaged_over_the_episodes_and_not_taken_of_their_mean() -> None:
    utility = make_utility("one_waypoint_nonlinear", NAMES)
    preference = expected_utility(utility)
    expected = [sum(float(utility(episode)) for episode in policy) / 8 for policy in RETURNS]
    np.testing.assert_allclose(preference.values(RETURNS), expected)
    assert not np.allclose(utility(RETURNS.mean(axis=1)), expected)
    assert preference.name == "expected one_waypoint_nonlinear"


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


def test_only_shortfalls_of_named_objectives_count_towards_the_distance_to_a_target() -> None:
    scales = np.array([10.0, 1.0, 2.0, 100.0])
    means = RETURNS.mean(axis=1)
    target = {"distance": float(np.median(means[:, 0])), "jerk": 1e4}
    expected = [
        -(((max(0.0, target["distance"] - row[0]) / 10.0) ** 2 + (max(0.0, 1e4 - row[3]) / 100.0) ** 2) ** 0.5)
        for row in means
    ]
    np.testing.assert_allclose(distance_to_target(target, NAMES, scales).values(RETURNS), expected)


def test_policies_are_ranked_by_value_and_equal_ones_by_the_sum_of_scaled_returns() -> None:
    values = np.array([1.0, 3.0, 3.0 + 1e-12, 2.0])
    returns = np.array([[9.0, 9.0], [4.0, 0.0], [0.0, 2.0], [0.0, 0.0]])
    assert rank_policies(values, returns, np.array([1.0, 1.0])).tolist() == [1, 2, 3, 0]
    assert rank_policies(values, returns, np.array([4.0, 1.0])).tolist() == [2, 1, 3, 0]
    assert rank_policies(np.zeros(4), returns, np.array([1.0, 1.0])).tolist() == [0, 1, 2, 3]
