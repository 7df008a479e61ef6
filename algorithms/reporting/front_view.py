"""What the pictures of a front have in common: names, numbers, colours, and the numbers that are drawn."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import isotonic_regression

from algorithms.common.pareto import spread
from algorithms.evaluation.front import Front
from mo_deepdrive.objectives import INDEX, OBJECTIVES

REPRESENTATIVES = 16  # policies that are drawn one by one; of more, these many stand for all
LEADING = "distance"  # the objective that orders and colours policies; the first one where there is none of this name
# Viridis, which the colour-blind can read, without the yellow that white paper swallows.
COLOUR_MAP = ListedColormap(matplotlib.colormaps["viridis"](np.linspace(0.0, 0.92, 256)), "policies")


def name_and_unit(objective: str) -> tuple[str, str]:
    """What people call an objective, and the unit of its return; both as they are, or "", for unknown ones."""
    if objective not in INDEX:
        return objective, ""
    unit = OBJECTIVES[INDEX[objective]].unit
    return objective.replace("_", " ").replace("g force", "g-force"), "" if unit == "1" else unit.replace("^3", "³")


def label(objective: str, how: str = "sum") -> str:
    """The name of an objective's return and, where there is one, its unit with how decisions are added up."""
    name, unit = name_and_unit(objective)
    return f"{name} ({how}, {unit})" if unit else name


def writer(values: ArrayLike, unit: str = "") -> Callable[[float], str]:
    """A function that writes numbers such as ``values`` with the digits that tell them apart, and with the unit."""
    known = np.asarray(values, dtype=np.float64)
    extent = float(np.ptp(known)) or float(np.abs(known).max())
    digits = min(max(2 - math.floor(math.log10(extent)), 0), 4) if extent > 0.0 else 1
    suffix = f" {unit}" if unit else ""

    def write(value: float) -> str:
        text = f"{round(value, digits) + 0.0:,.{digits}f}"  # + 0.0: never -0
        return text.replace("-", "\N{MINUS SIGN}") + suffix

    return write


def importance(returns: ArrayLike) -> NDArray[np.float64]:
    """``returns`` (K, d), maximised, on a scale per objective from 0, the worst of the K, to 1, the best.

    NaN for an objective in which the K do not differ: none of them favours it.
    """
    values = np.asarray(returns, dtype=np.float64)
    low, extent = values.min(axis=0), np.ptp(values, axis=0)
    differ = extent > 1e-9 * np.abs(values).max(axis=0)  # by more than rounding errors
    scaled: NDArray[np.float64] = np.where(differ, (values - low) / np.where(differ, extent, 1.0), np.nan)
    return scaled


@dataclass(frozen=True)
class Projection:
    """Points in two dimensions, by principal components.

    Attributes:
        points: (K, 2) around 0.
        loadings: (d, 2) what each axis is made of; each column has length 1, or 0 where the points do not differ.
        explained: (2,) share of the variance along each axis.
    """

    points: NDArray[np.float64]
    loadings: NDArray[np.float64]
    explained: NDArray[np.float64]


def principal_components(values: ArrayLike) -> Projection:
    """The two principal components of ``values`` (K, d), by singular value decomposition.

    The largest loading of an axis is positive, so that equal values always look the same.
    """
    known = np.asarray(values, dtype=np.float64)
    centred = known - known.mean(axis=0)
    _, sizes, axes = np.linalg.svd(centred, full_matrices=False)
    real = sizes > 1e-9 * np.abs(known).max()  # rounding errors have directions, too
    loadings, explained = np.zeros((centred.shape[1], 2)), np.zeros(2)
    for k in np.flatnonzero(real[:2]):
        loadings[:, k] = axes[k] * np.sign(axes[k, np.abs(axes[k]).argmax()])
        explained[k] = sizes[k] ** 2 / (sizes[real] ** 2).sum()
    return Projection(centred @ loadings, loadings, explained)


@dataclass(frozen=True)
class View:
    """A front as all its pictures show it, with the same policies, numbers and colours, to be read together.

    Attributes:
        front: K policies of d >= 2 objectives; a policy's number is its place in it.
        title: of what the front is.
    """

    front: Front
    title: str = ""
    leading: int = field(init=False)  # the objective that orders and colours policies

    def __post_init__(self) -> None:
        names = self.front.objectives
        if len(names) < 2:
            raise ValueError(f"the front has the objectives {list(names)}; pictures of one need at least two")
        object.__setattr__(self, "leading", names.index(LEADING) if LEADING in names else 0)

    @cached_property
    def importance(self) -> NDArray[np.float64]:
        """(K, d), of the undiscounted returns."""
        return importance(self.front.returns)

    @property
    def leading_name(self) -> str:
        return name_and_unit(self.front.objectives[self.leading])[0]

    @cached_property
    def mappable(self) -> ScalarMappable:
        """From the leading objective's undiscounted return to colours."""
        values = self.front.returns[:, self.leading]
        return ScalarMappable(Normalize(float(values.min()), float(values.max())), COLOUR_MAP)

    @cached_property
    def colours(self) -> NDArray[np.float64]:
        """(K, 4)."""
        return np.asarray(self.mappable.to_rgba(self.front.returns[:, self.leading]))

    @cached_property
    def arrived(self) -> NDArray[np.bool_] | None:
        """(K,) who arrives in at least half of the episodes; None where that is not known of all."""
        return self.front.success >= 0.5 if np.isfinite(self.front.success).all() else None

    def representatives(self, count: int = REPRESENTATIVES) -> NDArray[np.intp]:
        """Up to ``count`` policies that cover the front, by the leading objective; fewer are some of the more."""
        chosen = spread(np.nan_to_num(self.importance), count)
        order = np.lexsort((chosen, self.front.returns[chosen, self.leading]))
        return np.asarray(chosen[order])


def apart(positions: ArrayLike, gap: float, ends: tuple[float, float]) -> NDArray[np.float64]:
    """``positions`` (n,) moved as little as it takes for neighbours to be ``gap`` apart, in the same order.

    All lie between ``ends``; the gap is less where there is too little room for it.
    """
    wanted = np.asarray(positions, dtype=np.float64)
    order = np.argsort(wanted, kind="stable")
    low, high = ends
    steps = min(gap, (high - low) / max(len(wanted) - 1, 1)) * np.arange(len(wanted))
    moved = np.empty_like(wanted)
    # Least squares within bounds: those without them, cut off.
    moved[order] = np.clip(isotonic_regression(wanted[order] - steps).x, low, high - steps[-1]) + steps
    return moved


def beside(
    points: NDArray[np.float64],
    sizes: NDArray[np.float64],
    others: NDArray[np.float64],
    area: tuple[float, float, float, float],
    clearance: float = 5.0,
) -> NDArray[np.float64]:
    """Where to write labels: centres (n, 2), near ``points`` and, as far as can be, off ``others`` and each other.

    Args:
        points: (n, 2) what is labelled.
        sizes: (n, 2) widths and heights of the labels.
        others: (k, 2) everything that labels should leave visible.
        area: left, bottom, right and top end of where labels may be.
        clearance: distance from ``others`` that labels should keep.
    """
    left, bottom, right, top = area
    angles = np.linspace(0.25, 2.25, 16, endpoint=False) * math.pi
    compass = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    placed: list[NDArray[np.float64]] = []
    for i, (point, size) in enumerate(zip(points, sizes, strict=True)):
        candidates = np.concatenate([point + compass * (size / 2 + r) for r in (6.0, 11.0, 18.0, 27.0, 38.0)])
        cost = 0.06 * np.linalg.norm(candidates - point, axis=1)
        half = size / 2
        gaps = np.linalg.norm(np.maximum(np.abs(candidates[:, None] - others) - half, 0.0), axis=2)
        cost += (gaps < clearance).sum(axis=1)
        if placed:
            close = (sizes[:i] + size) / 2 + 1.0
            cost += 20.0 * (np.abs(candidates[:, None] - np.array(placed)) < close).all(axis=2).sum(axis=1)
        x, y = candidates.T
        cost += 50.0 * ((x - half[0] < left) | (x + half[0] > right) | (y - half[1] < bottom) | (y + half[1] > top))
        placed.append(candidates[int(cost.argmin())])
    return np.array(placed).reshape(-1, 2)
