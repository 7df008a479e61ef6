"""Pareto dominance and quality indicators of fronts, with moocore; every objective is maximised.

Hypervolume (Zitzler and Thiele 1999), IGD+ (Ishibuchi et al. 2015), additive epsilon (Zitzler et al. 2003) and
expected utility over weights (Zintgraf et al. 2015). Distances and weights apply to returns divided by nominal scales:
jerk is a hundred times as large as distance.
"""

from __future__ import annotations

from itertools import combinations
from math import comb
from typing import TYPE_CHECKING

import moocore
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

WEIGHTS = 50  # of the expected utility
LATTICE = 5_000  # minimum number of points from which evenly spaced weights are chosen


def finite_points(returns: ArrayLike, name: str, width: int | None = None) -> NDArray[np.float64]:
    """``returns`` as an array (n, d) of finite numbers, n and d at least 1, and d the ``width`` if it is given.

    Anything else is a ValueError with the ``name`` of the points.
    """
    points = np.asarray(returns, dtype=np.float64)
    if points.ndim != 2 or not points.size:
        raise ValueError(f"{name} has shape {points.shape}; it must be (n, d) with at least one point")
    if not np.isfinite(points).all():
        raise ValueError(f"{name} must be finite; it has {points[~np.isfinite(points)][0]}")
    if width is not None and points.shape[1] != width:
        raise ValueError(f"{name} has {points.shape[1]} objectives; the front has {width}")
    return points


def one_per_objective(values: ArrayLike, name: str, d: int) -> NDArray[np.float64]:
    """``values`` as a vector (d,) of finite numbers; anything else is a ValueError with their ``name``."""
    vector = np.asarray(values, dtype=np.float64)
    if vector.shape != (d,) or not np.isfinite(vector).all():
        raise ValueError(f"{name} = {np.asarray(values).tolist()} must be {d} finite numbers, one per objective")
    return vector


def _scales(scales: ArrayLike | None, d: int) -> NDArray[np.float64]:
    if scales is None:
        return np.ones(d)
    vector = one_per_objective(scales, "scales", d)
    if (vector <= 0.0).any():
        raise ValueError(f"scales = {vector.tolist()} must be positive")
    return vector


def non_dominated(returns: ArrayLike) -> NDArray[np.bool_]:
    """Mask (n,) of the ``returns`` (n, d), at least one, that no other dominates; of equal points only the first."""
    return np.asarray(moocore.is_nondominated(finite_points(returns, "returns"), maximise=True), dtype=np.bool_)


def hypervolume(returns: ArrayLike, reference: ArrayLike) -> float:
    """Volume dominated by ``returns`` (n, d) above the reference point (d,); 0 if none of them dominates it."""
    points = finite_points(returns, "front")
    corner = one_per_objective(reference, "reference point", points.shape[1])
    return float(moocore.hypervolume(points, ref=corner, maximise=True))


def igd_plus(returns: ArrayLike, reference_front: ArrayLike, scales: ArrayLike | None = None) -> float:
    """IGD+: mean distance by which ``returns`` (n, d) fall short of ``reference_front`` (k, d), in ``scales``."""
    points, front = _scaled_fronts(returns, reference_front, scales)
    return float(moocore.igd_plus(points, ref=front, maximise=True))


def additive_epsilon(returns: ArrayLike, reference_front: ArrayLike, scales: ArrayLike | None = None) -> float:
    """Smallest number, in ``scales``, to add to all ``returns`` so that they weakly dominate ``reference_front``."""
    points, front = _scaled_fronts(returns, reference_front, scales)
    return float(moocore.epsilon_additive(points, ref=front, maximise=True))


def _scaled_fronts(
    returns: ArrayLike, reference_front: ArrayLike, scales: ArrayLike | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    points = finite_points(returns, "front")
    front = finite_points(reference_front, "reference front", points.shape[1])
    unit = _scales(scales, points.shape[1])
    return points / unit, front / unit


def expected_utility(returns: ArrayLike, weights: ArrayLike, scales: ArrayLike | None = None) -> float:
    """Mean over ``weights`` (w, d) of the best w . (R / scales) among ``returns`` (n, d)."""
    points = finite_points(returns, "front")
    rows = finite_points(weights, "weights", points.shape[1])
    return float((points / _scales(scales, points.shape[1]) @ rows.T).max(axis=0).mean())


def evenly_spaced_weights(d: int, n: int = WEIGHTS) -> NDArray[np.float64]:
    """Weights (n, d) that sum to 1: the corners, then always the lattice point farthest from those chosen before.

    The lattice is that of Das and Dennis (1998); with d = 2 the weights are exactly even. At least one per objective.
    """
    if d < 1 or n < d:
        raise ValueError(f"n = {n} weights for d = {d} objectives: n must be at least d, and d at least 1")
    if d == 1:
        return np.ones((n, 1))
    if n == d:  # the corners; a lattice of many objectives would not fit into memory
        return np.eye(d)
    if d == 2:
        first = np.linspace(1.0, 0.0, n)
        return np.stack([first, 1.0 - first], axis=1)
    steps = next(h for h in range(1, LATTICE) if comb(h + d - 1, d - 1) >= max(LATTICE, n))
    bars = np.array(list(combinations(range(steps + d - 1), d - 1)))
    edges = np.concatenate([np.full((len(bars), 1), -1), bars, np.full((len(bars), 1), steps + d - 1)], axis=1)
    lattice = (np.diff(edges, axis=1) - 1) / steps
    return lattice[farthest_point_subset(lattice, n)]


def crowding_distances(returns: ArrayLike) -> NDArray[np.float64]:
    """(n,) crowding distance of ``returns`` (n, d): the mean gap between a point's neighbours (Deb et al. 2002).

    Per objective the gap is divided by the objective's range; the first and the last have gap 1.
    """
    points = finite_points(returns, "returns")
    n, d = points.shape
    distances = np.zeros(n)
    for i in range(d):
        order = np.argsort(points[:, i], kind="stable")
        values = points[order, i]
        extent = values[-1] - values[0]
        if extent <= 0.0:
            continue
        gaps = np.ones(n)
        gaps[1:-1] = (values[2:] - values[:-2]) / extent
        distances[order] += gaps
    mean: NDArray[np.float64] = distances / d
    return mean


def farthest_point_subset(returns: ArrayLike, count: int, scales: ArrayLike | None = None) -> NDArray[np.intp]:
    """Indices of ``count`` of the points ``returns`` (n, d), which cover them: farthest-point sampling (Gonzalez 1985).

    The best point of every objective comes first, then always the point farthest from those chosen before. All indices,
    in their order, if there are no more than ``count`` points.
    """
    points = finite_points(returns, "returns")
    if len(points) <= count:
        return np.arange(len(points))
    points = points / _scales(scales, points.shape[1])
    chosen: list[int] = list(dict.fromkeys(points.argmax(axis=0).tolist()))[:count]
    nearest = np.linalg.norm(points[:, None] - points[chosen], axis=-1).min(axis=1)
    nearest[chosen] = -1.0  # or equal points would be the same one again
    while len(chosen) < count:
        new = int(nearest.argmax())
        chosen.append(new)
        nearest = np.minimum(nearest, np.linalg.norm(points - points[new], axis=-1))
        nearest[new] = -1.0
    return np.array(chosen)
