"""Choosing a policy of a front by a preference: weights, a utility, or a target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.evaluation.statistics import resample

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.statistics import Estimate
    from mo_deepdrive.utilities import Utility


@dataclass(frozen=True)
class ChoiceCriterion:
    """What to maximise over the policies of a front."""

    name: str  #: of the value, for tables
    #: From returns (K, E, d) of E episodes of each of K policies to the values (K,) of the policies.
    values: Callable[[NDArray[np.float64]], NDArray[np.float64]]

    def estimate(self, returns: NDArray[np.float64]) -> Estimate:
        """The value of one policy from returns (E, d) of its episodes, with its bootstrap interval."""
        return resample(returns, lambda part: float(self.values(part[None])[0]))


def weighted_sum(weights: Mapping[str, float], objectives: Sequence[str]) -> ChoiceCriterion:
    """Prefer the greatest sum of mean returns, weighted by objective (0 where it is not named).

    A ValueError if a weight is negative; ``objectives`` are the d names in the order of the returns.
    """
    if any(weight < 0.0 for weight in weights.values()):
        raise ValueError(f"weights {dict(weights)}: returns are maximised, so weights must not be negative")
    w = np.array([weights.get(name, 0.0) for name in objectives])
    return ChoiceCriterion("weighted sum", lambda returns: (returns @ w).mean(axis=1))


def expected_utility(utility: Utility) -> ChoiceCriterion:
    """Prefer the greatest expected utility of the returns (the ESR criterion): the mean of the episodes' utilities."""
    return ChoiceCriterion(f"expected {utility.name}", lambda returns: np.asarray(utility(returns)).mean(axis=1))


def distance_to_target(target: Mapping[str, float], objectives: Sequence[str], scales: NDArray[Any]) -> ChoiceCriterion:
    """Prefer the smallest Euclidean distance, in ``scales`` (d,), by which the mean returns fall short of a target.

    Objectives that it does not name, and returns above it, do not count.
    """
    wanted = np.array([target.get(name, -np.inf) for name in objectives])

    def closeness(returns: NDArray[np.float64]) -> NDArray[np.float64]:
        shortfall = np.maximum(wanted - returns.mean(axis=1), 0.0) / scales
        return -np.asarray(np.linalg.norm(shortfall, axis=1))

    return ChoiceCriterion("minus the distance to the target", closeness)


def rank_policies(
    values: NDArray[np.float64], mean_returns: NDArray[np.float64], scales: NDArray[Any]
) -> NDArray[np.intp]:
    """Indices (K,) of policies in the order of their ``values`` (K,), the greatest first.

    Values that differ only by rounding errors are equal: then the greater sum of ``mean_returns`` (K, d), divided by
    ``scales`` (d,), comes first. A value that is not finite is a ValueError.
    """
    if not np.isfinite(values).all():
        (first, *_) = np.flatnonzero(~np.isfinite(values)).tolist()
        raise ValueError(f"policy {first} is worth {values[first]}; every policy must be worth a finite number")
    largest = float(np.abs(values).max())
    rounded = np.round(values / largest, 9) if largest > 0.0 else values
    return np.lexsort((-(mean_returns / scales).sum(axis=1), -rounded))
