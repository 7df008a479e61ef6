"""The worlds of S seeds, N for each, as tensors (S, N, ...)."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from mo_deepdrive.device.worlds import TensorWorlds
from mo_deepdrive.simulation.philox import STREAM
from mo_deepdrive.simulation.state import ARRIVED

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from mo_deepdrive.config import EnvConfig


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


class SeedWorlds:
    """N worlds for each of S seeds, on one device.

    Args:
        config: of the worlds.
        seeds: S seeds; the episodes of each are the same whatever the others are.
        num_envs: N.
        device: where they are.
    """

    def __init__(self, config: EnvConfig, seeds: Sequence[int], num_envs: int, device: torch.device):
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

    def check(self) -> None:
        """Wait for the device, and refuse what a step could not do.

        Raises:
            ValueError: for actions that are not allowed, or a world without a valid scenario.
        """
        self._worlds.check()

    def _by_seed(self, tensor: torch.Tensor) -> torch.Tensor:
        return tensor.view(len(self._seeds), self._num_envs, *tensor.shape[1:])

    def get_state(self, seed: int) -> dict[str, torch.Tensor]:
        """What continues of the worlds of the seed with this index, as named tensors of bytes."""
        first, last = seed * self._num_envs, (seed + 1) * self._num_envs
        arrays = {"state": self._worlds.read_states(), "streams": self._worlds.read_streams()}
        return {name: torch.from_numpy(each[first:last, ..., None].view(np.uint8)) for name, each in arrays.items()}

    def set_state(self, states: Sequence[Mapping[str, torch.Tensor]]) -> None:
        """Resume from the states of all seeds.

        Raises:
            ValueError: for one that no world can have.
        """
        state, streams = (np.concatenate([each[name].numpy() for each in states]) for name in ("state", "streams"))
        self._worlds.write_states(state.view(self._worlds.read_states().dtype)[..., 0])
        self._worlds.write_streams(streams.view(STREAM)[..., 0])
