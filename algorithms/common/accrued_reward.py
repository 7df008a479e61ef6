"""What an episode has come to so far, as far as a policy may depend on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass
class AccruedReward:
    """The running episodes of N worlds with V vehicles.

    Attributes:
        value: (N, V, d) accrued reward R_t = sum over i < t of gamma^i r_i.
        discounts: (N, V) gamma^t.
        decisions: (N, V) t.
    """

    value: NDArray[np.float32]
    discounts: NDArray[np.float32]
    decisions: NDArray[np.int64]

    @classmethod
    def begin(cls, worlds: int, vehicles: int, objectives: int) -> AccruedReward:
        """Episodes in which nothing has happened yet."""
        return cls(
            value=np.zeros((worlds, vehicles, objectives), dtype=np.float32),
            discounts=np.ones((worlds, vehicles), dtype=np.float32),
            decisions=np.zeros((worlds, vehicles), dtype=np.int64),
        )

    def add(self, rewards: NDArray[np.float32], gamma: float) -> None:
        """One decision more in every world, with ``rewards`` (N, V, d)."""
        self.value += self.discounts[..., None] * rewards
        self.discounts *= gamma
        self.decisions += 1

    def restart(self, where: NDArray[np.bool_]) -> None:
        """Begin anew where the mask (N, V) says so."""
        self.value[where] = 0.0
        self.discounts[where] = 1.0
        self.decisions[where] = 0

    def take(self, rows: NDArray[np.intp]) -> AccruedReward:
        """Copies of the worlds at ``rows``."""
        return AccruedReward(self.value[rows], self.discounts[rows], self.decisions[rows])
