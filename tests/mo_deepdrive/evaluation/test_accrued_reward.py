"""What an episode has come to so far, against a plain loop."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mo_deepdrive.evaluation.accrued_reward import AccruedReward


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.5, 0.99, 1.0]), st.integers(0, 12))
def test_every_vehicle_has_the_discounted_sum_of_the_rewards_of_its_episode(
    seed: int, gamma: float, decisions: int
) -> None:
    n, v, d = 3, 2, 2
    rng = np.random.default_rng(seed)
    accrued_reward = AccruedReward.begin(n, v, d)
    episodes: list[list[list[np.ndarray]]] = [[[] for _ in range(v)] for _ in range(n)]
    for _ in range(decisions):
        rewards = rng.normal(size=(n, v, d)).astype(np.float32)
        accrued_reward.add(rewards, gamma)
        over = rng.random((n, v)) < 0.2
        accrued_reward.restart(over)
        for i in range(n):
            for j in range(v):
                episodes[i][j] = [] if over[i, j] else [*episodes[i][j], rewards[i, j]]
    for i in range(n):
        for j in range(v):
            rewards_of = episodes[i][j]
            accrued = sum((gamma**t * r for t, r in enumerate(rewards_of)), np.zeros(d))
            np.testing.assert_allclose(accrued_reward.value[i, j], accrued, atol=1e-5)
            assert accrued_reward.discounts[i, j] == pytest.approx(gamma ** len(rewards_of))
            assert accrued_reward.decisions[i, j] == len(rewards_of)


def test_take_copies_environments_in_the_given_order() -> None:
    accrued_reward = AccruedReward.begin(3, 1, 2)
    accrued_reward.add(np.arange(6, dtype=np.float32).reshape(3, 1, 2), 0.5)
    part = accrued_reward.take(np.array([2, 0, 2]))
    np.testing.assert_array_equal(part.value[:, 0], [[4.0, 5.0], [0.0, 1.0], [4.0, 5.0]])
    part.add(np.ones((3, 1, 2), dtype=np.float32), 0.5)
    part.restart(np.array([[True], [False], [False]]))
    np.testing.assert_array_equal(accrued_reward.value[2, 0], [4.0, 5.0])
    np.testing.assert_array_equal(accrued_reward.decisions[:, 0], [1, 1, 1])
    np.testing.assert_array_equal(part.decisions[:, 0], [0, 2, 2])
    np.testing.assert_array_equal(part.discounts[:, 0], [1.0, 0.25, 0.25])
