"""Figures of a front: what each policy favours, the front in two dimensions, and pairs of objectives.

All show the same policies in the same colours, with the same numbers. How policies compare across objectives, and how
they drive, is on the page beside them.
"""

from __future__ import annotations

from functools import partial
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
from matplotlib.ticker import MaxNLocator

from algorithms.reporting.style import COLOURS, DIM, FAINT, GRID, INK, figure_style, save_figure, surround
from mo_deepdrive.evaluation.metrics import label, name_and_unit, without_vehicle
from mo_deepdrive.evaluation.pareto import farthest_point_subset
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from numpy.typing import ArrayLike, NDArray

    from mo_deepdrive.evaluation.front import Front

REPRESENTATIVES = 16  # policies that are drawn individually at most; in larger fronts these represent all
MOST_PAIRED = 8  # objectives of which scatter.png shows all pairs
MOST_DRAWN = 20  # objectives that reduction.png has room for
LEADING = "distance"  # the objective that orders and colours policies; if there is none of this name, the first one
# Colours of policies: viridis, which is safe for colour-blind readers, without the yellow that is hard to see on white.
COLOUR_MAP = ListedColormap(colormaps["viridis"](np.linspace(0.0, 0.92, 256)), "policies")
HALO = withStroke(linewidth=2.0, foreground="white")
# The paper's names for low values of these costs (its figure 7).
PAPER_NAMES = {"g_force": "comfort", "jerk": "smoothness"}


def draw_front(
    front: Front, directory: str | Path, *, reference_front: NDArray[np.float64] | None = None, title: str = ""
) -> list[Path]:
    """Draw a front into ``directory``: importance, reduction and scatter, all ``.png``; returns the files.

    Of more than MOST_PAIRED objectives there is no scatter; of more than MOST_DRAWN, those of several vehicles, there
    is importance alone. A policy's number is its row in ``front.csv``. Returns are discounted, as they determine
    dominance, and so is ``reference_front`` (k, d), which is drawn behind the front.
    """
    view = FrontView(front, title)
    d = len(front.objectives)
    paths = []
    with figure_style({"text.parse_math": False}):
        for name, most, draw in (
            ("importance", d, _importance),
            ("reduction", MOST_DRAWN, _reduction),
            ("scatter", MOST_PAIRED, partial(_scatter, reference_front=reference_front)),
        ):
            if d <= most:
                paths.append(Path(directory) / f"{name}.png")
                save_figure(draw(view), paths[-1])
    return paths


def _importance(view: FrontView) -> Figure:
    """A row of bars per objective: where each policy is between the front's worst and its best."""
    front, shown = view.front, view.representatives()
    known = [OBJECTIVES[INDEX[name]].sign for name in map(without_vehicle, front.objectives) if name in INDEX]
    notes = (
        f"mean discounted (gamma {front.gamma:g}) returns of {front.episodes} episode"
        f"{'' if front.episodes == 1 else 's'} per policy{', sums over decisions' if known else ''}"
        f"{', costs negative' if -1 in known else ''}",
        view.policies_note(shown) + (f", by {view.leading_name}" if len(front) > 1 else ""),
        f"0 and 1: the worst and the best of the {len(front)}" if len(front) > 1 else "",
        view.colour_note,
    )
    d, n = len(front.objectives), len(shown)
    width = max(8.0, 1.4 + 0.56 * n)
    figure = view.figure((width, 1.02 * d + 0.5), "importance of the objectives", notes)
    axes = figure.subplots(d, 1, squeeze=False, sharex=True)[:, 0]
    for i, (axis, name) in enumerate(zip(axes, front.objectives, strict=True)):
        values = front.discounted[:, i]
        unit = name_and_unit(name)[1]
        worst, best = (f"{value:.4g} {unit}".strip() for value in (values.min(), values.max()))
        title = label(name, "discounted")
        axis.set_title(f"{PAPER_NAMES[name]}: {title}" if name in PAPER_NAMES else title)
        axis.set_ylim(0.0, 1.24)
        axis.grid(visible=False)
        axis.tick_params(axis="x", length=0)
        if np.isnan(view.importance[:, i]).any():
            axis.set_yticks([])
            same = best + (", the same for every policy" if len(front) > 1 else "")
            axis.text(0.5, 0.45, same, transform=axis.transAxes, ha="center", va="center", color=DIM)
            continue
        heights = view.importance[shown, i]
        axis.bar(range(n), heights, width=0.74, color=view.colours[shown], zorder=3)
        for x, height in enumerate(heights):
            axis.text(x, height + 0.03, f"{height:.2f}", ha="center", va="bottom", fontsize=8)
        axis.set_yticks([0, 1], [f"{worst} = 0", f"{best} = 1"])
        axis.axhline(1.0, color=GRID, linewidth=0.8, zorder=1)
    arrivals = view.arrived is not None
    ticks = [f"{policy}\n{front.success[policy]:.0%}" if arrivals else str(policy) for policy in shown]
    axes[-1].set_xticks(range(n), ticks, color=INK)
    axes[-1].set_xlim(n / 2 - max(n, 6) / 2 - 0.6, n / 2 + max(n, 6) / 2 - 0.4)
    axes[-1].set_xlabel("policy" + (", and share of its episodes that arrive" if arrivals else ""))
    return figure


def _reduction(view: FrontView) -> Figure:
    """The front in two dimensions, by principal components of the importance of its objectives."""
    front, shown = view.front, view.representatives()
    components = principal_components(np.nan_to_num(view.importance))
    notes = (
        f"principal components of the returns discounted with gamma {front.gamma:g}, "
        "each objective from 0, the front's worst, to 1, its best",
        view.policies_note(shown),
    )
    figure = view.figure((10.4, 5.2), "the front in two dimensions", notes, view.dot_legend())
    axis, compass = figure.subplots(1, 2, width_ratios=(2.6, 1.0))
    view.draw_dots(axis, components.points, 44)
    axis.margins(0.1)
    if len(shown) < len(front):
        x, y = components.points[shown].T
        axis.scatter(x, y, s=80, facecolors="none", edgecolors=INK, linewidths=1.0, zorder=4)
    shares = [f"({share:.0%} of the variance)" if share > 0.0 else "(no variance)" for share in components.explained]
    axis.set(xlabel=f"first component {shares[0]}", ylabel=f"second component {shares[1]}")
    view.add_colour_bar(figure, axis)
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
    colours = [COLOURS[i % len(COLOURS)] for i in range(len(loadings))]
    scaled: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1}
    axis.quiver(*np.zeros((2, len(loadings))), *loadings.T, color=colours, zorder=3, **scaled)
    same = [bool(np.isnan(column).any()) for column in view.importance.T]
    names = [name_and_unit(name)[0] + " (no variance)" * same[i] for i, name in enumerate(view.front.objectives)]
    handles = [Line2D([], [], color=c, linewidth=2.4, label=name) for c, name in zip(colours, names, strict=True)]
    ticks = [-1, 0, 1]
    axis.set(title="Loadings of the components", aspect="equal", xlabel="first component", ylabel="second component")
    axis.set(xlim=(-1.08, 1.08), ylim=(-1.08, 1.08), xticks=ticks, yticks=ticks)
    axis.yaxis.set_label_position("right")
    axis.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.24), frameon=False, fontsize=9)


def _scatter(view: FrontView, reference_front: NDArray[np.float64] | None) -> Figure:
    """Scatter plots of every pair of objectives, of the discounted returns that determine dominance."""
    front = view.front
    d = len(front.objectives)
    panel = {2: 5.2, 3: 3.4, 4: 2.7}.get(d, 2.3)  # inches
    handles = view.dot_legend()
    if reference_front is not None:
        name = f"best-known front ({len(reference_front)} point{'' if len(reference_front) == 1 else 's'})"
        handles.append(Line2D([], [], color=FAINT, marker="D", linestyle="", markersize=5, label=name))
    notes = (
        f"returns discounted with gamma {front.gamma:g}, by which dominance is judged",
        f"{len(front)} polic{'y' if len(front) == 1 else 'ies'}",
        view.colour_note,
    )
    width, height = max(panel * (d - 1) + 1.9, 6.6), 0.86 * panel * (d - 1) + 0.4
    figure = view.figure((width, height), "pairs of objectives", notes, handles)
    axes: Any = figure.subplots(d - 1, d - 1, squeeze=False, sharex="col", sharey="row")
    for row, column in np.ndindex(d - 1, d - 1):
        axis, pair = axes[row, column], [column, row + 1]
        if column > row:
            axis.set_visible(False)
            continue
        if reference_front is not None:
            x, y = reference_front[:, pair].T
            axis.scatter(x, y, s=20, marker="D", c=FAINT, linewidths=0, zorder=2)
        view.draw_dots(axis, front.discounted[:, pair], 34 if d < 4 else 22)
        axis.xaxis.set_major_locator(MaxNLocator(4))
        axis.yaxis.set_major_locator(MaxNLocator(4))
        axis.margins(0.08)
        if row == d - 2:
            axis.set_xlabel(label(front.objectives[pair[0]], "discounted"))
        if column == 0:
            axis.set_ylabel(label(front.objectives[pair[1]], "discounted"))
    view.add_colour_bar(figure, list(axes.flat))
    return figure


def importance(returns: ArrayLike) -> NDArray[np.float64]:
    """``returns`` (K, d) scaled per objective from 0, the worst of the K, to 1, the best; NaN where all are equal."""
    values = np.asarray(returns, dtype=np.float64)
    low, extent = values.min(axis=0), np.ptp(values, axis=0)
    differ = extent > 1e-9 * np.abs(values).max(axis=0)  # by more than rounding errors
    scaled: NDArray[np.float64] = np.where(differ, (values - low) / np.where(differ, extent, 1.0), np.nan)
    return scaled


class Projection(NamedTuple):
    """Points projected onto their first two principal components."""

    points: NDArray[np.float64]  # (K, 2), centred at 0
    # (d, 2) weights of the objectives; a column has length 1, or 0 if the points do not vary in this direction.
    loadings: NDArray[np.float64]
    explained: NDArray[np.float64]  # (2,) share of the variance along each component


def principal_components(values: ArrayLike) -> Projection:
    """The first two principal components of ``values`` (K, d); the largest loading of each is positive."""
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
    """A front as all its figures show it: the same policies, numbers and colours in each."""

    def __init__(self, front: Front, title: str = ""):
        names = front.objectives
        if len(names) < 2:
            raise ValueError(f"the front has the objectives {list(names)}; figures of a front need at least two")
        self.front, self.title = front, title
        self.leading = names.index(LEADING) if LEADING in names else 0  # it orders and colours policies
        self.leading_name = name_and_unit(names[self.leading])[0]
        # (K, d); policies that differ in when they arrive alone have the same undiscounted returns.
        self.importance = importance(front.discounted)
        # Colours mean nothing where policies do not differ in the leading objective.
        self.coloured = bool(np.isfinite(self.importance[:, self.leading]).all())
        self.colour_note = f"colour: discounted {self.leading_name}" if self.coloured else ""
        values = front.discounted[:, self.leading]
        self.mappable = ScalarMappable(Normalize(float(values.min()), float(values.max())), COLOUR_MAP)
        self.colours = np.asarray(self.mappable.to_rgba(values))  # (K, 4) RGBA
        # (K,) whether a policy arrives in at least half of its episodes; None unless that is known for all.
        self.arrived = front.success >= 0.5 if np.isfinite(front.success).all() else None

    def policies_note(self, shown: NDArray[np.intp]) -> str:
        """Which policies are numbered, and what the numbers are."""
        k = len(self.front)
        if k == 1:
            return "the only policy of the front"
        chosen = f"all {k} policies" if len(shown) == k else f"{len(shown)} of {k} policies, spread over the front,"
        return f"{chosen} with their numbers in front.csv"

    def dot_legend(self) -> list[Line2D]:
        """What filled and empty dots of :meth:`draw_dots` mean, as far as there are any."""
        if self.arrived is None:
            return []
        whole = bool(np.isin(self.front.success, (0.0, 1.0)).all())
        names = ("arrives", "does not arrive") if whole else ("arrives in half of the episodes or more", "in fewer")
        style: dict[str, Any] = {"color": INK, "marker": "o", "linestyle": "", "markersize": 6}
        return [
            Line2D([], [], label=name, markerfacecolor=colour, **style)
            for name, colour, there in zip(names, (INK, "white"), (True, False), strict=True)
            if there in self.arrived
        ]

    def draw_dots(self, axis: Axes, points: NDArray[np.float64], size: float) -> None:
        """Draw a dot per policy at ``points`` (K, 2), filled unless the policy fails to arrive."""
        faces = self.colours.copy()
        if self.arrived is not None:
            faces[~self.arrived] = 1.0
        x, y = points.T
        axis.scatter(x, y, s=size, c=faces, edgecolors=self.colours.tolist(), linewidths=1.2, zorder=3)

    def figure(
        self, size: tuple[float, float], heading: str, notes: Sequence[str], handles: Sequence[Line2D] = ()
    ) -> Figure:
        """A figure with title, notes and legend around an empty space of a ``size`` (in) for panels."""
        figure = Figure(figsize=size)  # without pyplot, which may need a display
        FigureCanvasAgg(figure)
        title = f"{self.title}: {heading}" if self.title else heading.capitalize()
        surround(figure, title, ["; ".join(filter(None, notes))], handles)
        return figure

    def add_colour_bar(self, figure: Figure, axes: Axes | Sequence[Axes]) -> None:
        """Add a colour bar where colours have a meaning."""
        if self.coloured:
            bar = figure.colorbar(self.mappable, ax=axes, aspect=32, pad=0.02, fraction=0.05)
            bar.set_label(label(self.front.objectives[self.leading], "discounted"))
            bar.outline.set_visible(False)

    def representatives(self, count: int = REPRESENTATIVES) -> NDArray[np.intp]:
        """Up to ``count`` policies that cover the front, ordered by the leading objective; more include fewer."""
        chosen = farthest_point_subset(np.nan_to_num(self.importance), count)
        order = np.lexsort((chosen, self.front.discounted[chosen, self.leading]))
        return np.asarray(chosen[order])
