"""What an adapter gets, an environment to learn on and settings, and what it gives back: policies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from algorithms.common.accrued_reward import AccruedReward
from algorithms.common.env_adapter import EnvAdapter
from algorithms.peers.environment import PeerEnv, Recorder
from mo_deepdrive.config import Settings
from mo_deepdrive.utilities import Utility


class PeerConfig(Settings):
    """Settings of another library's algorithm.

    Attributes:
        gamma: its discount.
        nominal_scales: it sees observations and rewards divided by their nominal scales, as our algorithms do; False
            for the environment's own numbers.
        arguments: of its constructor, beyond what the adapter sets; they win where both do.
        train_arguments: of its training method, likewise.
    """

    gamma: float = Field(default=0.99, gt=0.0, le=1.0)
    nominal_scales: bool = True
    arguments: dict[str, Any] = {}
    train_arguments: dict[str, Any] = {}


class WeightedConfig(PeerConfig):
    """Settings of an algorithm whose policy takes a weight per objective.

    Attributes:
        policies: weights, evenly spaced, at which its policy is evaluated.
    """

    policies: int = Field(default=100, ge=1)


class ScalarConfig(PeerConfig):
    """Settings of an algorithm that learns from a scalar reward.

    Attributes:
        utility_of: what the reward is the utility of; see :class:`mo_deepdrive.wrappers.UtilityReward`.
    """

    utility_of: Literal["reward", "return"] = "return"


@dataclass(frozen=True)
class Task:
    """What a peer is to learn.

    Attributes:
        new: makes one world, with vector rewards; takes ``render_mode``.
        env: the same environment in our trainers' shapes.
        config: of the peer.
        utility: of the environment's own returns; None where the peer learns a front.
        steps: environment steps to train for; peers that count in rounds may take a few more.
        num_envs: parallel worlds, for peers that take several.
        seed, device: of the run.
        reference_point: (d,) of the environment's own discounted returns, for peers that steer by a hypervolume; None
            where there is none.
        recorder: counts steps and logs.
    """

    new: Callable[..., gymnasium.Env[Any, Any]]
    env: EnvAdapter
    config: PeerConfig
    utility: Utility | None
    steps: int
    num_envs: int
    seed: int
    device: str
    reference_point: NDArray[np.float64] | None
    recorder: Recorder

    @property
    def objectives(self) -> tuple[str, ...]:
        """Names of the d components of the reward."""
        return self.env.objectives

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
        """World ``index`` of the training, or one (``recorded`` False) for the peer's own evaluations."""
        scales = self.reward_scales
        return PeerEnv(
            self.new(render_mode=render_mode),
            self.env,
            observation_scales=self.observation_scales,
            reward_scales=scales if scaled_rewards else np.ones_like(scales),
            seed=self.seed + index,
            recorder=self.recorder if recorded else None,
        )

    def spec(self) -> EnvSpec:
        """A specification that makes training worlds, for peers that take an id."""
        inner = self.env.vector_env.spec
        made = iter(range(1_000_000))
        return EnvSpec(
            id="Peer-v0" if inner is None else inner.id,
            entry_point=lambda **rest: self.make(next(made), **rest),
        )

    def arguments(self, **defaults: Any) -> dict[str, Any]:
        """The constructor's arguments: the adapter's ``defaults``, and the user's over them."""
        return {**defaults, **self.config.arguments}

    def train_arguments(self, **defaults: Any) -> dict[str, Any]:
        """The training method's arguments, likewise."""
        return {**defaults, **self.config.train_arguments}

    def tensor(self, array: Any) -> torch.Tensor:
        """``array`` as the networks take it."""
        return torch.as_tensor(array, dtype=torch.float32, device=self.device)

    def utility_of_scaled(self, returns: Any, weights: Any = None) -> Any:
        """The utility of returns (..., d) in the peer's units; NumPy or torch. ``weights`` are not looked at."""
        assert self.utility is not None, "checked before the adapter is called"
        scales = self.reward_scales
        unit = torch.as_tensor(scales, device=returns.device) if isinstance(returns, torch.Tensor) else scales
        return self.utility(returns * unit)


@dataclass(frozen=True)
class Seen:
    """What N policies act on.

    Attributes:
        observations: (N, o) in the peer's units.
        accrued: (N, d) rewards of the episode so far in the peer's units, discounted with :attr:`Policies.gamma`.
        decisions: (N,) since the episode began.
        generator: for samples; None for the greedy action.
    """

    observations: NDArray[np.float32]
    accrued: NDArray[np.float32]
    decisions: NDArray[np.int64]
    generator: torch.Generator | None

    def take(self, rows: NDArray[Any]) -> Seen:
        """Of the policies at ``rows`` alone."""
        return Seen(self.observations[rows], self.accrued[rows], self.decisions[rows], self.generator)


# Actions (N,) or (N, k) of the policies at N indices.
Choose = Callable[[NDArray[np.intp], Seen], NDArray[Any]]


@dataclass(frozen=True)
class Policies:
    """K policies that a peer has learnt.

    Attributes:
        task: what it has learnt them on.
        choose: how they act.
        conditions: (K, m) what makes each of them, in the environment's units.
        condition_names: of the m columns.
        gamma: discount of the accrued rewards that they see.
    """

    task: Task
    choose: Choose
    conditions: NDArray[np.float64] = field(default_factory=lambda: np.zeros((1, 0)))
    condition_names: tuple[str, ...] = ()
    gamma: float = 1.0

    def __len__(self) -> int:
        return len(self.conditions)

    def at(self, rows: NDArray[np.intp]) -> PeerPolicy:
        """The policy that acts in N worlds as the policies at N indices do."""
        return PeerPolicy(self, rows)

    def policy(self, condition: ArrayLike) -> PeerPolicy:
        """The policy with the condition (m,) nearest to this one."""
        gaps = np.linalg.norm(self.conditions - np.asarray(condition), axis=1)
        return self.at(np.array([gaps.argmin()]))


@dataclass(frozen=True)
class PeerPolicy:
    """Policies of a peer behind the interface of our own (`algorithms.evaluation.evaluate.Policy`).

    Attributes:
        policies: of which.
        rows: (N,) indices; a single one acts in every world.
    """

    policies: Policies
    rows: NDArray[np.intp]

    @property
    def utilities(self) -> tuple[Utility, ...]:
        """The known utility, if any."""
        utility = self.policies.task.utility
        return () if utility is None else (utility,)

    @property
    def gamma(self) -> float:
        """Discount of the accrued reward that it is shown."""
        return self.policies.gamma

    @property
    def device(self) -> torch.device:
        """Where random numbers are drawn."""
        return torch.device(self.policies.task.device)

    @property
    def env(self) -> EnvAdapter:
        """The environment in our trainers' shapes."""
        return self.policies.task.env

    @torch.inference_mode()
    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Actions (N, 1) or (N, 1, k) for observations (N, 1, o); greedy where ``generator`` is None."""
        task = self.policies.task
        seen = Seen(
            observations=(observations[:, 0] / task.observation_scales).astype(np.float32),
            accrued=(accrued_reward.value[:, 0] / task.reward_scales).astype(np.float32),
            decisions=accrued_reward.decisions[:, 0].copy(),
            generator=generator,
        )
        rows = np.broadcast_to(self.rows, len(observations))
        return np.asarray(self.policies.choose(rows, seen))[:, None]
