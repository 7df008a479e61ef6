"""The collection loop of all actor-critics: T steps of the worlds of all seeds, as one rollout."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import torch

from algorithms.learning.checkpoints import strip_prefix
from algorithms.learning.storage import EpisodeSums, RolloutStorage
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.support.faults import LARGEST, check_vehicles

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from algorithms.learning.preferences import TrainingPreferences
    from algorithms.learning.worlds import DeviceWorlds, EnvWorlds, WorldStep
    from mo_deepdrive.evaluation.env_adapter import EnvAdapter

WORLDS = "worlds."  # prefix of their part of a state


class Running(NamedTuple):
    """The running episodes of S seeds; the collector changes them in place.

    Attributes:
        observations: (S, N, V, o).
        accrued: (S, N, V, d) R_t.
        discounts: (S, N, V) g^t.
        returns: (S, N, V, d) undiscounted.
        lengths: (S, N, V) decisions.
    """

    observations: torch.Tensor
    accrued: torch.Tensor
    discounts: torch.Tensor
    returns: torch.Tensor
    lengths: torch.Tensor

    def arrays(self, seed: int) -> tuple[NDArray[np.float32], AccruedReward]:
        """Observations (N, V, o) and the past of a seed, for drivers that take arrays."""
        observations, value, discounts, _, decisions = (each[seed].cpu().numpy() for each in self)
        return observations, AccruedReward(value, discounts, decisions)


class Decides(Protocol):
    """What drives in a rollout."""

    @property
    def input_size(self) -> int:
        """I."""

    @property
    def output_size(self) -> int:
        """N of the actors' networks."""

    def inputs(
        self, observations: torch.Tensor, accrued: torch.Tensor, discounts: torch.Tensor, preference: Any
    ) -> torch.Tensor:
        """What actors see (S, N, V, i), scaled."""

    def decide(self, t: int, at: RolloutStorage, now: Running) -> None:
        """Write ``actions`` of step t into its place in the rollout, and there ``outputs`` and ``led``."""


class Collector:
    """Steps worlds and keeps what continues from one rollout to the next: observations and running episodes.

    Args:
        policy: what drives.
        env: one with the shapes of the worlds.
        worlds: of S seeds.
        shape: S, T (the length of a rollout) and N.
        sums: to which the episodes are added that end.
        preferences: under which vehicles act; None if there are none.

    Attributes:
        storage: the rollout.
        now: the running episodes.
        accrued_discounts: (V,) g, discount of the accrued rewards.
        shares: (V, d) by which rewards are multiplied before they are accrued and learnt from; the returns of episodes
            are the environment's.
        static: whether the same is done in every rollout, as on a device; else only what is needed.
    """

    def __init__(
        self,
        policy: Decides,
        env: EnvAdapter,
        worlds: EnvWorlds | DeviceWorlds,
        shape: tuple[int, int, int],
        sums: EpisodeSums,
        preferences: TrainingPreferences | None = None,
        *,
        static: bool,
    ):
        seeds, steps, num_envs = shape
        v, o, d, i = env.vehicles, env.observation_size, len(env.objectives), policy.input_size
        self.policy, self.env, self.worlds, self.steps = policy, env, worlds, steps
        self.sums, self.preferences, self.static = sums, preferences, static
        device = sums.totals.device

        def zeros(*sizes: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(sizes, dtype=dtype, device=device)

        step, longer, flags = (seeds, steps, num_envs, v), (seeds, steps + 1, num_envs, v), {"dtype": torch.bool}
        self.storage = RolloutStorage(
            inputs=zeros(*longer, i),
            final_inputs=zeros(*step, i),
            actions=zeros(*step, env.actions) if env.continuous else zeros(*step, dtype=torch.int64),
            rewards=zeros(*step, d),
            accrued=zeros(*longer, d),
            discounts=zeros(*longer),
            terminated=zeros(*step, **flags),
            truncated=zeros(*step, **flags),
            acted=zeros(*step, **flags),
            preferences=zeros(*step, 0 if preferences is None else preferences.width),
            ended=zeros(*step, **flags),
            ended_values=zeros(*step, d),
            ended_sums=zeros(*step, 2 + d, dtype=torch.float64),
            led=zeros(*step, **flags),
            outputs=zeros(*step, policy.output_size),
        )
        self._steps = [self.storage.at(t) for t in range(steps)]
        self._final = zeros(*step, o)  # observations after each step
        now = seeds, num_envs, v
        self.now = Running(
            observations=zeros(*now, o),
            accrued=zeros(*now, d),
            discounts=zeros(*now) + 1.0,
            returns=zeros(*now, d, dtype=torch.float64),
            lengths=zeros(*now, dtype=torch.int64),
        )
        self.accrued_discounts, self.shares = zeros(v) + 1.0, zeros(v, d) + 1.0

    def reset(self) -> None:
        """Begin the first episodes."""
        observations, accrued, discounts, returns, lengths = self.now
        observations.copy_(self.worlds.reset())
        discounts.fill_(1.0)
        for each in (accrued, returns, lengths):
            each.zero_()

    def collect(self) -> None:
        """Run all worlds for T steps.

        Raises:
            NotFinite: for rewards or observations of environments on the CPU that are not finite.
        """
        # Of the many small operations on a CPU, the inference mode makes each one shorter.
        with torch.no_grad() if self.static else torch.inference_mode():
            self._collect()

    def _collect(self) -> None:
        storage, now, policy, preference = self.storage, self.now, self.policy, None
        if self.preferences is not None:
            self.preferences.begin_rollout()
        for t, at in enumerate(self._steps):
            if self.preferences is not None:
                at.preferences.copy_(self.preferences.follow(t, now.lengths))
                preference = at.preferences, self.preferences.ideal[:, None, None]
            at.inputs.copy_(policy.inputs(now.observations, now.accrued, now.discounts, preference))
            at.accrued.copy_(now.accrued)
            at.discounts.copy_(now.discounts)
            policy.decide(t, at, now)
            step = self.worlds.step(at.actions)
            self._final[:, t] = step.final
            self._keep(at, step)
        storage.inputs[:, -1] = policy.inputs(now.observations, now.accrued, now.discounts, preference)
        storage.accrued[:, -1], storage.discounts[:, -1] = now.accrued, now.discounts
        if self.static or self.preferences is not None or storage.truncated.any():
            if self.preferences is not None:
                preference = storage.preferences, self.preferences.ideal[:, None, None, None]
            discounts = storage.discounts[:, :-1] * self.accrued_discounts
            storage.final_inputs.copy_(policy.inputs(self._final, storage.ended_values, discounts, preference))
        self.sums.add(storage.ended, storage.ended_sums)

    def _keep(self, at: RolloutStorage, step: WorldStep) -> None:
        """Write a step of the worlds into its place in the rollout, and into the running episodes."""
        now = self.now
        torch.mul(step.rewards, self.shares, out=at.rewards)
        torch.logical_and(step.terminated | step.truncated, step.acted, out=at.ended)
        torch.addcmul(now.accrued, now.discounts.unsqueeze(-1), at.rewards, out=at.ended_values)
        now.accrued.copy_(at.ended_values)
        now.discounts.mul_(self.accrued_discounts)
        now.returns.add_(step.rewards)
        now.lengths.add_(1)
        at.terminated.copy_(step.terminated)
        at.truncated.copy_(step.truncated)
        torch.logical_and(step.acted, ~at.led, out=at.acted)
        # Who did not act has no episode under way.
        begins = at.ended | ~step.acted
        now.observations.copy_(step.observations)
        if self.static or begins.any():
            at.ended_sums[..., 0] = step.succeeded
            at.ended_sums[..., 1] = now.lengths
            at.ended_sums[..., 2:] = now.returns
            now.accrued.masked_fill_(begins.unsqueeze(-1), 0.0)
            now.returns.masked_fill_(begins.unsqueeze(-1), 0.0)
            now.discounts.masked_fill_(begins, 1.0)
            now.lengths.masked_fill_(begins, 0)

    def check(self, seed: int) -> None:
        """Refuse a rollout of the seed with this index whose rewards or their accrued sums are not finite.

        Raises:
            NotFinite: naming the environment, the vehicle and the objective.
        """
        for what, values in (("reward", self.storage.rewards[seed]), ("accrued reward", self.storage.accrued[seed])):
            if not (values.abs() <= LARGEST).all():
                check_vehicles(what, values.cpu().numpy(), self.env.name, self.env.objectives)

    # ----------------------------------------------------------------------------------------------------- checkpoints

    def get_state(self, seed: int) -> dict[str, torch.Tensor]:
        """What continues from one rollout to the next of the seed with this index, the worlds included."""
        state = {name: tensor[seed] for name, tensor in self.now._asdict().items()}
        return state | {f"{WORLDS}{name}": each for name, each in self.worlds.get_state(seed).items()}

    def set_state(self, states: Sequence[Mapping[str, torch.Tensor]], step: int) -> None:
        """Resume from the states of all seeds after ``step`` steps of each.

        Raises:
            ValueError: for what no world can have.
        """
        for seed, state in enumerate(states):
            for name, tensor in self.now._asdict().items():
                tensor[seed] = state[name]
        begun = self.worlds.set_state([strip_prefix(state, WORLDS) for state in states], step)
        if begun is not None:
            self.reset()
            self.now.observations.copy_(begun)
