"""What the adapter of a peer gets, a task, and what it returns, policies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from algorithms.peers.peer_env import PeerEnv, Recorder
from mo_deepdrive.evaluation.episodes import evaluate_each
from mo_deepdrive.evaluation.front import Front
from mo_deepdrive.world.config import Settings

if TYPE_CHECKING:
    import gymnasium
    from gymnasium.vector import VectorEnv

    from mo_deepdrive.evaluation.env_adapter import EnvAdapter
    from mo_deepdrive.evaluation.policy import AccruedReward
    from mo_deepdrive.utilities import Utility


# Arguments that are lists in YAML, but have to be arrays for morl-baselines.
ARRAYS = ("scaling_factor", "max_return", "ref_point", "origin")


def _with_arrays(arguments: dict[str, Any]) -> dict[str, Any]:
    return {
        name: np.asarray(value, dtype=np.float32) if name in ARRAYS and value is not None else value
        for name, value in arguments.items()
    }


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
        scales = self.reward_scales
        return PeerEnv(
            self.make_single_env(render_mode=render_mode),
            self.env,
            observation_scales=self.observation_scales,
            reward_scales=scales if scaled_rewards else np.ones_like(scales),
            seed=self.seed + index,
            recorder=self.recorder if recorded else None,
        )

    def spec(self) -> EnvSpec:
        """A specification that makes training environments, for peers that expect the id of an environment."""
        inner = self.env.vector_env.spec
        made = iter(range(1_000_000))
        return EnvSpec(
            id="Peer-v0" if inner is None else inner.id,
            entry_point=lambda **rest: self.make(next(made), **rest),
        )

    def arguments(self, **defaults: Any) -> dict[str, Any]:
        """Arguments of the constructor: common ones and the adapter's ``defaults``, overridden by the user's."""
        common = {"gamma": self.config.gamma, "seed": self.seed, "device": self.device}
        return _with_arrays({**common, **defaults, **self.config.arguments})

    def train_arguments(self, **defaults: Any) -> dict[str, Any]:
        """Arguments of the training method: the adapter's ``defaults``, overridden by the user's."""
        return _with_arrays({**defaults, **self.config.train_arguments})

    def tensor(self, array: Any) -> torch.Tensor:
        """``array`` as a float32 tensor on the device."""
        return torch.as_tensor(array, dtype=torch.float32, device=self.device)

    def utility_of_scaled(self, returns: Any, weights: Any = None) -> Any:
        """The utility of returns (..., d) in the peer's units, for NumPy and torch; ``weights`` are ignored."""
        del weights  # some libraries pass them to every scalarisation
        assert self.utility is not None, "checked before the adapter is called"
        scales = self.reward_scales
        unit = torch.as_tensor(scales, device=returns.device) if isinstance(returns, torch.Tensor) else scales
        return self.utility(returns * unit)


@dataclass(frozen=True)
class PolicyInputs:
    """The inputs of N policies, in the peer's units."""

    observations: NDArray[np.float32]  # (N, o)
    accrued: NDArray[np.float32]  # (N, d) accrued rewards, discounted with :attr:`PeerPolicies.gamma`
    decisions: NDArray[np.int64]  # (N,) in the episode so far
    generator: torch.Generator | None  # samples actions; None for greedy ones

    def select(self, rows: NDArray[Any]) -> PolicyInputs:
        """The inputs of the policies at ``rows``."""
        return PolicyInputs(self.observations[rows], self.accrued[rows], self.decisions[rows], self.generator)


# From N indices of policies and their inputs to their actions (N,) or (N, k), an array or a tensor.
ActionFunction = Callable[[NDArray[np.intp], PolicyInputs], Any]


def as_array(actions: Any) -> NDArray[Any]:
    """Actions as an array, wherever the tensor is that a peer returned."""
    return torch.as_tensor(actions).cpu().numpy()


@dataclass(frozen=True)
class PeerPolicies:
    """K policies that a peer has learned, and some of them as a :class:`mo_deepdrive.evaluation.policy.Policy`.

    Attributes:
        task: that they were trained on.
        choose: chooses their actions.
        conditions: (K, m) what identifies each policy, such as weights or a desired return, in unscaled units.
        condition_names: of the m columns.
        gamma: discount of the accrued rewards in their inputs.
        rows: (N,) index of the policy that acts in each environment, or (1,) for one in all of them.
    """

    task: PeerTask
    choose: ActionFunction
    conditions: NDArray[np.float64] = field(default_factory=lambda: np.zeros((1, 0)))
    condition_names: tuple[str, ...] = ()
    gamma: float = 1.0
    rows: NDArray[np.intp] = field(default_factory=lambda: np.zeros(1, dtype=np.intp))

    def __len__(self) -> int:
        return len(self.conditions)

    @property
    def step(self) -> int:
        """Environment steps that they have learnt from."""
        return self.task.recorder.steps

    @property
    def utilities(self) -> tuple[Utility, ...]:
        """The known utility; empty if the peer learned a front."""
        return () if self.task.utility is None else (self.task.utility,)

    @property
    def device(self) -> torch.device:
        """The device of the generators for sampling."""
        return torch.device(self.task.device)

    @property
    def env(self) -> EnvAdapter:
        """The environment behind the adapter of our own algorithms."""
        return self.task.env

    def front(self, env: VectorEnv, *, episodes: int, seed: int, gamma: float) -> Front:
        """The non-dominated policies in greedy episodes, as of :meth:`algorithms.agent.FrontAgent.front`."""
        evaluations = evaluate_each(self.at, len(self), env, episodes=episodes, seed=seed, gamma=gamma)
        return Front.of_evaluations(
            evaluations, self.conditions, self.condition_names, gamma=gamma, seed=seed
        ).non_dominated()

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
        rows = np.broadcast_to(self.rows, len(observations))
        return as_array(self.choose(rows, inputs))[:, None]
