"""One world as other libraries' algorithms take it, with a record of what happened there."""

from __future__ import annotations

from time import perf_counter
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from algorithms.agent import Log
from algorithms.common.env_adapter import EnvAdapter
from mo_deepdrive.utilities import Utility


class Recorder:
    """Counts the steps of all training worlds and logs the episodes that ended, whatever library drives.

    Args:
        objectives: names of the d components of the reward.
        utility: logged too where it is known.
        interval: steps between two lines.
        log: called as ``log(step, metrics)``.

    Attributes:
        steps: environment steps so far.
    """

    def __init__(self, objectives: tuple[str, ...], utility: Utility | None, interval: int, log: Log):
        self.steps = 0
        self._objectives, self._utility = objectives, utility
        self._interval, self._log = interval, log
        self._episodes: list[tuple[NDArray[np.float64], int, bool]] = []
        self._started = perf_counter()

    def step(self) -> None:
        """One step of one world was taken."""
        self.steps += 1
        if self.steps % self._interval == 0:
            self._write()

    def episode(self, returns: NDArray[np.float64], length: int, success: bool) -> None:
        """An episode has ended with undiscounted ``returns`` (d,)."""
        self._episodes.append((returns, length, success))

    def _write(self) -> None:
        metrics = {"time/steps_per_second": self.steps / (perf_counter() - self._started)}
        if self._episodes:
            returns = np.array([each[0] for each in self._episodes])
            if self._utility is not None:
                metrics["train/utility"] = float(np.mean(self._utility(returns)))
            metrics["train/success"] = float(np.mean([each[2] for each in self._episodes]))
            metrics["train/length"] = float(np.mean([each[1] for each in self._episodes]))
            for objective, mean in zip(self._objectives, returns.mean(axis=0).tolist(), strict=True):
                metrics[f"train/return/{objective}"] = mean
        self._episodes = []
        self._log(self.steps, metrics)


class PeerEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """One world with observations, actions and rewards in the form that every peer takes.

    Observations are float32 vectors divided by ``observation_scales``, actions are integers from 0 on or in [-1, 1],
    vector rewards are float32 divided by ``reward_scales``. What the wrapped environment does stays as it is.

    Args:
        env: a single environment with vector rewards.
        adapter: the same environment in our trainers' shapes, which knows how to turn observations and actions.
        observation_scales: (o,).
        reward_scales: (d,).
        seed: of the first episode and of the action space.
        recorder: told of every step; None where nothing is to be counted.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        adapter: EnvAdapter,
        *,
        observation_scales: NDArray[np.float32],
        reward_scales: NDArray[np.float32],
        seed: int,
        recorder: Recorder | None = None,
    ):
        super().__init__(env)
        self._adapter, self._recorder = adapter, recorder
        self._observation_scales, self._reward_scales = observation_scales, reward_scales
        self._first_seed: int | None = seed
        high = np.full(adapter.observation_size, np.inf, dtype=np.float32)
        self.observation_space = spaces.Box(-high, high, dtype=np.float32)
        if adapter.continuous:
            self.action_space = spaces.Box(-1.0, 1.0, (adapter.actions,), dtype=np.float32, seed=seed)
        else:
            self.action_space = spaces.Discrete(adapter.actions, seed=seed)
        self._returns = np.zeros(len(adapter.objectives))
        self._length = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start a new episode; without a seed the first one is that of the constructor."""
        raw, info = self.env.reset(seed=self._first_seed if seed is None else seed, options=options)
        self._first_seed = None
        self._returns = np.zeros(len(self._adapter.objectives))
        self._length = 0
        return self._observation(raw), info

    def step(self, action: Any) -> tuple[NDArray[np.float32], Any, bool, bool, dict[str, Any]]:
        """Act for one decision; the vector reward (d,) is in units of ``reward_scales``."""
        chosen = self._adapter.environment_actions(np.asarray(action)[None, None])[0]
        raw, reward, terminated, truncated, info = self.env.step(chosen)
        vector = np.asarray(reward)
        if self._recorder is not None:
            self._returns += vector
            self._length += 1
            if terminated or truncated:
                self._recorder.episode(self._returns, self._length, bool(info.get("success", False)))
            self._recorder.step()
        return (
            self._observation(raw),
            (vector / self._reward_scales).astype(np.float32),
            bool(terminated),
            bool(truncated),
            info,
        )

    def _observation(self, raw: Any) -> NDArray[np.float32]:
        seen = self._adapter.policy_observations(np.asarray(raw)[None])[0, 0]
        return (seen / self._observation_scales).astype(np.float32)
