"""How figures look: colours, fonts, sizes and resolution, in one place."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.colors import ListedColormap

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

# Colours of curves, one per group of runs: those of Okabe and Ito, which are safe for colour-blind readers.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F7F7F", "#000000")
# Colours of the curves of a single group: training, then its evaluations.
SINGLE_GROUP_COLOURS = ("#9AA3AD", COLOURS[0], COLOURS[1], COLOURS[0])
# Colours of the policies of a front: viridis, also safe for colour-blind readers, without the yellow that is hard to
# see on white.
COLOUR_MAP = ListedColormap(matplotlib.colormaps["viridis"](np.linspace(0.0, 0.92, 256)), "policies")
INK, DIM, FAINT = "#23282F", "#5B6470", "#B4BBC4"  # of text, of notes and axes, of what is in the background
LABEL, GRID = "#3C434C", "#E4E7EB"
# Captions of videos, which look like the panel of readings beside a map.
VIDEO_BACKGROUND, VIDEO_INK = "#181C24", "#F0F3F8"

DPI = 160  # of figures
VIDEO_DPI = 100  # of captions of videos
LINE = 0.19  # in, height of a line of text
TITLE_SIZE, NOTE_SIZE = 13, 9.5  # points

STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": NOTE_SIZE,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": DIM,
    "axes.labelcolor": LABEL,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.color": DIM,
    "ytick.color": DIM,
    "text.color": INK,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}


def curve_colour(group: int, groups: int, kind: int) -> str:
    """The colour of a learning curve.

    Args:
        group: index of the group of runs.
        groups: how many groups the figure shows.
        kind: index of the kind of curve: training, greedy, stochastic, front.
    """
    return COLOURS[group % len(COLOURS)] if groups > 1 else SINGLE_GROUP_COLOURS[kind]


def text_width(text: str) -> float:
    """The approximate width of ``text`` in inches, at the usual font size."""
    return 0.078 * len(text)


def surround(figure: Figure, heading: str, notes: Sequence[str], handles: Sequence[Line2D]) -> None:
    """Put title and notes above the panels and the legend below; additional lines make the figure taller.

    Args:
        figure: with its panels.
        heading: the title, one line.
        notes: lines below it.
        handles: of the legend.
    """
    widths = np.array([text_width(str(handle.get_label())) + 0.62 for handle in handles])
    columns = len(handles)
    while columns > 1 and sum(part.max() for part in np.array_split(widths, columns)) > figure.get_figwidth():
        columns -= 1
    lines = -(-len(handles) // columns)
    height = figure.get_figheight() + LINE * (lines - 1 + len(notes) - 1)
    figure.set_figheight(height)
    figure.text(0.012, 1 - 0.12 / height, heading, fontsize=TITLE_SIZE, fontweight="bold", va="top")
    figure.text(0.012, 1 - 0.40 / height, "\n".join(notes), fontsize=NOTE_SIZE, color=DIM, va="top")
    figure.legend(handles=handles, loc="lower left", bbox_to_anchor=(0.006, 0.0), ncols=columns, frameon=False)
    above, below = 0.62 + LINE * (len(notes) - 1), 0.34 + LINE * (lines - 1)
    figure.tight_layout(rect=(0, below / height, 1, 1 - above / height), h_pad=1.4, w_pad=1.6)
