"""The collection loop of all actor-critics: T steps of the worlds of all seeds, as one rollout.

The worlds of S seeds, N for each, are tensors (S, N, V, ...): a vector environment, or worlds on a device.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from algorithms.learning.checkpoints import strip_prefix
from algorithms.learning.storage import EpisodeSums, RolloutStorage
from mo_deepdrive.evaluation.env_adapter import Step
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.simulation.philox import STREAM
from mo_deepdrive.simulation.state import ARRIVED
from mo_deepdrive.support.faults import LARGEST, check_vehicles

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from algorithms.learning.preferences import TrainingPreferences
    from mo_deepdrive.evaluation.env_adapter import EnvAdapter
    from mo_deepdrive.world.config import EnvConfig

WORLDS = "worlds."  # prefix of their part of a state


class EnvWorlds:
    """The worlds of one seed: a vector environment on the CPU, of which the i-th is seeded with ``seed + i``."""

    def __init__(self, env: EnvAdapter, seed: int):
        self._env, self._seed = env, seed

    def reset(self) -> Tensor:
        """Begin the first episodes; observations (1, N, V, o)."""
        return torch.from_numpy(self._env.reset(self._seed)).unsqueeze(0)

    def step(self, actions: Tensor) -> Step:
        """Act: indices (1, N, V), or (1, N, V, k) with each axis in [-1, 1], to which it is clipped."""
        step = self._env.step(actions[0].numpy())
        return Step(*(torch.from_numpy(np.asarray(array)).unsqueeze(0) for array in step[:-1]))

    def check(self) -> dict[int, str]:
        """Nothing: a step refuses what it cannot do."""
        return {}

    def get_state(self, seed: int) -> dict[str, Tensor]:
        """What continues, as named tensors; empty for other libraries' environments, which cannot be saved."""
        del seed
        return {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in self._env.get_state().items()}

    def set_state(self, states: Sequence[Mapping[str, Tensor]], step: int) -> Tensor | None:
        """Resume after ``step`` steps; observations (1, N, V, o) if new episodes had to begin, else None."""
        if not self._env.native:
            # They begin new episodes, with different seeds.
            return torch.from_numpy(self._env.reset(self._seed + step)).unsqueeze(0)
        self._env.set_state({name: tensor.numpy() for name, tensor in states[0].items()})
        return None


class DeviceWorlds:
    """N worlds for each of S seeds, on one device; the episodes of a seed are the same whatever the others are."""

    def __init__(self, config: EnvConfig, seeds: Sequence[int], num_envs: int, device: torch.device):
        from mo_deepdrive.device.worlds import TensorWorlds  # not earlier: few trainings need it

        self._seeds, self._num_envs = list(seeds), num_envs
        self._worlds = TensorWorlds(config, len(seeds) * num_envs, device)

    def reset(self) -> Tensor:
        """Begin the first episodes; observations (S, N, V, o)."""
        count = len(self._seeds)
        self._worlds.begin(np.repeat(self._seeds, self._num_envs), np.tile(np.arange(self._num_envs), count))
        return self._by_seed(self._worlds.observations)

    def step(self, actions: Tensor) -> Step:
        """Act: indices (S, N, V), or (S, N, V, k) with each axis in [-1, 1], to which it is clipped."""
        worlds = self._worlds
        worlds.step(actions.flatten(0, 1))
        # A vehicle keeps its flags until the reset; here they mark the step of the end.
        terminated, truncated = worlds.terminated & worlds.acted, worlds.truncated & worlds.acted
        succeeded = (terminated | truncated) & (worlds.ends == ARRIVED)
        flags = terminated, truncated, worlds.acted
        taken = (worlds.observations, worlds.rewards, *flags, worlds.final_observations, succeeded)
        return Step(*map(self._by_seed, taken))

    def check(self) -> dict[int, str]:
        """Wait for the device; what a step could not do, by the index of the seed."""
        fault = int(self._worlds.fault.item())
        try:
            self._worlds.check(fault)
        except ValueError as error:
            return {fault // 4 // self._num_envs: str(error)}
        return {}

    def _by_seed(self, tensor: Tensor) -> Tensor:
        return tensor.view(len(self._seeds), self._num_envs, *tensor.shape[1:])

    def get_state(self, seed: int) -> dict[str, Tensor]:
        """What continues of the worlds of the seed with this index, as named tensors of bytes."""
        first, last = seed * self._num_envs, (seed + 1) * self._num_envs
        arrays = {"state": self._worlds.read_states(), "streams": self._worlds.read_streams()}
        return {name: torch.from_numpy(each[first:last, ..., None].view(np.uint8)) for name, each in arrays.items()}

    def set_state(self, states: Sequence[Mapping[str, Tensor]], step: int) -> Tensor | None:
        """Resume from the states of all seeds."""
        del step
        state, streams = (np.concatenate([each[name].numpy() for each in states]) for name in ("state", "streams"))
        self._worlds.write_states(state.view(self._worlds.read_states().dtype)[..., 0])
        self._worlds.write_streams(streams.view(STREAM)[..., 0])
        return None


class Running(NamedTuple):
    """The running episodes of S seeds, (S, N, V, ...); the collector changes them in place."""

    observations: Tensor  # (..., o)
    accrued: Tensor  # (..., d) R_t
    discounts: Tensor  # g^t
    returns: Tensor  # (..., d) undiscounted
    lengths: Tensor  # decisions

    def arrays(self, seed: int) -> tuple[NDArray[np.float32], AccruedReward]:
        """Observations (N, V, o) and the past of a seed, for drivers that take arrays."""
        observations, value, discounts, _, decisions = (each[seed].cpu().numpy() for each in self)
        return observations, AccruedReward(value, discounts, decisions)


class Collector:
    """Steps worlds and keeps what continues from one rollout to the next: observations and running episodes."""

    def __init__(
        self,
        policy: Any,  # an ActorCritic: ``inputs`` gives what actors see, ``decide`` writes what they do
        env: EnvAdapter,  # one with the shapes of the worlds
        worlds: EnvWorlds | DeviceWorlds,
        shape: tuple[int, int, int],  # S, T and N
        outputs: int,  # of an actor's network
        sums: EpisodeSums,  # to which the episodes are added that end
        preferences: TrainingPreferences | None = None,
        *,
        static: bool,  # whether the same is done in every rollout, as on a device; else only what is needed
    ):
        seeds, steps, num_envs = shape
        v, o, d, i = env.vehicles, env.observation_size, len(env.objectives), policy.input_size
        self.policy, self.env, self.worlds = policy, env, worlds
        self.sums, self.preferences, self.static = sums, preferences, static
        zeros = partial(torch.zeros, device=sums.totals.device)
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
            outputs=zeros(*step, outputs),
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
        self.accrued_discounts = zeros(v) + 1.0  # (V,) g
        # (V, d) by which rewards are multiplied before they are accrued and learnt from; returns are as they are.
        self.shares = zeros(v, d) + 1.0

    def reset(self) -> None:
        """Begin the first episodes."""
        now = self.now
        now.observations.copy_(self.worlds.reset())
        now.discounts.fill_(1.0)
        for each in (now.accrued, now.returns, now.lengths):
            each.zero_()

    def collect(self) -> None:
        """Run all worlds for T steps; numbers of environments on the CPU that are not finite are refused."""
        # Of the many small operations on a CPU, the inference mode makes each one shorter.
        with torch.no_grad() if self.static else torch.inference_mode():
            self._collect()

    def _collect(self) -> None:
        storage, now, policy, preferences, preference = self.storage, self.now, self.policy, self.preferences, None
        if preferences is not None:
            preferences.begin_rollout()
        for t, at in enumerate(self._steps):
            if preferences is not None:
                at.preferences.copy_(preferences.follow(t, now.lengths))
                preference = at.preferences, preferences.ideal[:, None, None]
            at.inputs.copy_(policy.inputs(now.observations, now.accrued, now.discounts, preference))
            at.accrued.copy_(now.accrued)
            at.discounts.copy_(now.discounts)
            policy.decide(t, at, now)
            step = self.worlds.step(at.actions)
            self._final[:, t] = step.final
            self._keep(at, step)
        storage.inputs[:, -1] = policy.inputs(now.observations, now.accrued, now.discounts, preference)
        storage.accrued[:, -1], storage.discounts[:, -1] = now.accrued, now.discounts
        if self.static or preferences is not None or storage.truncated.any():
            if preferences is not None:
                preference = storage.preferences, preferences.ideal[:, None, None, None]
            discounts = storage.discounts[:, :-1] * self.accrued_discounts
            storage.final_inputs.copy_(policy.inputs(self._final, storage.ended_values, discounts, preference))
        self.sums.add(storage.ended, storage.ended_sums)

    def _keep(self, at: RolloutStorage, step: Step) -> None:
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
        """Refuse a rollout of the seed with this index whose rewards or their accrued sums are not finite."""
        for what, values in (("reward", self.storage.rewards[seed]), ("accrued reward", self.storage.accrued[seed])):
            if not (values.abs() <= LARGEST).all():
                check_vehicles(what, values.cpu().numpy(), self.env.name, self.env.objectives)

    # ----------------------------------------------------------------------------------------------------- checkpoints

    def get_state(self, seed: int) -> dict[str, Tensor]:
        """What continues from one rollout to the next of the seed with this index, the worlds included."""
        state = {name: tensor[seed] for name, tensor in self.now._asdict().items()}
        return state | {f"{WORLDS}{name}": each for name, each in self.worlds.get_state(seed).items()}

    def set_state(self, states: Sequence[Mapping[str, Tensor]], step: int) -> None:
        """Resume from the states of all seeds after ``step`` steps of each."""
        for seed, state in enumerate(states):
            for name, tensor in self.now._asdict().items():
                tensor[seed] = state[name]
        begun = self.worlds.set_state([strip_prefix(state, WORLDS) for state in states], step)
        if begun is not None:
            self.reset()
            self.now.observations.copy_(begun)
