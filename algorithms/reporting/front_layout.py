"""What the figures of a front share around and in their panels: titles, notes, legends, colours and numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from algorithms.reporting.front_view import FrontView, place_labels
from algorithms.reporting.style import DIM, INK, surround
from mo_deepdrive.evaluation.metrics import label, without_vehicle
from mo_deepdrive.objectives import INDEX, OBJECTIVES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

HALO = withStroke(linewidth=2.0, foreground="white")


def make_figure(
    view: FrontView, width: float, height: float, heading: str, notes: Sequence[str], handles: Sequence[Line2D] = ()
) -> Figure:
    """A figure with title, notes and legend around an empty space for panels.

    Args:
        view: its title comes before ``heading``.
        width: of the figure (in).
        height: of the space for panels (in).
        heading: what the figure shows.
        notes: sentences below the title; empty ones are left out.
        handles: of the legend.
    """
    figure = Figure(figsize=(width, height))  # without pyplot, which may need a display
    FigureCanvasAgg(figure)
    title = f"{view.title}: {heading}" if view.title else heading.capitalize()
    surround(figure, title, ["; ".join(filter(None, notes))], handles)
    return figure


def returns_note(view: FrontView, *, discounted: bool = False) -> str:
    """A note that says what the numbers are."""
    known = [OBJECTIVES[INDEX[name]].sign for name in map(without_vehicle, view.front.objectives) if name in INDEX]
    episodes = view.front.episodes
    kind = f"discounted (gamma {view.front.gamma:g})" if discounted else "undiscounted"
    mean = f"mean {kind} returns of {episodes} episode{'' if episodes == 1 else 's'} per policy"
    return mean + (", sums over decisions" if known else "") + (", costs negative" if -1 in known else "")


def policies_note(view: FrontView, shown: NDArray[np.intp]) -> str:
    """A note that says which policies are numbered, and what the numbers are."""
    k = len(view.front)
    if k == 1:
        return "the only policy of the front"
    chosen = f"all {k} policies" if len(shown) == k else f"{len(shown)} of {k} policies, spread over the front,"
    return f"{chosen} with their numbers in front.csv"


def add_colour_bar(figure: Figure, view: FrontView, axes: Axes | Sequence[Axes]) -> None:
    """Add a colour bar where colours have a meaning."""
    if np.isfinite(view.importance[:, view.leading]).all():
        bar = figure.colorbar(view.mappable, ax=axes, aspect=32, pad=0.02, fraction=0.05)
        bar.set_label(label(view.front.objectives[view.leading], "discounted"))
        bar.outline.set_visible(False)


def colour_note(view: FrontView) -> str:
    """A note that says what colours mean; empty where they mean nothing."""
    return f"colour: discounted {view.leading_name}" if np.isfinite(view.importance[:, view.leading]).all() else ""


def arrival_names(view: FrontView) -> tuple[str, str]:
    """Names of the policies that count as arriving, and of the others."""
    whole = bool(np.isin(view.front.success, (0.0, 1.0)).all())
    return ("arrives", "does not arrive") if whole else ("arrives in half of the episodes or more", "in fewer")


def draw_dots(axis: Axes, view: FrontView, points: NDArray[np.float64], size: float) -> None:
    """Draw a dot per policy at ``points`` (K, 2), filled unless the policy fails to arrive."""
    faces = view.colours.copy()
    if view.arrived is not None:
        faces[~view.arrived] = 1.0
    axis.scatter(
        points[:, 0], points[:, 1], s=size, c=faces, edgecolors=view.colours.tolist(), linewidths=1.2, zorder=3
    )


def dot_legend(view: FrontView) -> list[Line2D]:
    """The legend of :func:`draw_dots`."""
    if view.arrived is None:
        return []
    return [
        Line2D([], [], color=INK, marker="o", linestyle="", markersize=6, markerfacecolor=face, label=name)
        for name, face, there in zip(arrival_names(view), (INK, "white"), (True, False), strict=True)
        if there in view.arrived
    ]


def draw_numbers(figure: Figure, axis: Axes, points: NDArray[np.float64], shown: NDArray[np.intp]) -> None:
    """Write the numbers of the policies ``shown`` next to their ``points`` (K, 2); call it when the layout is fixed."""
    to_points = 72.0 / figure.dpi
    places = axis.transData.transform(points) * to_points
    texts = [str(policy) for policy in shown]
    sizes = np.array([(5.6 * len(text) + 1.0, 9.0) for text in texts])
    box = axis.get_window_extent()
    area = (box.x0 * to_points, box.y0 * to_points, box.x1 * to_points, box.y1 * to_points)
    centres = place_labels(places[shown], sizes, places, area)
    to_data = axis.transData.inverted()
    for policy, text, size, centre in zip(shown, texts, sizes, centres, strict=True):
        x, y = to_data.transform(centre / to_points)
        axis.text(x, y, text, ha="center", va="center", fontsize=8.5, fontweight="bold", zorder=6, path_effects=[HALO])
        gaps = np.abs(centre - places[policy]) - size / 2
        if gaps.max() > 10.0:  # too far away without a connecting line
            axis.plot((points[policy, 0], x), (points[policy, 1], y), color=DIM, linewidth=0.7, zorder=2)
