"""A running mean of episode returns, an estimate of the expected return of the current policy."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

if TYPE_CHECKING:
    from numpy.typing import NDArray

MEMORY = 0.99  # decay per episode


class RunningMean:
    """Exponentially weighted mean of vectors.

    Args:
        size: d.
        device: of the mean.

    Attributes:
        value: (d,); zeros before the first vector.
        count: number of vectors so far.
    """

    def __init__(self, size: int, device: torch.device):
        self.value = torch.zeros(size, device=device)
        self.count = 0

    def add(self, vectors: NDArray[Any]) -> None:
        """Add vectors (n, d); n may be 0."""
        if not len(vectors):
            return
        mean = torch.tensor(vectors.mean(axis=0), dtype=torch.float32, device=self.value.device)
        keep = MEMORY ** len(vectors) if self.count else 0.0
        self.value = keep * self.value + (1.0 - keep) * mean
        self.count += len(vectors)

    def get_state(self) -> dict[str, torch.Tensor]:
        """The mean and the count as named tensors."""
        return {"expected_return": self.value, "episodes": torch.tensor(self.count)}

    def set_state(self, state: dict[str, torch.Tensor]) -> None:
        """Resume from :meth:`get_state`.

        Raises:
            ValueError: for a negative count.
        """
        if int(state["episodes"]) < 0:
            raise ValueError(f"'episodes' = {int(state['episodes'])} of a running mean must not be negative")
        self.value = state["expected_return"].to(self.value.device)
        self.count = int(state["episodes"])
