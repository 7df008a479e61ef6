"""What is collected and learnt from: a rollout, one vehicle's part of it, its samples, and the episodes that ended."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from operator import itemgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray


@dataclass
class Rollout:
    """T steps of N environments with V vehicles, time-major.

    Attributes:
        observations: (T + 1, N, V, o) before each step, and after the last.
        final: (T, N, V, o) observations after each step; where an episode ended, the last of that episode.
        actions: (T, N, V) or (T, N, V, k).
        rewards: (T, N, V, d), multiplied by the collector's shares.
        accrued: (T + 1, N, V, d) accrued reward R_t = sum_{i<t} g^i r_i of the running episode.
        discounts: (T + 1, N, V) g^t of the running episode, with the discount g of the accrued reward.
        terminated, truncated, acted: (T, N, V); samples in which a vehicle did not act carry no information.
    """

    observations: torch.Tensor
    final: torch.Tensor
    actions: torch.Tensor
    rewards: torch.Tensor
    accrued: torch.Tensor
    discounts: torch.Tensor
    terminated: torch.Tensor
    truncated: torch.Tensor
    acted: torch.Tensor

    def of_vehicle(self, v: int, device: torch.device, *, others: bool = True) -> VehicleRollout:
        """The part of vehicle ``v``: every tensor without the vehicle axis, on ``device``.

        Args:
            v: index of the vehicle.
            device: of the tensors.
            others: with what the other vehicles observe; without, those tensors have no columns.
        """
        own = {name: tensor[:, :, v].to(device) for name, tensor in vars(self).items()}
        rest = [each for each in range(self.observations.shape[2]) if others and each != v]
        seen_by_rest = {}
        for name in ("observations", "final"):
            # Not by a list of indices, which would have to be copied to the device.
            parts = [getattr(self, name)[:, :, each].to(device) for each in rest]
            seen_by_rest[name] = torch.cat(parts, dim=-1) if parts else own[name][..., :0]
        return VehicleRollout(**own, others=seen_by_rest["observations"], final_others=seen_by_rest["final"])

    def of_vehicles(self, vehicles: Sequence[int], device: torch.device, *, others: bool = True) -> VehicleRollout:
        """The parts of k vehicles, as if each were in an environment apart: (T, N k, ...), as :meth:`of_vehicle`."""
        if len(vehicles) == 1:
            return self.of_vehicle(vehicles[0], device, others=others)
        parts = [vars(self.of_vehicle(v, device, others=others)) for v in vehicles]
        return VehicleRollout(
            **{name: torch.stack([part[name] for part in parts], 2).flatten(1, 2) for name in parts[0]}
        )


@dataclass
class VehicleRollout(Rollout):
    """One vehicle's part of a rollout: the fields of Rollout without the vehicle axis, and what the other vehicles see.

    Attributes:
        others: (T + 1, N, (V - 1) * o) observations of the other vehicles.
        final_others: (T, N, (V - 1) * o) their observations after each step, as ``final``.
    """

    others: torch.Tensor
    final_others: torch.Tensor

    def final_states(
        self, where: torch.Tensor | slice, accrued_discount: float
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """The true states after steps, in which episodes may have ended: observation, accrued reward and discount.

        Args:
            where: a mask (T, N) of M steps, for results (M, ...), or a slice of time.
            accrued_discount: g, discount of the accrued reward.
        """
        discounts = self.discounts[:-1][where]
        accrued = self.accrued[:-1][where] + discounts.unsqueeze(-1) * self.rewards[where]
        return self.final[where], accrued, discounts * accrued_discount


class Samples(NamedTuple):
    """M samples of one vehicle, as actor-critics learn from them.

    Attributes:
        inputs: (M, i) what the actor saw.
        critic_inputs: (M, ...) what the critic saw.
        actions: (M,) or (M, k).
        advantages: (M,) A_t.
        targets: (M, K) y_t, in the units of the critic's outputs.
        weights: (M,) 1 where the vehicle acted, 0 elsewhere; None if it acted in all.
        log_prob: (M,) log-probability of the actions under pi_old, for PPO and its relatives.
        outputs: (M, K) of the critic, with their gradient, where a loss need not pass ``critic_inputs`` once more.
    """

    inputs: torch.Tensor
    critic_inputs: torch.Tensor
    actions: torch.Tensor
    advantages: torch.Tensor
    targets: torch.Tensor
    weights: torch.Tensor | None = None
    log_prob: torch.Tensor | None = None
    outputs: torch.Tensor | None = None

    def flat(self) -> Samples:
        """Samples (T, N, ...) as (T N, ...)."""
        return self.each(lambda tensor: tensor.flatten(0, 1))

    def acted(self) -> Samples:
        """The samples of weight 1, without weights."""
        if self.weights is None or bool(self.weights.all()):
            return self._replace(weights=None)
        rows = self.weights.nonzero().squeeze(1)
        return self._replace(weights=None).at(rows)

    def at(self, rows: torch.Tensor) -> Samples:
        """The samples of some numbers (m,), in their order."""
        return self.each(lambda tensor: tensor.index_select(0, rows))

    def minibatches(self, epochs: int, parts: int, generator: torch.Generator) -> Iterator[Samples]:
        """``parts`` of nearly equal size of the samples in a new random order, ``epochs`` times.

        Fewer parts if there are fewer samples.
        """
        for _ in range(epochs):
            order = torch.randperm(len(self.actions), generator=generator).to(self.actions.device)
            yield from self.at(order).split(parts)

    def split(self, parts: int) -> list[Samples]:
        """Consecutive parts of nearly equal size; fewer than ``parts`` if there are fewer samples."""
        ends = [0, *np.cumsum([len(part) for part in self.actions.tensor_split(min(parts, len(self.actions)))])]
        return [self.each(itemgetter(slice(first, last))) for first, last in pairwise(ends)]

    def each(self, function: Callable[[torch.Tensor], torch.Tensor]) -> Samples:
        """What a function makes of every tensor."""
        named = {name: tensor for name, tensor in self._asdict().items() if tensor is not None}
        # Where the critic sees what the actor sees, it is not kept twice.
        done = {number: function(tensor) for number, tensor in {id(each): each for each in named.values()}.items()}
        return self._replace(**{name: done[id(tensor)] for name, tensor in named.items()})


@dataclass
class Episodes:
    """Episodes that ended during a rollout, one row each, in the order in which they ended.

    Attributes:
        vehicles: (E,) index of the vehicle.
        returns: (E, d) undiscounted.
        discounted: (E, d) of the rewards that are learnt from, with the discount of the accrued reward.
        lengths: (E,) decisions.
        succeeded: (E,) whether the goal was reached.
    """

    vehicles: NDArray[np.int64]
    returns: NDArray[np.float64]
    discounted: NDArray[np.float64]
    lengths: NDArray[np.int64]
    succeeded: NDArray[np.bool_]

    @classmethod
    def none(cls, objectives: int) -> Episodes:
        """No episodes, of rewards with ``objectives`` components."""
        no_returns, no_counts = np.zeros((0, objectives)), np.zeros(0, dtype=np.int64)
        return cls(no_counts, no_returns, no_returns, no_counts, np.zeros(0, dtype=np.bool_))

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]], objectives: int) -> Episodes:
        """Episodes from their fields by name.

        Raises:
            ValueError: if a field is missing or of the wrong type or shape, or there are others.
        """
        forms = {name: (array.dtype, array.shape[1:]) for name, array in vars(cls.none(objectives)).items()}
        found = {name: (array.dtype, array.shape[1:]) for name, array in arrays.items()}
        counts = {array.shape[:1] for array in arrays.values()}
        if found != forms or len(counts) != 1 or () in counts:
            shapes = {name: f"{array.dtype} {array.shape}" for name, array in arrays.items()}
            raise ValueError(f"the fields of the episodes do not fit together: {shapes}")
        return cls(**arrays)

    @classmethod
    def join(cls, parts: Sequence[Episodes], objectives: int) -> Episodes:
        """All episodes of ``parts``, in order."""
        columns = zip(*(vars(part).values() for part in (cls.none(objectives), *parts)), strict=True)
        return cls(*(np.concatenate(column) for column in columns))
