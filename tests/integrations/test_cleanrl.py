"""CleanRL-style loops: everything in one file, on ``make_vec`` and on ``SyncVectorEnv`` with its stack of wrappers."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.wrappers.vector import RecordEpisodeStatistics, TransformReward

from mo_deepdrive.utilities import make_utility
from tests.integrations.envs import scalar, vector

pytestmark = pytest.mark.filterwarnings("ignore")


def train(envs: Any, updates: int = 4, steps: int = 32) -> tuple[float, list[float]]:
    """Advantage actor-critic in the style of CleanRL's ``ppo.py``: the last loss and the returns of the episodes."""
    generator = torch.Generator().manual_seed(0)
    size = int(np.prod(envs.single_observation_space.shape))
    actor = torch.nn.Linear(size, int(envs.single_action_space.n))
    critic = torch.nn.Linear(size, 1)
    optimiser = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=1e-3)
    observations, _ = envs.reset(seed=0)
    following = torch.as_tensor(observations, dtype=torch.float32)
    returns: list[float] = []
    for _ in range(updates):
        log_probs, values, rewards, dones = [], [], [], []
        for _ in range(steps):
            distribution = torch.distributions.Categorical(logits=actor(following))
            actions = torch.multinomial(distribution.probs, 1, generator=generator)[:, 0]
            log_probs.append(distribution.log_prob(actions))
            values.append(critic(following)[:, 0])
            observations, reward, terminated, truncated, infos = envs.step(actions.numpy())
            following = torch.as_tensor(observations, dtype=torch.float32)
            rewards.append(torch.as_tensor(reward, dtype=torch.float32))
            dones.append(torch.as_tensor(np.logical_or(terminated, truncated), dtype=torch.float32))
            if "episode" in infos:
                returns += infos["episode"]["r"][infos["_episode"]].tolist()
        target = critic(following)[:, 0].detach()
        loss = torch.zeros(())
        for t in reversed(range(steps)):
            target = rewards[t] + 0.99 * (1.0 - dones[t]) * target
            advantage = target - values[t]
            loss = loss - (log_probs[t] * advantage.detach()).mean() + 0.5 * advantage.square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return loss.item(), returns


def test_a_loop_trains_on_gymnasiums_vector_environment() -> None:
    loss, returns = train(RecordEpisodeStatistics(gymnasium.vector.SyncVectorEnv([scalar] * 4)))
    assert np.isfinite(loss)
    assert len(returns) >= 16
    assert np.isfinite(returns).all()


def test_a_loop_trains_on_the_native_vector_environment() -> None:
    envs = vector(num_envs=4)
    envs = TransformReward(envs, make_utility("one_waypoint_linear", envs.objectives))
    loss, returns = train(RecordEpisodeStatistics(envs))
    assert np.isfinite(loss)
    assert len(returns) >= 16


def test_the_wrappers_of_cleanrls_continuous_ppo_run() -> None:
    def thunk() -> Any:
        env = gymnasium.wrappers.FlattenObservation(scalar(action_type="continuous"))
        env = gymnasium.wrappers.RecordEpisodeStatistics(env)
        env = gymnasium.wrappers.ClipAction(env)
        env = gymnasium.wrappers.NormalizeObservation(env)
        env = gymnasium.wrappers.TransformObservation(env, lambda o: np.clip(o, -10, 10), env.observation_space)
        env = gymnasium.wrappers.NormalizeReward(env, gamma=0.99)
        return gymnasium.wrappers.TransformReward(env, lambda reward: np.clip(reward, -10, 10))

    envs = gymnasium.vector.SyncVectorEnv([thunk] * 2)
    envs.action_space.seed(0)
    envs.reset(seed=0)
    lengths: list[int] = []
    for _ in range(60):
        _, rewards, _, _, infos = envs.step(envs.action_space.sample())
        assert rewards.shape == (2,)
        if "episode" in infos:
            lengths += infos["episode"]["l"][infos["_episode"]].tolist()
    assert len(lengths) >= 4
