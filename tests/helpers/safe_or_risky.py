"""A choice between a safe and a risky arm whose outcome comes later: ESR and SER have different optima."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from algorithms.actor_critic import ActorCritic
from mo_deepdrive.utilities import Utility

SAFE, RISKY = 0, 1
SAFE_OUTCOME = np.array([0.5, 0.5], dtype=np.float32)
RISKY_OUTCOMES = np.array([[1.2, 0.0], [0.0, 1.2]], dtype=np.float32)  # with equal probability
PRODUCT = Utility("product", ("objective_0", "objective_1"), lambda returns: returns[..., 0] * returns[..., 1])


class SafeOrRisky(VectorEnv):
    """N copies of a problem of two arms, as MOSyncVectorEnv would step them.

    The first of ``delay`` + 1 decisions chooses the arm, the others are without effect, and the last brings the
    outcome; the step after that only resets. An observation is the share of the decisions made, and the arm.

    With u the product of the two returns, the safe arm's utility is 0.25 and the risky arm's 0 in every episode, so
    that the safe arm is the optimum of ESR. The mean return of the risky arm is (0.6, 0.6), of utility 0.36, and that
    of a mixture lies between it and (0.5, 0.5): the risky arm is the optimum of SER.
    """

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(self, num_envs: int, delay: int):
        self.num_envs, self.delay = num_envs, delay
        self.single_action_space = spaces.Discrete(2)
        self.single_observation_space = spaces.Box(0.0, 1.0, (3,), np.float32)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.reward_space = spaces.Box(0.0, 2.0, (2,), np.float32)
        self.envs: list[Any] = [gymnasium.Env()]  # asked for names of objectives

    def _observations(self) -> NDArray[np.float32]:
        columns = [self.t / (self.delay + 1), self.arms == SAFE, self.arms == RISKY]
        return np.stack(columns, axis=1).astype(np.float32)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed, options=options)
        self.t = np.zeros(self.num_envs, dtype=np.int64)
        self.arms = np.full(self.num_envs, -1)
        return self._observations(), {}

    def step(self, actions: NDArray[Any]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        was_over = self.t > self.delay
        self.arms = np.where(was_over, -1, np.where(self.t == 0, actions, self.arms))
        self.t = np.where(was_over, 0, self.t + 1)
        over = self.t > self.delay
        outcomes = RISKY_OUTCOMES[self.np_random.integers(2, size=self.num_envs)]
        outcomes[self.arms == SAFE] = SAFE_OUTCOME
        rewards = np.where(over[:, None], outcomes, np.float32(0.0))
        return self._observations(), rewards, over, np.zeros(self.num_envs, dtype=np.bool_), {}


def probability_of_risky(
    cls: type[ActorCritic], delay: int, seed: int, total: int, num_envs: int = 64, **hyperparameters: Any
) -> float:
    """How probable the risky arm is after ``total`` steps of training."""
    settings: dict[str, Any] = {
        "gamma": 1.0,
        "learning_rate": 1e-2,
        "hidden": [16],
        "entropy_start": 0.001,
        "entropy_end": 0.001,
    }
    agent = cls(SafeOrRisky(num_envs, delay), PRODUCT, seed=seed, **{**settings, **hyperparameters})
    agent.train(total)
    inputs = agent.inputs(torch.zeros(1, 3), torch.zeros(1, 2), torch.ones(1))
    with torch.no_grad():
        log_prob, _ = agent.learners[0].actor(inputs, torch.tensor([RISKY]))
    return float(log_prob.exp())
