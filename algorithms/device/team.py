"""The teams of MAPPO for S seeds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from algorithms.mappo import TeamRollout
from algorithms.rollouts.buffers import Rollout

if TYPE_CHECKING:
    from collections.abc import Mapping

    from algorithms.mappo import TeamEpisodes


class SeedTeams:
    """Follows the episodes of N teams for each of S seeds.

    Args:
        team: follows those of one seed, on the device.
        shape: S, N and V.
    """

    def __init__(self, team: TeamEpisodes, *shape: int):
        self._team = team
        team.begin(*shape)
        self.running = {"returns": team.returns, "ended": team.ended}

    @torch.no_grad()
    def follow(self, rollout: Mapping[str, torch.Tensor]) -> TeamRollout:
        """The teams' part (S, T, N, ...) of a rollout (S, T, N, V, ...) that continues the last one."""
        found = self._team.follow(Rollout(**{name: tensor.transpose(0, 1) for name, tensor in rollout.items()}))
        for name, tensor in self.running.items():  # in its place, for an update that is captured
            tensor.copy_(getattr(self._team, name))
            setattr(self._team, name, tensor)
        return TeamRollout(*(tensor.transpose(0, 1) for tensor in found))
