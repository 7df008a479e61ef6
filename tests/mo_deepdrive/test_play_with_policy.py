"""A policy that drives the other vehicle acts exactly as it does without a person in the environment."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from algorithms import MOA2C
from mo_deepdrive.evaluation.env_adapter import make_env
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.play import FRAMES_PER_DECISION, HumanPlayEnv, Keys, make_play_env
from mo_deepdrive.utilities import make_utility

INTERSECTION = "mo-deepdrive-intersection-v0"
REST = [*Keys(False, False, False, False), False]
DECISIONS = 20


def make_agent(**arguments: Any) -> MOA2C:
    """An agent whose policy depends on the observation."""
    env = make_env(INTERSECTION, 4, arguments)
    utility = make_utility("intersection_linear", env.unwrapped.objectives)  # type: ignore[attr-defined]
    agent = MOA2C(env, utility, steps=8, hidden=[8], learning_rate=0.01)
    agent.train(128)
    return agent


@pytest.mark.slow
@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
@pytest.mark.parametrize("mine", [0, 1])
def test_a_policy_drives_the_other_vehicle_as_it_would_without_a_person(mine: int, action_type: str) -> None:
    agent = make_agent(action_type=action_type, time_limit=3)
    env = make_play_env(INTERSECTION, action_type=action_type, time_limit=3)
    human_env = HumanPlayEnv(env, (mine,), policy=agent, generator=torch.Generator().manual_seed(5))
    human_env.reset(seed=1)
    for _ in range(DECISIONS * FRAMES_PER_DECISION):
        human_env.step(np.array(REST, dtype=np.int8))
    driven = env.batch.state[0].copy()

    generator = torch.Generator().manual_seed(5)
    observations, _ = env.reset(seed=1)
    accrued_reward = AccruedReward.begin(1, 2, env.reward_dim)
    for _ in range(DECISIONS):
        actions = agent.env.environment_actions(agent.act(observations, accrued_reward, generator))
        actions[0, mine] = 0 if action_type == "discrete" else (0.0, 0.0, -1.0)
        observations, rewards, *_ = env.step(actions)
        accrued_reward.add(rewards, agent.gamma)
    assert driven.tobytes() == env.batch.state[0].tobytes()
    assert driven[1 - mine].travelled > 0.0
