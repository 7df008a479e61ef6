"""An environment that turns foul, and utilities that do: modules of a user, as YAML files name them."""

from __future__ import annotations

import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

FOUL = "tests.helpers.foul:foul-v0"


class Foul(gymnasium.Env[Any, Any]):
    """Random observations and rewards; after a number of decisions they are multiplied.

    Args:
        reward, observation: the factors.
        after: decisions, over all episodes.
        length: decisions of an episode; 0 for no end.
        continuous: whether actions are.
        pause: s that a decision takes.
    """

    metadata = {"render_modes": []}
    objectives = ("gain", "cost")

    def __init__(
        self,
        reward: float = 1.0,
        observation: float = 1.0,
        after: int = 30,
        length: int = 7,
        continuous: bool = False,
        pause: float = 0.0,
    ):
        self.observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32) if continuous else spaces.Discrete(3)
        self.reward_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.reward_dim = 2
        self.factors = {"reward": float(reward), "observation": float(observation)}
        self.after, self.length, self.pause = after, length, pause
        self.decisions, self.total = 0, 0

    def _numbers(self, what: str, size: int) -> Any:
        factor = self.factors[what] if self.total > self.after else 1.0
        return (self.np_random.normal(size=size) * np.array([factor, *[1.0] * (size - 1)])).astype(np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.decisions = 0
        return self._numbers("observation", 3), {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        assert np.isfinite(action).all()
        time.sleep(self.pause)
        self.decisions += 1
        self.total += 1
        over = self.decisions == self.length
        return self._numbers("observation", 3), self._numbers("reward", 2), over, False, {}


gymnasium.register("foul-v0", entry_point=Foul)


def late_root(returns: Any) -> Any:
    """Not a number where the first return is below -2."""
    return (returns[..., 0] + 2.0) ** 0.5
