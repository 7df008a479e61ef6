"""The worlds of S seeds, N for each, as tensors (S, N, V, ...): a vector environment, or worlds on a device."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from mo_deepdrive.simulation.philox import STREAM
from mo_deepdrive.simulation.state import ARRIVED

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from mo_deepdrive.evaluation.env_adapter import EnvAdapter
    from mo_deepdrive.world.config import EnvConfig


class WorldStep(NamedTuple):
    """One step of all worlds, overwritten by the next.

    Attributes:
        observations: (S, N, V, o) for the next action; where an episode ended, the first of the next episode.
        final: (S, N, V, o) after the step; where an episode ended, the last of that episode.
        rewards: (S, N, V, d).
        terminated, truncated: (S, N, V) whether the vehicle's episode ended in this step.
        acted: (S, N, V) False where the vehicle had finished already.
        succeeded: (S, N, V) whether an episode that ended in this step reached its goal.
    """

    observations: torch.Tensor
    final: torch.Tensor
    rewards: torch.Tensor
    terminated: torch.Tensor
    truncated: torch.Tensor
    acted: torch.Tensor
    succeeded: torch.Tensor


class EnvWorlds:
    """The worlds of one seed: a vector environment on the CPU.

    Args:
        env: the environments.
        seed: of the first reset; the i-th environment is seeded with ``seed + i``.
    """

    def __init__(self, env: EnvAdapter, seed: int):
        self._env, self._seed = env, seed

    def reset(self) -> torch.Tensor:
        """Begin the first episodes; observations (1, N, V, o)."""
        return torch.from_numpy(self._env.reset(self._seed)).unsqueeze(0)

    def step(self, actions: torch.Tensor) -> WorldStep:
        """Act: indices (1, N, V), or (1, N, V, k) with each axis in [-1, 1], to which it is clipped.

        Raises:
            NotFinite: for rewards or observations that are not finite.
        """
        step = self._env.step(actions[0].numpy())
        taken = (step.observations, step.final, step.rewards, step.terminated, step.truncated, step.acted)
        return WorldStep(*(torch.from_numpy(np.asarray(each)).unsqueeze(0) for each in (*taken, step.succeeded)))

    def check(self) -> dict[int, str]:
        """Nothing: a step refuses what it cannot do."""
        return {}

    def get_state(self, seed: int) -> dict[str, torch.Tensor]:
        """What continues, as named tensors; empty for other libraries' environments, which cannot be saved."""
        del seed
        return {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in self._env.get_state().items()}

    def set_state(self, states: Sequence[Mapping[str, torch.Tensor]], step: int) -> torch.Tensor | None:
        """Resume after ``step`` steps; observations (1, N, V, o) if new episodes had to begin, else None."""
        if not self._env.native:
            # They begin new episodes, with different seeds.
            return torch.from_numpy(self._env.reset(self._seed + step)).unsqueeze(0)
        self._env.set_state({name: tensor.numpy() for name, tensor in states[0].items()})
        return None


class DeviceWorlds:
    """N worlds for each of S seeds, on one device.

    Args:
        config: of the worlds.
        seeds: S seeds; the episodes of each are the same whatever the others are.
        num_envs: N.
        device: where they are.
    """

    def __init__(self, config: EnvConfig, seeds: Sequence[int], num_envs: int, device: torch.device):
        from mo_deepdrive.device.worlds import TensorWorlds  # not earlier: few trainings need it

        self._seeds, self._num_envs = list(seeds), num_envs
        self._worlds = TensorWorlds(config, len(seeds) * num_envs, device)

    def reset(self) -> torch.Tensor:
        """Begin the first episodes; observations (S, N, V, o)."""
        count = len(self._seeds)
        self._worlds.begin(np.repeat(self._seeds, self._num_envs), np.tile(np.arange(self._num_envs), count))
        return self._by_seed(self._worlds.observations)

    def step(self, actions: torch.Tensor) -> WorldStep:
        """Act: indices (S, N, V), or (S, N, V, k) with each axis in [-1, 1], to which it is clipped."""
        worlds = self._worlds
        worlds.step(actions.flatten(0, 1))
        # A vehicle keeps its flags until the reset; here they mark the step of the end.
        terminated, truncated = worlds.terminated & worlds.acted, worlds.truncated & worlds.acted
        succeeded = (terminated | truncated) & (worlds.ends == ARRIVED)
        taken = (worlds.observations, worlds.final_observations, worlds.rewards, terminated, truncated, worlds.acted)
        return WorldStep(*map(self._by_seed, (*taken, succeeded)))

    def check(self) -> dict[int, str]:
        """Wait for the device; what a step could not do, by the index of the seed."""
        fault = int(self._worlds.fault.item())
        try:
            self._worlds.check(fault)
        except ValueError as error:
            return {fault // 4 // self._num_envs: str(error)}
        return {}

    def _by_seed(self, tensor: torch.Tensor) -> torch.Tensor:
        return tensor.view(len(self._seeds), self._num_envs, *tensor.shape[1:])

    def get_state(self, seed: int) -> dict[str, torch.Tensor]:
        """What continues of the worlds of the seed with this index, as named tensors of bytes."""
        first, last = seed * self._num_envs, (seed + 1) * self._num_envs
        arrays = {"state": self._worlds.read_states(), "streams": self._worlds.read_streams()}
        return {name: torch.from_numpy(each[first:last, ..., None].view(np.uint8)) for name, each in arrays.items()}

    def set_state(self, states: Sequence[Mapping[str, torch.Tensor]], step: int) -> torch.Tensor | None:
        """Resume from the states of all seeds.

        Raises:
            ValueError: for one that no world can have.
        """
        del step
        state, streams = (np.concatenate([each[name].numpy() for each in states]) for name in ("state", "streams"))
        self._worlds.write_states(state.view(self._worlds.read_states().dtype)[..., 0])
        self._worlds.write_streams(streams.view(STREAM)[..., 0])
        return None
