"""What all figures of a front share: the policies shown, their colours, and the numbers that are drawn."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from scipy.optimize import isotonic_regression

from mo_deepdrive.evaluation.metrics import name_and_unit
from mo_deepdrive.evaluation.pareto import farthest_point_subset

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike, NDArray

    from mo_deepdrive.evaluation.front import Front

REPRESENTATIVES = 16  # policies that are drawn individually at most; in larger fronts these represent all
# Colours of policies: viridis, which is safe for colour-blind readers, without the yellow that is hard to see on white.
COLOUR_MAP = ListedColormap(colormaps["viridis"](np.linspace(0.0, 0.92, 256)), "policies")
LEADING = "distance"  # the objective that orders and colours policies; if there is none of this name, the first one


def number_formatter(values: ArrayLike, unit: str = "") -> Callable[[float], str]:
    """A function that formats numbers such as ``values`` with the digits that distinguish them, and with the unit."""
    numbers = np.asarray(values, dtype=np.float64)
    extent = float(np.ptp(numbers)) or float(np.abs(numbers).max())
    digits = min(max(2 - math.floor(math.log10(extent)), 0), 4) if extent > 0.0 else 1
    suffix = f" {unit}" if unit else ""

    def text(value: float) -> str:
        rounded = f"{round(value, digits) + 0.0:,.{digits}f}"  # + 0.0: never -0
        return rounded.replace("-", "\N{MINUS SIGN}") + suffix

    return text


def importance(returns: ArrayLike) -> NDArray[np.float64]:
    """``returns`` (K, d) scaled per objective from 0, the worst of the K, to 1, the best.

    NaN for an objective in which the K do not differ: no policy favours it.
    """
    values = np.asarray(returns, dtype=np.float64)
    low, extent = values.min(axis=0), np.ptp(values, axis=0)
    differ = extent > 1e-9 * np.abs(values).max(axis=0)  # by more than rounding errors
    scaled: NDArray[np.float64] = np.where(differ, (values - low) / np.where(differ, extent, 1.0), np.nan)
    return scaled


@dataclass(frozen=True)
class Projection:
    """Points projected onto their first two principal components.

    Attributes:
        points: (K, 2) centred at 0.
        loadings: (d, 2) weights of the objectives in each component; each column has length 1, or 0 if the points do
            not vary in this direction.
        explained: (2,) share of the variance along each component.
    """

    points: NDArray[np.float64]
    loadings: NDArray[np.float64]
    explained: NDArray[np.float64]


def principal_components(values: ArrayLike) -> Projection:
    """The first two principal components of ``values`` (K, d), by singular value decomposition.

    The largest loading of a component is positive, so that equal values always look the same.
    """
    points = np.asarray(values, dtype=np.float64)
    centred = points - points.mean(axis=0)
    _, sizes, axes = np.linalg.svd(centred, full_matrices=False)
    real = sizes > 1e-9 * np.abs(points).max()  # smaller ones are rounding errors
    loadings, explained = np.zeros((centred.shape[1], 2)), np.zeros(2)
    for k in np.flatnonzero(real[:2]):
        loadings[:, k] = axes[k] * np.sign(axes[k, np.abs(axes[k]).argmax()])
        explained[k] = sizes[k] ** 2 / (sizes[real] ** 2).sum()
    return Projection(centred @ loadings, loadings, explained)


@dataclass(frozen=True)
class FrontView:
    """A front as all its figures show it: the same policies, numbers and colours in each.

    Attributes:
        front: K policies with d >= 2 objectives; a policy's number is its index.
        title: what the front belongs to, such as the algorithm and the environment.
        leading: index of the objective that orders and colours policies.

    Raises:
        ValueError: if there are fewer than two objectives.
    """

    front: Front
    title: str = ""
    leading: int = field(init=False)

    def __post_init__(self) -> None:
        names = self.front.objectives
        if len(names) < 2:
            raise ValueError(f"the front has the objectives {list(names)}; figures of a front need at least two")
        object.__setattr__(self, "leading", names.index(LEADING) if LEADING in names else 0)

    @cached_property
    def importance(self) -> NDArray[np.float64]:
        """(K, d) :func:`importance` of the discounted returns.

        The discounted returns determine the front: policies that differ in when they arrive alone have the same
        undiscounted ones.
        """
        return importance(self.front.discounted)

    @property
    def leading_name(self) -> str:
        """Plain name of the leading objective."""
        return name_and_unit(self.front.objectives[self.leading])[0]

    @cached_property
    def mappable(self) -> ScalarMappable:
        """The mapping from the leading objective's discounted return to colours."""
        values = self.front.discounted[:, self.leading]
        return ScalarMappable(Normalize(float(values.min()), float(values.max())), COLOUR_MAP)

    @cached_property
    def colours(self) -> NDArray[np.float64]:
        """(K, 4) RGBA colour of each policy."""
        return np.asarray(self.mappable.to_rgba(self.front.discounted[:, self.leading]))

    @cached_property
    def arrived(self) -> NDArray[np.bool_] | None:
        """(K,) whether a policy arrives in at least half of its episodes; None unless that is known for all."""
        return self.front.success >= 0.5 if np.isfinite(self.front.success).all() else None

    def representatives(self, count: int = REPRESENTATIVES) -> NDArray[np.intp]:
        """Up to ``count`` policies that cover the front, ordered by the leading objective; more include fewer."""
        chosen = farthest_point_subset(np.nan_to_num(self.importance), count)
        order = np.lexsort((chosen, self.front.discounted[chosen, self.leading]))
        return np.asarray(chosen[order])


def separate(positions: ArrayLike, gap: float, ends: tuple[float, float]) -> NDArray[np.float64]:
    """``positions`` (n,) moved by as little as possible so that neighbours are ``gap`` apart, in the same order.

    All are between ``ends``; the gap is smaller if there is too little space.
    """
    wanted = np.asarray(positions, dtype=np.float64)
    order = np.argsort(wanted, kind="stable")
    low, high = ends
    steps = min(gap, (high - low) / max(len(wanted) - 1, 1)) * np.arange(len(wanted))
    moved = np.empty_like(wanted)
    # The least-squares solution within bounds is the one without bounds, clipped.
    moved[order] = np.clip(isotonic_regression(wanted[order] - steps).x, low, high - steps[-1]) + steps
    return moved
