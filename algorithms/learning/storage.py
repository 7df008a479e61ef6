"""What is collected and learnt from: a rollout of all seeds, what one policy learns from it, and sums over episodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import torch

from mo_deepdrive.evaluation.metrics import LENGTH, SUCCESS, UTILITY, return_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mo_deepdrive.utilities import Utility


@dataclass
class RolloutStorage:
    """T steps of N environments with V vehicles, of S seeds; every rollout overwrites the last.

    Attributes:
        inputs: (S, T + 1, N, V, i) what actors see before each step and after the last, scaled.
        final_inputs: (S, T, N, V, i) what they would see after each step; where an episode ended, in its last state.
        actions: (S, T, N, V) or (S, T, N, V, k).
        rewards: (S, T, N, V, d), multiplied by the collector's shares.
        accrued: (S, T + 1, N, V, d) accrued reward R_t = sum_{i<t} g^i r_i of the running episode.
        discounts: (S, T + 1, N, V) g^t of the running episode, with the discount g of the accrued reward.
        terminated, truncated: (S, T, N, V) whether the vehicle's episode ended; both only in the step in which it did.
        acted: (S, T, N, V); samples in which a vehicle, or its policy, did not act carry no information.
        preferences: (S, T, N, V, m) under which the vehicles acted; m = 0 where there are none.
        ended: (S, T, N, V) whether an episode ended.
        ended_values: (S, T, N, V, d) accrued rewards after each step.
        ended_sums: (S, T, N, V, 2 + d) after each step: whether the goal was reached, decisions, undiscounted returns.
        led: (S, T, N, V) whether a guide drove in place of the policy.
        outputs: (S, T, N, V, n) of the policy's network.
    """

    inputs: torch.Tensor
    final_inputs: torch.Tensor
    actions: torch.Tensor
    rewards: torch.Tensor
    accrued: torch.Tensor
    discounts: torch.Tensor
    terminated: torch.Tensor
    truncated: torch.Tensor
    acted: torch.Tensor
    preferences: torch.Tensor
    ended: torch.Tensor
    ended_values: torch.Tensor
    ended_sums: torch.Tensor
    led: torch.Tensor
    outputs: torch.Tensor

    def at(self, t: int) -> RolloutStorage:
        """Views of step t, (S, N, V, ...)."""
        return RolloutStorage(**{name: each[:, t] for name, each in vars(self).items()})

    def of_vehicles(self, tensor: torch.Tensor, vehicles: Sequence[int]) -> torch.Tensor:
        """The part (S, T, N k, ...) of k vehicles of a tensor (S, T, N, V, ...), as if each were in a world apart."""
        if len(vehicles) == 1:
            return tensor[:, :, :, vehicles[0]]
        if len(vehicles) < tensor.shape[3]:
            # Not by a list of indices, which would have to be copied to the device.
            tensor = torch.stack([tensor[:, :, :, v] for v in vehicles], dim=3)
        return tensor.flatten(2, 3)


@dataclass
class Rollout:
    """What one policy did and met in T steps of N environments, of one seed.

    Attributes:
        inputs: (T + 1, N, i) what the actor saw: S_0 to S_T.
        states: (T + 1, N, c) what the critic sees in them.
        final_states: (T, N, c) what the critic sees of the true states after each step; read where ``truncated``.
        actions: (T, N) or (T, N, k).
        rewards: (T, N, d).
        accrued: (T + 1, N, d) R_t.
        discounts: (T + 1, N) g^t.
        terminated, truncated, acted: (T, N).
        preferences: (T, N, m) under which the policy acted; m = 0 where there are none.
        outputs: (T, N, n) of the actor's network when it acted.
        expected_return: (d,) E[R], running mean of the accrued rewards of episodes.
        ideal: (d,) the best accrued rewards of any episode.
        utility: u of its vehicles; None where none is known.
    """

    inputs: torch.Tensor
    states: torch.Tensor
    final_states: torch.Tensor
    actions: torch.Tensor
    rewards: torch.Tensor
    accrued: torch.Tensor
    discounts: torch.Tensor
    terminated: torch.Tensor
    truncated: torch.Tensor
    acted: torch.Tensor
    preferences: torch.Tensor
    outputs: torch.Tensor
    expected_return: torch.Tensor
    ideal: torch.Tensor
    utility: Any = None

    @property
    def ended(self) -> torch.Tensor:
        """(T, N) where the episode ended."""
        return self.terminated | self.truncated

    @property
    def next_accrued(self) -> torch.Tensor:
        """(T, N, d) R_{t+1} = R_t + g^t r_t, also where the episode ended."""
        return self.accrued[:-1] + self.discounts[:-1].unsqueeze(-1) * self.rewards


class Samples(NamedTuple):
    """M samples of one policy, as it learns from them.

    Attributes:
        inputs: (M, i) what the actor saw.
        states: (M, c) what the critic saw; None for what the actor saw, until a loss is calculated.
        actions: (M,) or (M, k).
        advantages: (M,) A_t.
        targets: (M, K) y_t, in the units of the critic's outputs.
        log_prob: (M,) log-probability of the actions under the policy pi_old that collected them; None if not needed.
        weights: (M,) 1 where the vehicle acted, 0 elsewhere; None if it acted in all.
    """

    inputs: torch.Tensor
    states: Any
    actions: torch.Tensor
    advantages: torch.Tensor
    targets: torch.Tensor
    log_prob: torch.Tensor | None = None
    weights: torch.Tensor | None = None


class EpisodeSums:
    """Sums over the episodes that ended since they were last taken, of each vehicle of S seeds.

    Args:
        seeds, vehicles: S and V.
        objectives: names of the d objectives.
        utilities: one per vehicle, unchecked; empty where none is known.
        device: of the sums.

    Attributes:
        totals: (S, V, 4 + d) their number, utilities, arrivals, decisions and undiscounted returns.
    """

    def __init__(
        self, seeds: int, vehicles: int, objectives: Sequence[str], utilities: Sequence[Utility], device: torch.device
    ):
        self._objectives, self._utilities = tuple(objectives), list(utilities)
        self.totals = torch.zeros(seeds, vehicles, 4 + len(objectives), dtype=torch.float64, device=device)

    def add(self, ended: torch.Tensor, sums: torch.Tensor) -> None:
        """Add the episodes that ended where a mask (S, ..., V) says, of sums (S, ..., V, 2 + d) as in the storage."""
        returns = sums[..., 2:]
        if self._utilities:
            utility = torch.stack([u(returns[..., v, :]) for v, u in enumerate(self._utilities)], dim=-1)
        else:
            utility = torch.zeros_like(sums[..., 0])
        episodes = torch.cat([torch.stack([torch.ones_like(utility), utility], dim=-1), sums], dim=-1)
        episodes = episodes.masked_fill(~ended.unsqueeze(-1), 0.0)
        self.totals += episodes.flatten(1, -3).sum(1)

    def take(self) -> list[list[dict[str, float]]]:
        """Means over the episodes since the last call, of every seed and vehicle; empty without any."""
        found = self.totals.tolist()
        self.totals.zero_()
        return [[self._means(*numbers) for numbers in vehicles] for vehicles in found]

    def _means(self, count: float, *sums: float) -> dict[str, float]:
        names = (UTILITY, SUCCESS, LENGTH, *map(return_of, self._objectives))
        means = {name: each / count for name, each in zip(names, sums, strict=True)} if count else {}
        return means if self._utilities else {name: each for name, each in means.items() if name != UTILITY}
