"""A2C: its advantages and targets on an episode worked out by hand; its losses are tested with MO-A2C's."""

from __future__ import annotations

import pytest
import torch

from algorithms import A2C
from mo_deepdrive.utilities import make_utility
from tests.helpers.agents import handmade, make_agent


def test_advantages_and_targets_of_three_steps_by_hand() -> None:
    utility = make_utility("linear", ("distance", "destination", "g_force", "jerk"), weights=[1.0, 10.0, 0.0, 0.0])
    agent = make_agent(A2C, num_envs=1, utility=utility, gamma=0.5, gae_lambda=0.5)
    rollout = handmade(agent, steps=3)
    rollout.rewards[:, 0] = torch.tensor([[2.0, 0.0, 9.0, 9.0], [0.0, 0.0, 9.0, 9.0], [1.0, 1.0, 9.0, 9.0]])
    rollout.terminated[:], rollout.truncated[:] = False, False
    rollout.terminated[2] = True
    values, next_values = torch.tensor([[[4.0]], [[2.0]], [[6.0]]]), torch.tensor([[[2.0]], [[6.0]], [[0.0]]])
    advantages, targets = agent.advantages(rollout.rollout(agent), values, next_values)
    # Equation 1: 2 + 0.5 * 2 - 4, 0 + 0.5 * 6 - 2, 11 - 6; equation 2 with gamma lambda = 0.25, from the end.
    deltas = [-1.0, 1.0, 5.0]
    expected = [deltas[0] + 0.25 * (deltas[1] + 0.25 * deltas[2]), deltas[1] + 0.25 * deltas[2], deltas[2]]
    assert advantages[:, 0].tolist() == pytest.approx(expected)
    assert (targets - values)[:, 0, 0].tolist() == pytest.approx(expected)


def test_the_policy_does_not_depend_on_the_accrued_reward() -> None:
    agent = make_agent(A2C)
    observations, discounts = torch.ones(2, 15), torch.tensor([1.0, 0.5])
    inputs = agent.inputs(observations, torch.tensor([[0.0] * 4, [9.0] * 4]), discounts)
    assert torch.equal(inputs[0], inputs[1])
