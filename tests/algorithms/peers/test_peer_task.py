"""Tasks and policies of peers."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from algorithms.peers.peer_task import PeerPolicies, PolicyInputs
from mo_deepdrive.evaluation.env_adapter import make_env
from mo_deepdrive.evaluation.episodes import evaluate_each
from mo_deepdrive.utilities import make_utility
from tests.helpers.peers import FIXED, ONE_WAYPOINT, constant_policies, make_task


def test_policies_see_the_accrued_reward_in_their_units() -> None:
    task = make_task()
    inputs: list[PolicyInputs] = []

    def choose(rows: Any, each: PolicyInputs) -> Any:
        inputs.append(each)
        return np.full(len(rows), 3)

    policies = PeerPolicies(task, choose, np.zeros((2, 0)), gamma=0.5)
    found = evaluate_each(policies.at, 2, make_env(ONE_WAYPOINT, 2, FIXED), episodes=1, seed=0, gamma=1.0)
    assert [each.decisions.tolist() for each in inputs] == [[t, t] for t in range(30)]
    env = task.make()
    observation, _ = env.reset()
    accrued, factor = np.zeros(4), 1.0
    for each in inputs[:10]:
        np.testing.assert_allclose(each.observations[0], observation, rtol=1e-6)
        np.testing.assert_allclose(each.accrued[1], accrued, rtol=1e-4, atol=1e-6)
        observation, reward, *_ = env.step(3)
        accrued, factor = accrued + factor * reward, factor * 0.5
    assert found[0].lengths[0, 0] == 30


def test_a_policy_is_found_by_its_condition() -> None:
    policies = constant_policies(make_task(), [0, 2, 3])
    assert policies.policy([2.0]).rows.tolist() == [1]
    assert len(policies) == 3


def test_the_utility_of_scaled_returns_equals_that_of_the_unscaled_returns() -> None:
    utility = make_utility("one_waypoint_nonlinear", ("distance", "destination", "g_force", "jerk"))
    task = make_task(utility=utility)
    returns = np.array([[12.0, 1.0, -4.0, -90.0], [0.5, 0.0, -1.0, -10.0]], dtype=np.float32)
    scaled = returns / task.reward_scales
    np.testing.assert_allclose(task.utility_of_scaled(scaled), utility(returns), rtol=1e-5)
    tensor = torch.tensor(scaled, requires_grad=True)
    task.utility_of_scaled(tensor).sum().backward()
    assert tensor.grad is not None
    assert task.utility_of_scaled(scaled[0], None).shape == ()
