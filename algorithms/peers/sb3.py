"""Adapters of Stable-Baselines3: scalar algorithms, which learn a known utility."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from algorithms.peers.task import Policies, ScalarConfig, Seen, Task
from mo_deepdrive.wrappers import UtilityReward


def a2c(task: Task) -> Policies:
    """Synchronous advantage actor-critic (Mnih et al. 2016)."""
    from stable_baselines3 import A2C

    return _train(task, A2C)


def ppo(task: Task) -> Policies:
    """Proximal policy optimisation (Schulman et al. 2017)."""
    from stable_baselines3 import PPO

    return _train(task, PPO)


def _train(task: Task, algorithm: Any) -> Policies:
    from stable_baselines3.common.vec_env import DummyVecEnv

    config, utility = task.config, task.utility
    assert isinstance(config, ScalarConfig)
    assert utility is not None

    def maker(index: int) -> Any:
        # The utility reads the environment's own rewards.
        return lambda: UtilityReward(task.make(index, scaled_rewards=False), utility, config.utility_of)

    env = DummyVecEnv([maker(index) for index in range(task.num_envs)])
    options = task.arguments(policy="MlpPolicy", gamma=config.gamma, seed=task.seed, device=task.device, verbose=0)
    model = algorithm(env=env, **options)
    model.learn(task.steps, **task.train_arguments())
    env.close()

    def choose(rows: NDArray[np.intp], seen: Seen) -> NDArray[Any]:
        # Its samples come from torch's global generator.
        return model.predict(seen.observations, deterministic=seen.generator is None)[0]

    return Policies(task, choose)
