"""A little environment of any spaces."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from mo_gymnasium.wrappers.vector import MOSyncVectorEnv

from mo_deepdrive.evaluation.env_adapter import EnvAdapter


class Toy(gymnasium.Env[Any, Any]):
    """Ends after three steps, pays for the action it got, and shows how often it was stepped."""

    def __init__(self, action_space: spaces.Space[Any], observation_space: spaces.Space[Any] | None = None):
        self.action_space = action_space
        self.observation_space = observation_space or spaces.Box(0.0, 9.0, (2, 2), dtype=np.float32)
        self.reward_space = spaces.Box(-10.0, 10.0, (2,), dtype=np.float32)
        self.reward_dim = 2
        self.count = 0

    def _observed(self) -> Any:
        if isinstance(self.observation_space, spaces.Discrete):
            return int(self.observation_space.start) + self.count
        return np.full(self.observation_space.shape, self.count, dtype=self.observation_space.dtype)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.count = 0
        return self._observed(), {}

    def step(self, action: Any) -> tuple[Any, np.ndarray, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), f"{action!r} is not in {self.action_space}"
        self.count += 1
        reward = np.resize(np.asarray(action, dtype=np.float32).reshape(-1), 2)
        info = {"success": True, "end": "three"} if self.count == 3 else {}
        return self._observed(), reward, self.count == 3, False, info


def toy_worlds(action_space: spaces.Space[Any], observation_space: spaces.Space[Any] | None = None) -> EnvAdapter:
    return EnvAdapter(MOSyncVectorEnv(lambda: Toy(action_space, observation_space) for _ in range(2)))
