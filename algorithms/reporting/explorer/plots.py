"""Figures of a front: what each policy favours, and how the policies compare.

All show the same policies in the same colours, with the same numbers.
"""

from __future__ import annotations

import math
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator, PercentFormatter
from scipy.optimize import isotonic_regression

from algorithms.reporting.style import (
    DIM,
    FAINT,
    GRID,
    INK,
    figure_style,
    grid_shape,
    objective_colour,
    save_figure,
    surround,
)
from mo_deepdrive.evaluation.metrics import SUCCESS, label, name_and_unit, title_of, without_vehicle
from mo_deepdrive.evaluation.pareto import farthest_point_subset
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from matplotlib.axes import Axes
    from numpy.typing import ArrayLike, NDArray

    from mo_deepdrive.evaluation.front import Front

REPRESENTATIVES = 16  # policies that are drawn individually at most; in larger fronts these represent all
BARS = 8  # policies in bars.png
MOST_PAIRED = 8  # objectives of which scatter.png shows all pairs
MOST_DRAWN = 20  # objectives that all figures but importance.png have room for
LEADING = "distance"  # the objective that orders and colours policies; if there is none of this name, the first one
# Colours of policies: viridis, which is safe for colour-blind readers, without the yellow that is hard to see on white.
COLOUR_MAP = ListedColormap(colormaps["viridis"](np.linspace(0.0, 0.92, 256)), "policies")
HALO = withStroke(linewidth=2.0, foreground="white")
# The paper's names for low values of these costs (its figure 7).
PAPER_NAMES = {"g_force": "comfort", "jerk": "smoothness"}


def draw_front(
    front: Front, directory: str | Path, *, reference_front: NDArray[np.float64] | None = None, title: str = ""
) -> list[Path]:
    """Draw a front into ``directory``: importance, reduction, parallel, scatter and bars, all ``.png``.

    Of more than MOST_PAIRED objectives there is no scatter; of more than MOST_DRAWN, those of several vehicles, there
    is importance alone. A policy's number is its row in ``front.csv``. Returns are discounted, as they determine
    dominance, except in bars.png.

    Args:
        front: K policies with at least two objectives, as written to ``front.csv``.
        directory: an existing one.
        reference_front: (k, d) best-known returns, discounted with the front's gamma, drawn behind the front.
        title: what the front belongs to, such as the algorithm and the environment.

    Returns:
        The files.
    """
    view = FrontView(front, title)
    d = len(front.objectives)
    if reference_front is not None:
        reference_front = np.asarray(reference_front, dtype=np.float64)
        if reference_front.ndim != 2 or reference_front.shape[1] != d or not len(reference_front):
            raise ValueError(f"reference_front has shape {reference_front.shape}; it must be (k, {d}), k at least 1")
    paths = []
    with figure_style({"text.parse_math": False}):
        figures = {"importance": _importance(view)}
        if d <= MOST_DRAWN:
            figures |= {"reduction": _reduction(view), "parallel": _parallel(view), "bars": _bars(view)}
        if d <= MOST_PAIRED:
            figures["scatter"] = _scatter(view, reference_front)
        for name, figure in figures.items():
            path = Path(directory) / f"{name}.png"
            save_figure(figure, path)
            paths.append(path)
    return paths


def _importance(view: FrontView) -> Figure:
    """A row of bars per objective: where each policy is between the front's worst and its best."""
    front, shown = view.front, view.representatives()
    notes = (
        _returns_note(view, discounted=True),
        _policies_note(view, shown) + (f", by {view.leading_name}" if len(front) > 1 else ""),
        f"0 and 1: the worst and the best of the {len(front)}" if len(front) > 1 else "",
        _colour_note(view),
    )
    d, n = len(front.objectives), len(shown)
    width = max(8.0, 1.4 + 0.56 * n)
    figure = _make_figure(view, width, 1.02 * d + 0.5, "importance of the objectives", notes)
    axes = figure.subplots(d, 1, squeeze=False, sharex=True)[:, 0]
    for i, (axis, name) in enumerate(zip(axes, front.objectives, strict=True)):
        values = front.discounted[:, i]
        text = number_formatter(values, name_and_unit(name)[1])
        title = label(name, "discounted")
        axis.set_title(f"{PAPER_NAMES[name]}: {title}" if name in PAPER_NAMES else title)
        axis.set_ylim(0.0, 1.24)
        axis.grid(visible=False)
        axis.tick_params(axis="x", length=0)
        if np.isnan(view.importance[:, i]).any():
            axis.set_yticks([])
            same = text(values[0]) + (", the same for every policy" if len(front) > 1 else "")
            axis.text(0.5, 0.45, same, transform=axis.transAxes, ha="center", va="center", color=DIM)
            continue
        heights = view.importance[shown, i]
        axis.bar(range(n), heights, width=0.74, color=view.colours[shown], zorder=3)
        for x, height in enumerate(heights):
            axis.text(x, height + 0.03, f"{height:.2f}", ha="center", va="bottom", fontsize=8)
        axis.set_yticks([0, 1], [f"{text(values.min())} = 0", f"{text(values.max())} = 1"])
        axis.axhline(1.0, color=GRID, linewidth=0.8, zorder=1)
    ticks = [str(policy) for policy in shown]
    if view.arrived is not None:
        ticks = [f"{policy}\n{front.success[policy]:.0%}" for policy in shown]
    axes[-1].set_xticks(range(n), ticks, color=INK)
    axes[-1].set_xlim(n / 2 - max(n, 6) / 2 - 0.6, n / 2 + max(n, 6) / 2 - 0.4)
    axes[-1].set_xlabel("policy" + (", and share of its episodes that arrive" if view.arrived is not None else ""))
    return figure


def _reduction(view: FrontView) -> Figure:
    """The front in two dimensions, by principal components of the importance of its objectives."""
    front, shown = view.front, view.representatives()
    components = principal_components(np.nan_to_num(view.importance))
    notes = (
        f"principal components of the returns discounted with gamma {front.gamma:g}, "
        "each objective from 0, the front's worst, to 1, its best",
        _policies_note(view, shown),
    )
    figure = _make_figure(view, 10.4, 5.2, "the front in two dimensions", notes, _dot_legend(view))
    axis, compass = figure.subplots(1, 2, width_ratios=(2.6, 1.0))
    _draw_dots(axis, view, components.points, 44)
    if len(shown) < len(front):
        x, y = components.points[shown].T
        axis.scatter(x, y, s=80, facecolors="none", edgecolors=INK, linewidths=1.0, zorder=4)
    for k, (name, share) in enumerate(zip(("first", "second"), components.explained, strict=True)):
        text = f"{name} component" + (f" ({share:.0%} of the variance)" if share > 0.0 else " (no variance)")
        (axis.set_xlabel, axis.set_ylabel)[k](text)
        low, high = components.points[:, k].min(), components.points[:, k].max()
        pad = 0.1 * (high - low) if high - low > 1e-9 else 0.5
        (axis.set_xlim, axis.set_ylim)[k](low - pad, high + pad)
    _add_colour_bar(figure, view, axis)
    _loadings(compass, view, components.loadings)
    style: dict[str, Any] = {"fontsize": 8.5, "fontweight": "bold", "path_effects": [HALO], "zorder": 6}
    for k in shown:  # away from the middle, where most other dots are
        across, up = np.sign(components.points[k])
        place = {"ha": "left" if across >= 0 else "right", "va": "bottom" if up >= 0 else "top"}
        axis.annotate(str(k), components.points[k], (4 * across, 4 * up), textcoords="offset points", **place, **style)
    return figure


def _loadings(axis: Axes, view: FrontView, loadings: NDArray[np.float64]) -> None:
    """An arrow per objective: its weights in the two components."""
    angles = np.linspace(0.0, 2 * np.pi, 181)
    axis.plot(np.cos(angles), np.sin(angles), color=FAINT, linewidth=0.9, zorder=1)
    handles = []
    for i, (name, arrow) in enumerate(zip(view.front.objectives, loadings, strict=True)):
        colour, text = objective_colour(i), name_and_unit(name)[0]
        text += " (no variance)" if np.isnan(view.importance[:, i]).any() else ""
        if np.hypot(*arrow) > 0.01:
            style = {"arrowstyle": "-|>", "color": colour, "linewidth": 2.0, "shrinkA": 0, "shrinkB": 0}
            axis.annotate("", xy=(arrow[0], arrow[1]), xytext=(0.0, 0.0), arrowprops=style, zorder=3)
        handles.append(Line2D([], [], color=colour, linewidth=2.4, label=text))
    axis.set_title("Loadings of the components")
    axis.set_aspect("equal")
    axis.set(xlim=(-1.08, 1.08), ylim=(-1.08, 1.08), xlabel="first component", ylabel="second component")
    axis.yaxis.set_label_position("right")
    axis.set_xticks([-1, 0, 1])
    axis.set_yticks([-1, 0, 1])
    axis.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.24), frameon=False, fontsize=9)


def _parallel(view: FrontView) -> Figure:
    """Parallel coordinates: a line per policy across one axis per objective, in real units, the best at the top."""
    front, shown = view.front, view.representatives()
    d = len(front.objectives)
    handles = _arrival_legend(view, {"linewidth": 1.8}, {"linewidth": 1.8, "linestyle": "--"})
    notes = (
        _returns_note(view, discounted=True),
        "better is up",
        _policies_note(view, shown) + (", strong" if len(shown) < len(front) else ""),
    )
    figure = _make_figure(view, max(8.0, 2.3 * d + 1.5), 4.6, "policies across objectives", notes, handles)
    axis = figure.subplots()
    heights = np.where(np.isnan(view.importance), 0.5, view.importance)
    for policy in [*np.setdiff1d(np.arange(len(front)), shown), *shown]:
        strong = policy in shown
        axis.plot(
            range(d),
            heights[policy],
            "-" if view.arrived is None or view.arrived[policy] else "--",
            color=view.colours[policy],
            linewidth=2.1 if strong else 0.9,
            alpha=1.0 if strong else 0.45,
            zorder=3 if strong else 2,
        )
    style: dict[str, Any] = {"ha": "center", "fontsize": 9.5, "color": INK}
    for i, name in enumerate(front.objectives):
        values = front.discounted[:, i]
        text = number_formatter(values, name_and_unit(name)[1])
        axis.plot((i, i), (-0.02, 1.02), color=DIM, linewidth=1.3, zorder=4)
        axis.text(i, 1.12, label(name, "discounted"), va="bottom", fontweight="bold", **style)
        if np.isnan(view.importance[:, i]).any():
            axis.text(i, 1.045, ("always " if len(front) > 1 else "") + text(values[0]), va="bottom", **style)
        else:
            axis.text(i, 1.045, text(values.max()), va="bottom", **style)
            axis.text(i, -0.045, text(values.min()), va="top", **style)
    # The numbers are at the end where more lines differ.
    side, out = (0, -1) if len(set(heights[shown, 0])) >= len(set(heights[shown, -1])) else (d - 1, 1)
    ends = heights[shown, side]
    style = {"ha": "right" if out < 0 else "left", "va": "center_baseline", "fontsize": 8.5, "fontweight": "bold"}
    for policy, end, place in zip(shown, ends, separate(ends, 0.052, (0.0, 1.0)), strict=True):
        axis.plot((side, side + 0.07 * out), (end, place), color=DIM, linewidth=0.7, zorder=2)
        axis.text(side + 0.09 * out, place, str(policy), **style)
    axis.set(xlim=(-0.4, d - 0.6), ylim=(-0.12, 1.2))
    axis.set_axis_off()
    _add_colour_bar(figure, view, axis)
    return figure


def _scatter(view: FrontView, reference_front: NDArray[np.float64] | None) -> Figure:
    """Scatter plots of every pair of objectives, of the discounted returns that determine dominance."""
    front = view.front
    d = len(front.objectives)
    panel = {2: 5.2, 3: 3.4, 4: 2.7}.get(d, 2.3)  # inches
    handles = _dot_legend(view)
    if reference_front is not None:
        name = f"best-known front ({len(reference_front)} point{'' if len(reference_front) == 1 else 's'})"
        handles.append(Line2D([], [], color=FAINT, marker="D", linestyle="", markersize=5, label=name))
    notes = (
        f"returns discounted with gamma {front.gamma:g}, by which dominance is judged",
        f"{len(front)} polic{'y' if len(front) == 1 else 'ies'}",
        _colour_note(view),
    )
    width, height = max(panel * (d - 1) + 1.9, 6.6), 0.86 * panel * (d - 1) + 0.4
    figure = _make_figure(view, width, height, "pairs of objectives", notes, handles)
    axes: Any = figure.subplots(d - 1, d - 1, squeeze=False, sharex="col", sharey="row")
    for row, column in np.ndindex(d - 1, d - 1):
        axis, pair = axes[row, column], [column, row + 1]
        if column > row:
            axis.set_visible(False)
            continue
        if reference_front is not None:
            x, y = reference_front[:, pair].T
            axis.scatter(x, y, s=20, marker="D", c=FAINT, linewidths=0, zorder=2)
        _draw_dots(axis, view, front.discounted[:, pair], 34 if d < 4 else 22)
        axis.xaxis.set_major_locator(MaxNLocator(4))
        axis.yaxis.set_major_locator(MaxNLocator(4))
        axis.margins(0.08)
        if row == d - 2:
            axis.set_xlabel(label(front.objectives[pair[0]], "discounted"))
        if column == 0:
            axis.set_ylabel(label(front.objectives[pair[1]], "discounted"))
    _add_colour_bar(figure, view, list(axes.flat))
    return figure


def _bars(view: FrontView) -> Figure:
    """A panel per objective: the mean returns of a few policies with their intervals."""
    front, shown = view.front, view.representatives(BARS)
    n = len(shown)
    certain = bool((front.low[shown] == front.high[shown]).all())
    notes = (
        _returns_note(view),
        "" if certain else "lines: 95% bootstrap intervals",
        _policies_note(view, shown) + (f", by {view.leading_name}" if n > 1 else ""),
        _colour_note(view),
    )
    drawn = [i for i in range(len(front.objectives)) if not front.is_arrival_rate(i)]
    d = len(drawn)
    count = d + (view.arrived is not None)
    rows, columns = grid_shape(count)
    height = rows * (0.27 * max(n, 2) + 0.75)
    figure = _make_figure(view, max(3.2 * columns, 7.0), height, "policies in numbers", notes)
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for i, axis in enumerate(axes.flat):
        if i >= count:
            axis.set_visible(False)
            continue
        if i < d:
            k = drawn[i]
            mean = front.returns[shown, k]
            errors = np.maximum([mean - front.low[shown, k], front.high[shown, k] - mean], 0.0)
            texts = list(map(number_formatter(mean), mean))
            axis.set_title(label(front.objectives[k]))
        else:
            mean, errors = front.success[shown], np.zeros((2, n))
            texts = [f"{share:.0%}" for share in mean]
            axis.set_title(title_of(SUCCESS))
        axis.barh(range(n), mean, height=0.7, color=view.colours[shown], zorder=3)
        if errors.any():
            axis.errorbar(mean, range(n), xerr=errors, fmt="none", ecolor=INK, elinewidth=1.3, capsize=2.5, zorder=4)
        for y, text in enumerate(texts):
            axis.text(1.02, y, text, transform=axis.get_yaxis_transform(), va="center_baseline", fontsize=8.5)
        axis.axvline(0.0, color=DIM, linewidth=1.0, zorder=5)
        axis.grid(visible=False, axis="y")
        axis.tick_params(axis="y", length=0)
        axis.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))
        if i >= d:
            axis.set_xlim(0.0, 1.0)
            axis.xaxis.set_major_formatter(PercentFormatter(1.0))
        axis.set_yticks(range(n), [f"policy {policy}" for policy in shown], color=INK)
        axis.set_ylim(n - 0.4, -0.6)
    return figure


def _make_figure(
    view: FrontView, width: float, height: float, heading: str, notes: Sequence[str], handles: Sequence[Line2D] = ()
) -> Figure:
    """A figure with title, notes and legend around an empty space of ``width`` by ``height`` (in) for panels."""
    figure = Figure(figsize=(width, height))  # without pyplot, which may need a display
    FigureCanvasAgg(figure)
    title = f"{view.title}: {heading}" if view.title else heading.capitalize()
    surround(figure, title, ["; ".join(filter(None, notes))], handles)
    return figure


def _returns_note(view: FrontView, *, discounted: bool = False) -> str:
    """A note that says what the numbers are."""
    known = [OBJECTIVES[INDEX[name]].sign for name in map(without_vehicle, view.front.objectives) if name in INDEX]
    episodes = view.front.episodes
    kind = f"discounted (gamma {view.front.gamma:g})" if discounted else "undiscounted"
    mean = f"mean {kind} returns of {episodes} episode{'' if episodes == 1 else 's'} per policy"
    return mean + (", sums over decisions" if known else "") + (", costs negative" if -1 in known else "")


def _policies_note(view: FrontView, shown: NDArray[np.intp]) -> str:
    """A note that says which policies are numbered, and what the numbers are."""
    k = len(view.front)
    if k == 1:
        return "the only policy of the front"
    chosen = f"all {k} policies" if len(shown) == k else f"{len(shown)} of {k} policies, spread over the front,"
    return f"{chosen} with their numbers in front.csv"


def _add_colour_bar(figure: Figure, view: FrontView, axes: Axes | Sequence[Axes]) -> None:
    """Add a colour bar where colours have a meaning."""
    if view.coloured:
        bar = figure.colorbar(view.mappable, ax=axes, aspect=32, pad=0.02, fraction=0.05)
        bar.set_label(label(view.front.objectives[view.leading], "discounted"))
        bar.outline.set_visible(False)


def _colour_note(view: FrontView) -> str:
    """A note that says what colours mean; empty where they mean nothing."""
    return f"colour: discounted {view.leading_name}" if view.coloured else ""


def _draw_dots(axis: Axes, view: FrontView, points: NDArray[np.float64], size: float) -> None:
    """Draw a dot per policy at ``points`` (K, 2), filled unless the policy fails to arrive."""
    faces = view.colours.copy()
    if view.arrived is not None:
        faces[~view.arrived] = 1.0
    axis.scatter(
        points[:, 0], points[:, 1], s=size, c=faces, edgecolors=view.colours.tolist(), linewidths=1.2, zorder=3
    )


def _dot_legend(view: FrontView) -> list[Line2D]:
    """The legend of :func:`_draw_dots`."""
    dot = {"marker": "o", "linestyle": "", "markersize": 6}
    return _arrival_legend(view, {**dot, "markerfacecolor": INK}, {**dot, "markerfacecolor": "white"})


def _arrival_legend(view: FrontView, arrives: dict[str, Any], fails: dict[str, Any]) -> list[Line2D]:
    """A legend of the styles of policies that count as arriving, and of the others, as far as there are any."""
    if view.arrived is None:
        return []
    whole = bool(np.isin(view.front.success, (0.0, 1.0)).all())
    names = ("arrives", "does not arrive") if whole else ("arrives in half of the episodes or more", "in fewer")
    return [
        Line2D([], [], color=INK, label=name, **style)
        for name, style, there in zip(names, (arrives, fails), (True, False), strict=True)
        if there in view.arrived
    ]


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


class Projection(NamedTuple):
    """Points (K, 2), centred at 0, projected onto their first two principal components.

    ``loadings`` (d, 2) are the weights of the objectives in each component; a column has length 1, or 0 if the points
    do not vary in this direction. ``explained`` (2,) is the share of the variance along each component.
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


class FrontView:
    """A front as all its figures show it: the same policies, numbers and colours in each.

    Args:
        front: K policies with d >= 2 objectives; a policy's number is its index.
        title: what the front belongs to, such as the algorithm and the environment.

    Attributes:
        leading: index of the objective that orders and colours policies.
        importance: (K, d) :func:`importance` of the discounted returns, which determine the front: policies that
            differ in when they arrive alone have the same undiscounted ones.
    """

    def __init__(self, front: Front, title: str = ""):
        names = front.objectives
        if len(names) < 2:
            raise ValueError(f"the front has the objectives {list(names)}; figures of a front need at least two")
        self.front, self.title = front, title
        self.leading = names.index(LEADING) if LEADING in names else 0
        self.importance = importance(front.discounted)

    @property
    def leading_name(self) -> str:
        """Plain name of the leading objective."""
        return name_and_unit(self.front.objectives[self.leading])[0]

    @property
    def coloured(self) -> bool:
        """Whether colours mean anything: whether policies differ in the leading objective."""
        return bool(np.isfinite(self.importance[:, self.leading]).all())

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
