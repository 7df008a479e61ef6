"""Tianshou: scalar rewards, by ``UtilityReward``."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

import mo_deepdrive
from tests.integrations.envs import TWO, scalar, single

pytestmark = pytest.mark.filterwarnings("ignore")


class WithoutTexts(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Tianshou takes a text that only the last step's info has for a missing value in all others."""

    def step(self, action: Any) -> Any:
        *result, info = self.env.step(action)
        return *result, {name: value for name, value in info.items() if not isinstance(value, str)}


def numeric(**options: Any) -> Any:
    return WithoutTexts(scalar(**options))


def untrained_policy(env: Any, **arguments: Any) -> Any:
    from tianshou.algorithm.modelfree.dqn import DiscreteQLearningPolicy
    from tianshou.utils.net.common import Net

    net = Net(state_shape=env.observation_space.shape, action_shape=env.action_space.n, hidden_sizes=[8])
    spaces = {"action_space": env.action_space, "observation_space": env.observation_space}
    return DiscreteQLearningPolicy(model=net, **spaces, **arguments)


def test_its_algorithms_train_if_infos_have_no_texts() -> None:
    from tianshou.algorithm import DQN
    from tianshou.algorithm.optim import AdamOptimizerFactory
    from tianshou.data import Collector, VectorReplayBuffer
    from tianshou.env import DummyVectorEnv
    from tianshou.trainer import OffPolicyTrainerParams

    policy = untrained_policy(numeric(), eps_training=0.1)
    algorithm = DQN(policy=policy, optim=AdamOptimizerFactory(lr=1e-3), gamma=0.99, target_update_freq=10)
    training = Collector(algorithm, DummyVectorEnv([numeric] * 2), VectorReplayBuffer(500, 2), exploration_noise=True)
    training.reset()
    result = algorithm.run_training(
        OffPolicyTrainerParams(
            training_collector=training,
            test_collector=Collector(algorithm, DummyVectorEnv([numeric] * 2)),
            max_epochs=1,
            epoch_num_steps=200,
            collection_step_num_env_steps=20,
            batch_size=16,
            update_step_num_gradient_steps_per_sample=0.1,
            test_step_num_episodes=2,
            show_progress=False,
            verbose=False,
        )
    )
    assert result.train_step >= 200
    assert np.isfinite(result.best_reward)


def test_a_collector_keeps_vector_rewards() -> None:
    from tianshou.data import Collector, VectorReplayBuffer
    from tianshou.env import DummyVectorEnv

    collector = Collector(untrained_policy(single()), DummyVectorEnv([single] * 2), VectorReplayBuffer(200, 2))
    collector.reset()
    statistics = collector.collect(n_step=100)
    assert collector.buffer.rew.shape == (200, 4)
    assert statistics.returns.shape == (4, 4)


def test_the_aec_environment_runs_in_turns() -> None:
    pytest.importorskip("momaland")
    from tianshou.env.pettingzoo_env import PettingZooEnv

    env = PettingZooEnv(mo_deepdrive.env(**TWO))
    observation, _ = env.reset(seed=0)
    for vehicle in ("vehicle_0", "vehicle_1") * 5:
        assert observation["agent_id"] == vehicle
        observation, rewards, *_ = env.step(3)
        assert np.shape(rewards) == (2, 6)
