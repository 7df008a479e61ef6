"""What is collected and learnt from: a rollout of all seeds, what one policy learns from it, and sums over episodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from mo_deepdrive.evaluation.metrics import LENGTH, SUCCESS, UTILITY, return_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mo_deepdrive.utilities import Utility


@dataclass
class RolloutStorage:
    """T steps of N environments with V vehicles, of S seeds; every rollout overwrites the last.

    All are (S, T, N, V, ...), but the first axis of time has T + 1 where that is said.
    """

    inputs: Tensor  # (..., i), T + 1: what actors see before each step and after the last, scaled
    final_inputs: Tensor  # (..., i) what they would see after each step; after an episode, in its last state
    actions: Tensor  # (...) or (..., k)
    rewards: Tensor  # (..., d), multiplied by the collector's shares
    accrued: Tensor  # (..., d), T + 1: accrued reward R_t = sum_{i<t} g^i r_i of the running episode
    discounts: Tensor  # T + 1: g^t of the running episode, with the discount g of the accrued reward
    terminated: Tensor  # whether the vehicle's episode ended; it and the next only in the step in which it did
    truncated: Tensor
    acted: Tensor  # samples in which a vehicle, or its policy, did not act carry no information
    preferences: Tensor  # (..., m) under which the vehicles acted; m = 0 where there are none
    ended: Tensor  # whether an episode ended
    ended_values: Tensor  # (..., d) accrued rewards after each step
    ended_sums: Tensor  # (..., 2 + d) after each step: whether the goal was reached, decisions, plain returns
    led: Tensor  # whether a guide drove in place of the policy
    outputs: Tensor  # (..., n) of the policy's network

    def at(self, t: int) -> RolloutStorage:
        """Views of step t, (S, N, V, ...)."""
        return RolloutStorage(**{name: each[:, t] for name, each in vars(self).items()})

    def of_vehicles(self, tensor: Tensor, vehicles: Sequence[int]) -> Tensor:
        """The part (S, T, N k, ...) of k vehicles of a tensor (S, T, N, V, ...), as if each were in a world apart."""
        if len(vehicles) == 1:
            return tensor[:, :, :, vehicles[0]]
        if len(vehicles) < tensor.shape[3]:
            # Not by a list of indices, which would have to be copied to the device.
            tensor = torch.stack([tensor[:, :, :, v] for v in vehicles], dim=3)
        return tensor.flatten(2, 3)


@dataclass
class Rollout:
    """What one policy did and met in T steps of N environments, of one seed; fields as of :class:`RolloutStorage`."""

    inputs: Tensor  # (T + 1, N, i) what the actor saw: S_0 to S_T
    states: Tensor  # (T + 1, N, c) what the critic sees in them
    final_states: Tensor  # (T, N, c) what it sees of the true states after each step; read where ``truncated``
    actions: Tensor  # (T, N) or (T, N, k)
    rewards: Tensor  # (T, N, d)
    accrued: Tensor  # (T + 1, N, d) R_t
    discounts: Tensor  # (T + 1, N) g^t
    terminated: Tensor  # (T, N)
    truncated: Tensor
    acted: Tensor
    preferences: Tensor  # (T, N, m) under which the policy acted
    outputs: Tensor  # (T, N, n) of the actor's network when it acted
    expected_return: Tensor  # (d,) E[R], running mean of the accrued rewards of episodes
    ideal: Tensor  # (d,) the best accrued rewards of any episode
    prices: Any = None  # (d,) by which rewards count beside the utility; None where nothing does
    utility: Any = None  # u of its vehicles; None where none is known

    @property
    def ended(self) -> Tensor:
        """(T, N) where the episode ended."""
        return self.terminated | self.truncated

    @property
    def next_accrued(self) -> Tensor:
        """(T, N, d) R_{t+1} = R_t + g^t r_t, also where the episode ended."""
        return self.accrued[:-1] + self.discounts[:-1].unsqueeze(-1) * self.rewards


class Samples(NamedTuple):
    """M samples of one policy, as it learns from them."""

    inputs: Tensor  # (M, i) what the actor saw
    states: Any  # (M, c) what the critic saw; None for what the actor saw, until a loss is calculated
    actions: Tensor  # (M,) or (M, k)
    advantages: Tensor  # (M,) A_t
    targets: Tensor  # (M, K) y_t, in the units of the critic's outputs
    log_prob: Tensor | None = None  # (M,) of the actions under pi_old, which collected them; None if not needed
    weights: Tensor | None = None  # (M,) 1 where the vehicle acted, 0 elsewhere; None if it acted in all


class EpisodeSums:
    """Sums over the episodes that ended since they were last taken, of each vehicle of S seeds.

    ``utilities`` are one per vehicle, unchecked; none where none is known.
    """

    def __init__(
        self, seeds: int, vehicles: int, objectives: Sequence[str], utilities: Sequence[Utility], device: torch.device
    ):
        self._objectives, self._utilities = tuple(objectives), list(utilities)
        # (S, V, 4 + d) their number, utilities, arrivals, decisions and undiscounted returns.
        self.totals = torch.zeros(seeds, vehicles, 4 + len(objectives), dtype=torch.float64, device=device)

    def add(self, ended: Tensor, sums: Tensor) -> None:
        """Add the episodes that ended where a mask (S, ..., V) says, of sums (S, ..., V, 2 + d) as in the storage."""
        utility = torch.zeros_like(sums[..., 0])
        if self._utilities:
            utility = torch.stack([u(sums[..., v, 2:]) for v, u in enumerate(self._utilities)], dim=-1)
        episodes = torch.cat([torch.stack([torch.ones_like(utility), utility], dim=-1), sums], dim=-1)
        self.totals += episodes.masked_fill(~ended.unsqueeze(-1), 0.0).flatten(1, -3).sum(1)

    def take(self) -> list[list[dict[str, float]]]:
        """Means over the episodes since the last call, of every seed and vehicle; empty without any."""
        found = self.totals.tolist()
        self.totals.zero_()
        return [[self._means(*numbers) for numbers in vehicles] for vehicles in found]

    def _means(self, count: float, *sums: float) -> dict[str, float]:
        names = (UTILITY, SUCCESS, LENGTH, *map(return_of, self._objectives))
        means = {name: each / count for name, each in zip(names, sums, strict=True)} if count else {}
        return means if self._utilities else {name: each for name, each in means.items() if name != UTILITY}
