"""How figures look: colours, fonts, sizes and resolution, in one place."""

from __future__ import annotations

import textwrap
import zlib
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mo_deepdrive.support.atomic_io import atomic_write

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from contextlib import AbstractContextManager

    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

# Of objectives, in their order, and of policies in the explorer; by Okabe and Ito, safe for colour-blind readers.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F7F7F", "#000000")
# Tables and legends have the algorithms in this order.
ALGORITHM_COLOURS = {
    "a2c": "#D55E00",
    "mo_a2c": "#0072B2",
    "ppo": "#E69F00",
    "mo_ppo": "#56B4E9",
    "rulebook_ppo": "#DDAA33",
    "mocac": "#7F7F7F",
    "mappo": "#EE3377",
    "pcn": "#009E73",
    "conditioned_mo_ppo": "#332288",
}
# Of other algorithms, chosen by their names; from the muted scheme of Paul Tol.
OTHER_COLOURS = ("#CC79A7", "#882255", "#999933", "#44AA99", "#000000", "#661100", "#AA4499")
TRAINING_COLOUR = "#9AA3AD"
MARKERS = ("", "o", "s", "^", "D", "v", "P", "X")  # of several curves of one algorithm
INK, DIM, FAINT = "#23282F", "#5B6470", "#B4BBC4"  # of text, of notes and axes, of what is in the background
LABEL, GRID = "#3C434C", "#E4E7EB"

MAX_POINTS = 150  # per curve; longer curves are averaged
MINIMUM_SPAN = 0.1  # of an axis, as a share of the quantity's magnitude: smaller differences would look large
DPI = 160  # of figures
LARGE_DPI = 100  # of figures with hundreds of cells
TITLE_SIZE, NOTE_SIZE = 13, 9.5  # points
TITLE_LETTERS, NOTE_LETTERS = 8.0, 13.5  # that fit into an inch
HANDLE_LETTERS = 6  # the space that a handle of a legend takes, beside its label

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


def figure_style(changes: Mapping[Any, Any] = {}) -> AbstractContextManager[None]:
    """A context in which figures look like ours, but for some changes, whatever a user's matplotlibrc says."""
    from matplotlib import style  # not at the top: tables, which need the order of algorithms, go without Matplotlib

    return style.context({**STYLE, **changes}, after_reset=True)


def save_figure(figure: Figure, path: str | Path, dpi: int = DPI) -> None:
    """Write a figure, in the format that the suffix of the file names (PNG without one)."""
    buffer = BytesIO()
    figure.savefig(buffer, format=Path(path).suffix[1:] or "png", dpi=dpi)
    atomic_write(path, buffer.getvalue())


def algorithm_order(name: str) -> tuple[int, str]:
    """A sort key: the algorithms of ALGORITHM_COLOURS in its order, then the others by name."""
    known = list(ALGORITHM_COLOURS)
    return (known.index(name) if name in known else len(known), name)


def algorithm_label(name: str) -> str:
    """An algorithm as people write it: "MO-PPO", "PCN (morl_baselines)"; a name that is not known as it is."""
    library, _, algorithm = name.rpartition(".")
    if algorithm not in ALGORITHM_COLOURS:
        return name
    label = algorithm.upper().replace("_", "-").replace("CONDITIONED-", "conditioned ")
    return f"{label} ({library})" if library else label


def algorithm_colours(names: Iterable[str]) -> dict[str, str]:
    """The colour of each algorithm of a figure.

    Algorithms that are not in ALGORITHM_COLOURS have one of OTHER_COLOURS that depends on the name alone, unless
    another algorithm of the figure has taken it.
    """
    colours: dict[str, str] = {}
    for name in sorted(set(names), key=algorithm_order):
        start = zlib.crc32(name.encode()) % len(OTHER_COLOURS)
        wanted = [*OTHER_COLOURS[start:], *OTHER_COLOURS[:start]]
        free = [colour for colour in wanted if colour not in colours.values()]
        colours[name] = ALGORITHM_COLOURS.get(name) or (free or wanted)[0]
    return colours


def curve_styles(algorithms: Sequence[str]) -> list[tuple[str, str]]:
    """Colour and marker of a curve per entry: further ones of an algorithm have lighter shades and other markers."""
    from matplotlib.colors import to_hex, to_rgb  # as in figure_style

    colours = algorithm_colours(algorithms)
    styles = []
    for i, name in enumerate(algorithms):
        before, count = algorithms[:i].count(name), algorithms.count(name)
        share = 0.6 * before / max(count - 1, 1)
        red, green, blue = ((1.0 - share) * part + share for part in to_rgb(colours[name]))
        styles.append((to_hex((red, green, blue)), MARKERS[before % len(MARKERS)]))
    return styles


def widened(low: float, high: float, scale: float) -> tuple[float, float]:
    """Limits of an axis around values that span at least MINIMUM_SPAN of ``scale``, the magnitude of the quantity."""
    missing = max(MINIMUM_SPAN * scale - (high - low), 0.0)
    return low - missing / 2, high + missing / 2


def grid_shape(count: int) -> tuple[int, int]:
    """Rows and columns of ``count`` panels: at most four side by side, three where that fills the rows."""
    columns = min(count, 3 if count in (3, 5, 6, 9) else 4)
    return -(-count // columns), columns


def surround(figure: Figure, heading: str, notes: Sequence[str] = (), handles: Sequence[Line2D] = ()) -> None:
    """Put title and notes above the panels and the legend below them, by which the figure grows.

    The figure has the size of its panels; its layout becomes a constrained one. Empty notes are left out.
    """
    from matplotlib.text import Annotation  # not at the top: tables need no matplotlib

    figure.set_layout_engine("constrained", h_pad=0.06, w_pad=0.06, hspace=0.04, wspace=0.02)
    width = figure.get_figwidth()
    titles = textwrap.wrap(heading, int(TITLE_LETTERS * width))
    lines = [line for note in filter(None, notes) for line in textwrap.wrap(note, int(NOTE_LETTERS * width))]
    # The notes are below the title, which makes room for them.
    text = "\n".join([*titles, *[""] * len(lines)])
    title = figure.suptitle(text, x=0.01, ha="left", fontsize=TITLE_SIZE, fontweight="bold")
    small: dict[str, Any] = {"fontsize": NOTE_SIZE, "color": DIM, "va": "bottom", "annotation_clip": False}
    figure.add_artist(Annotation("\n".join(lines), (0.0, 0.0), xycoords=title, **small))
    added = title.get_window_extent().height / figure.dpi
    if handles:
        longest = max(len(str(handle.get_label())) for handle in handles) + HANDLE_LETTERS
        columns = min(len(handles), max(1, int(NOTE_LETTERS * width / longest)))
        legend = figure.legend(handles=handles, loc="outside lower left", ncols=columns, frameon=False)
        added += legend.get_window_extent().height / figure.dpi
    figure.set_figheight(figure.get_figheight() + added)
