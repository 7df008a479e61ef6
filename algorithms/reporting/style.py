"""How figures look: colours, fonts, sizes and resolution, in one place."""

from __future__ import annotations

import zlib
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

# The colours of Okabe and Ito, which are safe for colour-blind readers.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F7F7F", "#000000")
# The colour of each algorithm in every figure; tables and legends have the same order.
ALGORITHM_COLOURS = {
    "a2c": "#D55E00",
    "mo_a2c": "#0072B2",
    "ppo": "#E69F00",
    "mo_ppo": "#56B4E9",
    "mocac": "#7F7F7F",
    "mappo": "#EE3377",
    "pcn": "#009E73",
    "conditioned_mo_ppo": "#332288",
}
# Of all other algorithms, chosen by their names; from the muted scheme of Paul Tol.
OTHER_COLOURS = ("#CC79A7", "#882255", "#999933", "#44AA99", "#000000", "#661100", "#AA4499")
TRAINING_COLOUR = "#9AA3AD"
MARKERS = ("", "o", "s", "^", "D", "v", "P", "X")  # of several curves of one algorithm
INK, DIM, FAINT = "#23282F", "#5B6470", "#B4BBC4"  # of text, of notes and axes, of what is in the background
LABEL, GRID = "#3C434C", "#E4E7EB"
# Captions of videos, which look like the panel of readings beside a map.
VIDEO_BACKGROUND, VIDEO_INK = "#181C24", "#F0F3F8"

MAX_POINTS = 150  # per curve; longer curves are averaged
MINIMUM_SPAN = 0.1  # of an axis, as a share of the quantity's magnitude: smaller differences would look large
DPI = 160  # of figures
LARGE_DPI = 100  # of figures with hundreds of cells
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
    """A sort key: the algorithms of ALGORITHM_COLOURS in its order, then the others by name."""
    known = list(ALGORITHM_COLOURS)
    return (known.index(name) if name in known else len(known), name)


def algorithm_colours(names: Iterable[str]) -> dict[str, str]:
    """The colour of each algorithm of a figure.

    Algorithms that are not in ALGORITHM_COLOURS have one of OTHER_COLOURS that depends on the name alone, unless
    another algorithm of the figure has taken it.
    """
    found: dict[str, str] = {}
    for name in sorted(set(names), key=algorithm_order):
        start = zlib.crc32(name.encode()) % len(OTHER_COLOURS)
        wanted = [*OTHER_COLOURS[start:], *OTHER_COLOURS[:start]]
        free = [colour for colour in wanted if colour not in found.values()]
        found[name] = ALGORITHM_COLOURS.get(name) or (free or wanted)[0]
    return found


def curve_styles(algorithms: Sequence[str]) -> list[tuple[str, str]]:
    """The colour and the marker of one curve per entry of ``algorithms``.

    The first curve of an algorithm has its colour; further ones have lighter shades of it and other markers.
    """
    from matplotlib.colors import to_hex, to_rgb  # tables, which need the order of algorithms alone, go without

    colours = algorithm_colours(algorithms)
    styles = []
    for i, name in enumerate(algorithms):
        before, count = algorithms[:i].count(name), algorithms.count(name)
        share = 0.6 * before / max(count - 1, 1)
        red, green, blue = ((1.0 - share) * part + share for part in to_rgb(colours[name]))
        styles.append((to_hex((red, green, blue)), MARKERS[before % len(MARKERS)]))
    return styles


def widened(low: float, high: float, scale: float) -> tuple[float, float]:
    """Limits of an axis around ``low`` and ``high`` that span at least MINIMUM_SPAN of ``scale``.

    Args:
        low: the least value that is drawn.
        high: the greatest one.
        scale: magnitude of the quantity, such as the largest value or the nominal scale of a return.
    """
    missing = max(MINIMUM_SPAN * scale - (high - low), 0.0)
    return low - missing / 2, high + missing / 2


def text_width(text: str) -> float:
    """The approximate width of ``text`` in inches, at the usual font size."""
    return 0.078 * len(text)


def surround(figure: Figure, heading: str, notes: Sequence[str], handles: Sequence[Line2D]) -> None:
    """Put title and notes above the panels and the legend below; additional lines make the figure taller.

    Args:
        figure: with its panels.
        heading: the title, one line.
        notes: lines below it, which are wrapped at the width of the figure.
        handles: of the legend.
    """
    notes = [line for note in notes for line in wrap(note, int(figure.get_figwidth() / text_width(" ")))]
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
