"""How figures look: colours, fonts, sizes and resolution, in one place."""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.colors import ListedColormap

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

# Colours of objectives and the like: those of Okabe and Ito, which are safe for colour-blind readers.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F7F7F", "#000000")
# The colour of each algorithm in every figure, and the order of algorithms in every legend and table.
ALGORITHM_COLOURS = {
    "a2c": "#D55E00",
    "mo_a2c": "#0072B2",
    "ppo": "#E69F00",
    "mo_ppo": "#56B4E9",
    "pcn": "#009E73",
}
# Colours of other algorithms, such as peers, and of further groups of runs of one algorithm.
OTHER_COLOURS = ("#CC79A7", "#332288", "#999933", "#882255", "#7F7F7F", "#000000", "#A6761D")
TRAINING = "#9AA3AD"  # of the training curve of a single group of runs
# Colours of the policies of a front: viridis, also safe for colour-blind readers, without the yellow that is hard to
# see on white.
COLOUR_MAP = ListedColormap(matplotlib.colormaps["viridis"](np.linspace(0.0, 0.92, 256)), "policies")
INK, DIM, FAINT = "#23282F", "#5B6470", "#B4BBC4"  # of text, of notes and axes, of what is in the background
LABEL, GRID = "#3C434C", "#E4E7EB"
# Captions of videos, which look like the panel of readings beside a map.
VIDEO_BACKGROUND, VIDEO_INK = "#181C24", "#F0F3F8"

# The smallest span of an axis, relative to the largest magnitude on it: less would zoom into noise.
MIN_SPAN = 0.1

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


def algorithm_order(name: str) -> tuple[int, str]:
    """The sort key of an algorithm in legends and tables: ours as in ALGORITHM_COLOURS, then others by their names."""
    known = list(ALGORITHM_COLOURS)
    return (known.index(name) if name in known else len(known), name)


def algorithm_colour(name: str) -> str:
    """The colour of an algorithm, the same in every figure; one that is not ours gets it by a checksum of its name."""
    return ALGORITHM_COLOURS.get(name) or OTHER_COLOURS[zlib.crc32(name.encode()) % len(OTHER_COLOURS)]


def group_colours(algorithms: Sequence[str]) -> list[str]:
    """A colour per group of runs in a figure, all different while there are enough.

    The first group of an algorithm has the algorithm's colour. Its further groups, and algorithms whose colour is
    taken, get free ones, first those that are not the colour of another algorithm.

    Args:
        algorithms: the algorithm of each group.
    """
    found: dict[int, str] = {}
    for name in sorted(set(algorithms), key=algorithm_order):
        if algorithm_colour(name) not in found.values():
            found[algorithms.index(name)] = algorithm_colour(name)
    palette = (*OTHER_COLOURS, *ALGORITHM_COLOURS.values())
    free = [colour for colour in palette if colour not in found.values()] or list(palette)
    rest = [group for group in range(len(algorithms)) if group not in found]
    found |= {group: free[k % len(free)] for k, group in enumerate(rest)}
    return [found[group] for group in range(len(algorithms))]


def limits_of_min_span(low: float, high: float, scale: float = 0.0) -> tuple[float, float]:
    """Limits of an axis around ``low`` to ``high`` whose span is at least MIN_SPAN of the largest magnitude.

    Args:
        low: lower limit.
        high: upper limit.
        scale: magnitude that the values usually have, which counts if it is larger than those drawn.
    """
    missing = MIN_SPAN * max(abs(low), abs(high), scale) - (high - low)
    return (low - missing / 2, high + missing / 2) if missing > 0.0 else (low, high)


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
