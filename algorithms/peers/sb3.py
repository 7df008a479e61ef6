"""Adapters of Stable-Baselines3, whose algorithms learn from a scalar reward: a known utility."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from algorithms.peers.peer_env import RecordedEpisodes
from algorithms.peers.peer_task import PeerPolicies, PeerTask, PolicyInputs, ScalarConfig
from mo_deepdrive.wrappers import Measure, UtilityReward, VectorScaledObservation, VectorUtilityReward

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mo_deepdrive.utilities import Utility


def _environments(task: PeerTask, utility: Utility, measure: Measure) -> Any:
    """The training environments, with the utility of unscaled rewards as reward."""
    if task.env.native:
        from mo_deepdrive.envs.sb3 import SB3VecEnv

        envs = VectorUtilityReward(RecordedEpisodes(task.env, task.recorder), utility, measure)
        return SB3VecEnv(VectorScaledObservation(envs, task.observation_scales))
    from stable_baselines3.common.vec_env import DummyVecEnv

    return DummyVecEnv(
        [
            lambda index=index: UtilityReward(task.make(index, scaled_rewards=False), utility, measure)
            for index in range(task.env.num_envs)
        ]
    )


def train(task: PeerTask, algorithm: Any) -> PeerPolicies:
    """Train A2C (Mnih et al. 2016) or PPO (Schulman et al. 2017)."""
    config, utility = task.config, task.utility
    assert isinstance(config, ScalarConfig)
    assert utility is not None
    env = _environments(task, utility, config.utility_of)
    model = algorithm(env=env, **task.arguments(policy="MlpPolicy", verbose=0))
    model.learn(task.steps, **task.train_arguments())
    env.close()

    def choose(_rows: NDArray[np.intp], inputs: PolicyInputs) -> Any:
        # It samples from torch's global generator.
        return model.predict(inputs.observations, deterministic=inputs.generator is None)[0]

    return PeerPolicies(task, choose)
