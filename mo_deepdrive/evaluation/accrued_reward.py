"""The part of an episode's past on which a policy may depend: accrued reward, discount and number of decisions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

SMALLEST_DISCOUNT = 1e-6  # a gamma^t below it counts as this


@dataclass
class AccruedReward:
    """Accrued rewards of the running episodes of N environments with V vehicles.

    Attributes:
        value: (N, V, d) accrued reward R_t = sum_{i<t} g^i r_i.
        discounts: (N, V) g^t.
        decisions: (N, V) t.
    """

    value: NDArray[np.float32]
    discounts: NDArray[np.float32]
    decisions: NDArray[np.int64]

    @classmethod
    def begin(cls, num_envs: int, vehicles: int, objectives: int) -> AccruedReward:
        """Episodes before their first decision."""
        return cls(
            value=np.zeros((num_envs, vehicles, objectives), dtype=np.float32),
            discounts=np.ones((num_envs, vehicles), dtype=np.float32),
            decisions=np.zeros((num_envs, vehicles), dtype=np.int64),
        )

    def add(self, rewards: NDArray[np.float32], discount: float | NDArray[np.float32]) -> None:
        """Add the ``rewards`` (N, V, d) of one decision; ``discount`` is g, or one g per vehicle (V,)."""
        self.value += self.discounts[..., None] * rewards
        self.discounts *= discount
        self.decisions += 1

    def restart(self, where: NDArray[np.bool_]) -> None:
        """Start new episodes where the mask (N, V) is True."""
        self.value[where] = 0.0
        self.discounts[where] = 1.0
        self.decisions[where] = 0

    def take(self, rows: NDArray[np.intp]) -> AccruedReward:
        """Copies of the environments at ``rows``."""
        return AccruedReward(self.value[rows], self.discounts[rows], self.decisions[rows])
