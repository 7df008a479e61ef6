"""The environment as peers see it, and a recorder of their training."""

from __future__ import annotations

from time import perf_counter
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorWrapper

from mo_deepdrive.evaluation.metrics import STEPS_PER_SECOND, TRAIN, summarise
from mo_deepdrive.support.faults import check_vehicles
from mo_deepdrive.wrappers import VectorEpisodeStatistics

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from algorithms.agent import Log
    from mo_deepdrive.evaluation.env_adapter import EnvAdapter
    from mo_deepdrive.utilities import Utility


class Recorder:
    """Counts the steps of all training environments and logs statistics of finished episodes, for any library."""

    def __init__(self, objectives: tuple[str, ...], utility: Utility | None, interval: int, log: Log):
        self.steps = 0
        self._objectives, self._utility = objectives, utility
        self._interval, self._log = interval, log
        self._episodes: list[tuple[NDArray[np.float64], int, bool]] = []
        self._started = perf_counter()

    def step(self, environments: int = 1) -> None:
        """Count a step of some environments."""
        before, self.steps = self.steps, self.steps + environments
        if before // self._interval < self.steps // self._interval:
            self._write()

    def episode(self, returns: NDArray[np.float64], length: int, success: bool) -> None:
        """Record a finished episode with undiscounted ``returns`` (d,)."""
        self._episodes.append((returns, length, success))

    def _write(self) -> None:
        metrics = {STEPS_PER_SECOND: self.steps / (perf_counter() - self._started)}
        if self._episodes:
            returns, lengths, succeeded = (np.array(each) for each in zip(*self._episodes, strict=True))
            summary = summarise(self._objectives, returns, lengths, succeeded, utility=self._utility)
            metrics |= {TRAIN + name: value for name, value in summary.items()}
        self._episodes = []
        self._log(self.steps, metrics)


class RecordedEpisodes(VectorWrapper):  # not generic in Gymnasium 1.2
    """Our vector environment with one vehicle, for peers that take one; everything but the infos is unchanged."""

    def __init__(self, adapter: EnvAdapter, recorder: Recorder):
        super().__init__(VectorEpisodeStatistics(adapter.vector_env))
        self._adapter, self._recorder = adapter, recorder

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Take one step in every environment; a reward that is not finite is refused."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        check_vehicles("reward", rewards[:, None], self._adapter.name, self._adapter.objectives)
        found = infos.pop("episode", None)
        for row in np.flatnonzero(infos.pop("_episode", ())):
            success = bool(infos["final_info"]["success"][row])
            self._recorder.episode(found["r"][row], int(found["l"][row]), success)
        self._recorder.step(self.num_envs)
        return observations, rewards, terminated, truncated, infos


class PeerEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment with observations, actions and rewards in a form that all peers support.

    Observations are float32 vectors divided by ``observation_scales``; actions are integers from 0, or floats in
    [-1, 1]; vector rewards are float32 and divided by ``reward_scales``. The dynamics are unchanged. ``seed`` is that
    of the first episode and of the action space; without a recorder nothing is recorded.
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

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start a new episode; without ``seed``, the first episode uses the constructor's seed."""
        raw, info = self.env.reset(seed=self._first_seed if seed is None else seed, options=options)
        self._first_seed = None
        self._returns = np.zeros(len(self._adapter.objectives))
        self._length = 0
        self._decisions = self._adapter.decisions()
        return self._observation(raw), info

    def step(self, action: Any) -> tuple[NDArray[np.float32], Any, bool, bool, dict[str, Any]]:
        """Take one step; numbers that are not finite and episodes without end are refused."""
        next(self._decisions)
        chosen = self._adapter.environment_actions(np.asarray(action)[None, None])[0]
        raw, reward, terminated, truncated, info = self.env.step(chosen)
        vector = np.asarray(reward)
        check_vehicles("reward", vector[None, None], self._adapter.name, self._adapter.objectives)
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
        observations = self._adapter.policy_observations(np.asarray(raw)[None])
        check_vehicles("observation", observations, self._adapter.name)
        return np.asarray(observations[0, 0] / self._observation_scales, dtype=np.float32)
