"""PCN's buffer of episodes: training data, and the source of its commands (Reymond et al. 2022, section 4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mo_deepdrive.evaluation.pareto import crowding_distances, farthest_point_subset, non_dominated

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray


@dataclass(frozen=True)
class Episode:
    """One episode of T decisions."""

    observations: NDArray[np.float32]  # (T, o) before each action
    actions: NDArray[Any]  # (T,) or (T, k)
    returns: NDArray[np.float32]  # (T, d) discounted returns-to-go; the first is the return of the episode

    def __len__(self) -> int:
        return len(self.returns)


def returns_to_go(rewards: NDArray[np.float32], gamma: float) -> NDArray[np.float32]:
    """Discounted returns-to-go R_t = r_t + gamma R_{t+1} (..., T, d) of ``rewards`` (..., T, d)."""
    returns = rewards.astype(np.float64)
    for t in range(returns.shape[-2] - 2, -1, -1):
        returns[..., t, :] += gamma * returns[..., t + 1, :]
    return returns.astype(np.float32)


class EpisodeBuffer:
    """The best episodes so far: close to the non-dominated ones, and diverse.

    An episode's score is minus its distance to the nearest non-dominated return, in units of ``scales``. The distance
    is doubled where the crowding distance is at most ``crowding``, and slightly larger for all but the first of equal
    returns. When there are more than ``capacity`` episodes, those with the lowest scores are removed; when more than
    ``capacity`` are non-dominated, a farthest-point subset of them is kept.
    """

    REPEATED = 1e-5  # units of ``scales``

    def __init__(self, capacity: int, scales: NDArray[np.float32], crowding: float):
        self.capacity = capacity
        self.scales = np.asarray(scales, dtype=np.float64)
        self.crowding = crowding
        self.episodes: list[Episode] = []
        self._arrays: dict[str, NDArray[Any]] = {}

    def __len__(self) -> int:
        return len(self.episodes)

    @property
    def returns(self) -> NDArray[np.float64]:
        """(E, d) discounted return of every episode."""
        return np.array([episode.returns[0] for episode in self.episodes], dtype=np.float64)

    @property
    def lengths(self) -> NDArray[np.int64]:
        """(E,) decisions of every episode."""
        return np.array([len(episode) for episode in self.episodes], dtype=np.int64)

    def add(self, episodes: list[Episode]) -> None:
        """Add ``episodes``, then remove the worst."""
        self.episodes += episodes
        if len(self.episodes) > self.capacity:
            kept = self.best()
            if len(kept) < self.capacity:
                kept = np.argsort(-self.scores(), kind="stable")[: self.capacity]
            else:
                kept = kept[farthest_point_subset(self.returns[kept], self.capacity, self.scales)]
            self.episodes = [self.episodes[i] for i in kept]
        self._arrays = {}

    def scores(self) -> NDArray[np.float64]:
        """(E,) scores; at most 0."""
        points = self.returns / self.scales
        best = points[non_dominated(points)]
        gaps = np.array([np.linalg.norm(best - point, axis=1).min() for point in points])
        _, first = np.unique(points, axis=0, return_index=True)
        repeated = np.ones(len(points), dtype=np.bool_)
        repeated[first] = False
        gaps[repeated] += self.REPEATED
        gaps[crowding_distances(points) <= self.crowding] *= 2.0
        return -gaps

    def best(self) -> NDArray[np.intp]:
        """Indices of the episodes with non-dominated returns."""
        if not self.episodes:
            raise ValueError("the buffer holds no episode yet: train first, or load a checkpoint")
        return np.flatnonzero(non_dominated(self.returns))

    def bounds(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(d,) lowest and highest return-to-go."""
        returns = self._flat()["returns"]
        return returns.min(axis=0), returns.max(axis=0)

    def decisions(self) -> NDArray[np.float32]:
        """(D, o + d + 1) observation, return-to-go and number of decisions left at every time step."""
        flat = self._flat()
        left = np.repeat(flat["starts"] + flat["lengths"], flat["lengths"]) - np.arange(len(flat["returns"]))
        return np.column_stack([flat["observations"], flat["returns"], left.astype(np.float32)])

    def sample(self, count: int, generator: torch.Generator) -> tuple[NDArray[Any], ...]:
        """Observations (n, o), actions, returns-to-go (n, d) and decisions left (n,) at random time steps.

        Every episode is equally likely, whatever its length.
        """
        flat = self._flat()
        lengths = flat["lengths"]
        chosen = torch.randint(len(lengths), (count,), generator=generator).numpy()
        t = (torch.rand(count, generator=generator).numpy() * lengths[chosen]).astype(np.int64)
        rows = flat["starts"][chosen] + t
        left = (lengths[chosen] - t).astype(np.float32)
        return flat["observations"][rows], flat["actions"][rows], flat["returns"][rows], left

    def _flat(self) -> dict[str, NDArray[Any]]:
        if not self._arrays:
            lengths = self.lengths
            self._arrays = {
                name: np.concatenate([getattr(episode, name) for episode in self.episodes])
                for name in ("observations", "actions", "returns")
            }
            self._arrays |= {"lengths": lengths, "starts": np.cumsum(lengths) - lengths}
        return self._arrays

    def get_state(self) -> dict[str, torch.Tensor]:
        """All episodes as a few tensors."""
        if not self.episodes:
            return {}
        names = ("observations", "actions", "returns", "lengths")
        return {name: torch.from_numpy(np.ascontiguousarray(self._flat()[name])) for name in names}

    def set_state(self, state: Mapping[str, torch.Tensor]) -> None:
        """Resume from :meth:`get_state`."""
        self.episodes, self._arrays = [], {}
        if state:
            lengths = state["lengths"].tolist()
            columns = [state[name].split(lengths) for name in ("observations", "actions", "returns")]
            self.episodes = [Episode(*(part.numpy() for part in parts)) for parts in zip(*columns, strict=True)]
