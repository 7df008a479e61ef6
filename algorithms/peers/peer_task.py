"""What the adapter of a peer gets, a task with environments as peers see them, and what it returns, policies."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import VectorWrapper
from pydantic import Field

from mo_deepdrive.evaluation.episodes import evaluate_each
from mo_deepdrive.evaluation.front import Front
from mo_deepdrive.evaluation.metrics import STEPS_PER_SECOND, TRAIN, summarise
from mo_deepdrive.support.faults import check_vehicles
from mo_deepdrive.world.config import Settings
from mo_deepdrive.wrappers import VectorEpisodeStatistics

if TYPE_CHECKING:
    from collections.abc import Callable

    from gymnasium.vector import VectorEnv
    from numpy.typing import ArrayLike, NDArray

    from algorithms.agent import Log
    from mo_deepdrive.evaluation.env_adapter import EnvAdapter
    from mo_deepdrive.evaluation.policy import AccruedReward
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
        if before // self._interval == self.steps // self._interval:
            return
        metrics = {STEPS_PER_SECOND: self.steps / (perf_counter() - self._started)}
        if self._episodes:
            returns, lengths, succeeded = (np.array(each) for each in zip(*self._episodes, strict=True))
            summary = summarise(self._objectives, returns, lengths, succeeded, utility=self._utility)
            metrics |= {TRAIN + name: value for name, value in summary.items()}
        self._episodes = []
        self._log(self.steps, metrics)

    def episode(self, returns: NDArray[np.float64], length: int, success: bool) -> None:
        """Record a finished episode with undiscounted ``returns`` (d,)."""
        self._episodes.append((returns, length, success))


class RecordedEpisodes(VectorWrapper):  # not generic in Gymnasium 1.2
    """Our vector environment with one vehicle, for peers that take one; everything but the infos is unchanged."""

    def __init__(self, adapter: EnvAdapter, recorder: Recorder):
        super().__init__(VectorEpisodeStatistics(adapter.vector_env))
        self._adapter, self._recorder = adapter, recorder

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Take one step in every environment; a reward that is not finite is refused."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        check_vehicles("reward", rewards[:, None], self._adapter.name, self._adapter.objectives)
        episodes = infos.pop("episode", None)
        for row in np.flatnonzero(infos.pop("_episode", ())):
            success = bool(infos["final_info"]["success"][row])
            self._recorder.episode(episodes["r"][row], int(episodes["l"][row]), success)
        self._recorder.step(self.num_envs)
        return observations, rewards, terminated, truncated, infos


class PeerEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment with observations, actions and rewards in a form that all peers support.

    Observations are float32 vectors divided by the task's scales; actions are integers from 0, or floats in [-1, 1];
    vector rewards are float32 and divided by the task's scales, too. The dynamics are unchanged. ``seed`` is that of
    the first episode and of the action space.
    """

    def __init__(self, task: PeerTask, seed: int, *, recorded: bool, scaled_rewards: bool, render_mode: str | None):
        super().__init__(task.make_single_env(render_mode=render_mode))
        self._adapter, self._recorder = task.env, task.recorder if recorded else None
        self._observation_scales = task.observation_scales
        self._reward_scales = task.reward_scales if scaled_rewards else np.ones_like(task.reward_scales)
        self._first_seed: int | None = seed
        shape = (task.env.observation_size,)
        self.observation_space = spaces.Box(-np.inf, np.inf, shape, dtype=np.float32)
        if task.env.continuous:
            self.action_space = spaces.Box(-1.0, 1.0, (task.env.actions,), dtype=np.float32, seed=seed)
        else:
            self.action_space = spaces.Discrete(task.env.actions, seed=seed)

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
        scaled = (vector / self._reward_scales).astype(np.float32)
        return self._observation(raw), scaled, bool(terminated), bool(truncated), info

    def _observation(self, raw: Any) -> NDArray[np.float32]:
        observations = self._adapter.policy_observations(np.asarray(raw)[None])
        check_vehicles("observation", observations, self._adapter.name)
        return np.asarray(observations[0, 0] / self._observation_scales, dtype=np.float32)


def _with_arrays(arguments: dict[str, Any]) -> dict[str, Any]:
    """Arguments that are lists in YAML, but have to be arrays for morl-baselines, as such."""
    for name in ("scaling_factor", "max_return", "ref_point", "origin"):
        if arguments.get(name) is not None:
            arguments[name] = np.asarray(arguments[name], dtype=np.float32)
    return arguments


class PeerConfig(Settings):
    """Settings of another library's algorithm."""

    gamma: float = Field(default=0.99, gt=0.0, le=1.0)
    """Discount factor."""
    nominal_scales: bool = True
    """Whether observations and rewards are divided by their nominal scales, as for our own algorithms."""
    arguments: dict[str, Any] = {}
    """Arguments of its constructor; they override those that the adapter sets."""
    train_arguments: dict[str, Any] = {}
    """Arguments of its training method, likewise."""


class WeightedConfig(PeerConfig):
    """Settings of an algorithm whose policy takes a weight per objective."""

    policies: int = Field(default=100, ge=1)
    """Number of evenly spaced weights at which the policy is evaluated."""


class ScalarConfig(PeerConfig):
    """Settings of an algorithm that learns from a scalar reward."""

    utility_of: Literal["reward", "return"] = "return"
    """Whether the scalar reward is the utility of the reward or of the return; see
    :class:`mo_deepdrive.wrappers.UtilityReward`."""


@dataclass(frozen=True)
class PeerTask:
    """What a peer learns, and with which settings."""

    make_single_env: Callable[..., gymnasium.Env[Any, Any]]  # with vector rewards; takes ``render_mode``
    env: EnvAdapter  # the parallel environments
    config: PeerConfig
    utility: Utility | None  # of unscaled returns; None if the peer learns a front
    steps: int  # of the environments; peers that train in rounds may take a few more
    seed: int
    device: str
    reference_point: NDArray[np.float64] | None  # (d,) in unscaled discounted returns
    recorder: Recorder

    @property
    def observation_scales(self) -> NDArray[np.float32]:
        """(o,) by which the peer's observations are divided."""
        scales = self.env.observation_scales
        return scales if self.config.nominal_scales else np.ones_like(scales)

    @property
    def reward_scales(self) -> NDArray[np.float32]:
        """(d,) by which the peer's rewards are divided."""
        scales = self.env.objective_scales
        return scales if self.config.nominal_scales else np.ones_like(scales)

    def make(
        self, index: int = 0, *, recorded: bool = True, scaled_rewards: bool = True, render_mode: str | None = None
    ) -> PeerEnv:
        """Make training environment ``index``; with ``recorded`` False, one for the peer's own evaluations."""
        options: dict[str, Any] = {"scaled_rewards": scaled_rewards, "render_mode": render_mode}
        return PeerEnv(self, self.seed + index, recorded=recorded, **options)

    def spec(self) -> EnvSpec:
        """A specification that makes training environments, for peers that expect the id of an environment."""
        inner, made = self.env.vector_env.spec, itertools.count()
        name = "Peer-v0" if inner is None else inner.id
        return EnvSpec(id=name, entry_point=lambda **rest: self.make(next(made), **rest))

    def arguments(self, **defaults: Any) -> dict[str, Any]:
        """Arguments of the constructor: common ones and the adapter's ``defaults``, overridden by the user's."""
        common = {"gamma": self.config.gamma, "seed": self.seed, "device": self.device}
        return _with_arrays({**common, **defaults, **self.config.arguments})

    def train_arguments(self, **defaults: Any) -> dict[str, Any]:
        """Arguments of the training method: likewise, without common ones."""
        return _with_arrays({**defaults, **self.config.train_arguments})

    def tensor(self, array: Any) -> torch.Tensor:
        """``array`` as a float32 tensor on the device."""
        return torch.as_tensor(array, dtype=torch.float32, device=self.device)

    def utility_of_scaled(self, returns: Any, weights: Any = None) -> Any:
        """The utility of returns (..., d) in the peer's units, for NumPy and torch; ``weights`` are ignored."""
        del weights  # some libraries pass them to every scalarisation
        assert self.utility is not None, "checked before the adapter is called"
        scales: Any = self.reward_scales
        if isinstance(returns, torch.Tensor):
            scales = torch.as_tensor(scales, device=returns.device)
        return self.utility(returns * scales)


class PolicyInputs(NamedTuple):
    """The inputs of N policies, in the peer's units."""

    observations: NDArray[np.float32]  # (N, o)
    accrued: NDArray[np.float32]  # (N, d) accrued rewards, discounted with :attr:`PeerPolicies.gamma`
    decisions: NDArray[np.int64]  # (N,) in the episode so far
    generator: torch.Generator | None  # samples actions; None for greedy ones


def as_array(actions: Any) -> NDArray[Any]:
    """Actions as an array, wherever the tensor is that a peer returned."""
    return torch.as_tensor(actions).cpu().numpy()


@dataclass
class PeerPolicies:
    """K policies that a peer has learned, and some of them as a :class:`mo_deepdrive.evaluation.policy.Policy`."""

    task: PeerTask
    choose: Callable[[NDArray[np.intp], PolicyInputs], Any]  # actions (N,) or (N, k) of N policies, by their indices
    # (K, m) what identifies each policy, such as weights or a desired return, in unscaled units.
    conditions: NDArray[np.float64] = field(default_factory=lambda: np.zeros((1, 0)))
    condition_names: tuple[str, ...] = ()  # of the m columns
    gamma: float = 1.0  # discount of the accrued rewards in their inputs
    # (N,) the policy that acts in each environment, or (1,) in all.
    rows: NDArray[np.intp] = field(default_factory=lambda: np.zeros(1, dtype=np.intp))

    def __post_init__(self) -> None:
        self.env, self.device = self.task.env, torch.device(self.task.device)
        self.utilities = () if self.task.utility is None else (self.task.utility,)

    def __len__(self) -> int:
        return len(self.conditions)

    @property
    def step(self) -> int:
        """Environment steps that they have learnt from."""
        return self.task.recorder.steps

    def front(self, env: VectorEnv, *, episodes: int, seed: int, gamma: float) -> Front:
        """The non-dominated policies in greedy episodes, as of :meth:`algorithms.agent.FrontAgent.front`."""
        evaluations = evaluate_each(self.at, len(self), env, episodes=episodes, seed=seed, gamma=gamma)
        front = Front.of_evaluations(evaluations, self.conditions, self.condition_names, gamma=gamma, seed=seed)
        return front.non_dominated()

    def at(self, rows: NDArray[np.intp]) -> PeerPolicies:
        """With the policies at these indices acting, of which there is one for each environment."""
        return replace(self, rows=rows)

    def policy(self, condition: ArrayLike) -> PeerPolicies:
        """The policy whose condition is nearest to ``condition`` (m,)."""
        gaps = np.linalg.norm(self.conditions - np.asarray(condition), axis=1)
        return self.at(np.array([gaps.argmin()]))

    @torch.inference_mode()
    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Actions (N, 1) or (N, 1, k) for observations (N, 1, o); greedy if ``generator`` is None."""
        task = self.task
        inputs = PolicyInputs(
            observations=(observations[:, 0] / task.observation_scales).astype(np.float32),
            accrued=(accrued_reward.value[:, 0] / task.reward_scales).astype(np.float32),
            decisions=accrued_reward.decisions[:, 0].copy(),
            generator=generator,
        )
        return as_array(self.choose(np.broadcast_to(self.rows, len(observations)), inputs))[:, None]
