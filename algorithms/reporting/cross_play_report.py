"""Tables and a picture of cross-play: a row per driver of vehicle 0, a column per driver of the others."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from algorithms.reporting.style import LARGE_DPI, figure_style, save_figure
from mo_deepdrive.evaluation.cross_play import OTHERS
from mo_deepdrive.evaluation.metrics import COLLISION, SUCCESS, UTILITY_ESR, end_by
from mo_deepdrive.support.atomic_io import atomic_write, csv_bytes

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.cross_play import Encounter

CELL = 0.3  # in, side of a cell of the picture
MOST_WITH_NUMBERS = 40  # drivers of a role, above which the cells have no numbers
COLLISIONS = end_by(COLLISION)


def drivers_of(encounters: Sequence[Encounter], role: int) -> list[str]:
    """The drivers of vehicle 0 (role 0) or of the others (1), in the order of the encounters."""
    return list(dict.fromkeys(encounter.drivers[role] for encounter in encounters))


def matrix(encounters: Sequence[Encounter], score: str) -> NDArray[np.float64]:
    """(K, L) values of a score, of K drivers of vehicle 0 with L drivers of the others."""
    rows, columns = drivers_of(encounters, 0), drivers_of(encounters, 1)
    values = np.full((len(rows), len(columns)), np.nan)
    for encounter in encounters:
        first, second = encounter.drivers
        values[rows.index(first), columns.index(second)] = encounter.estimates[score].value
    return values


def write_encounters(path: Path, encounters: Sequence[Encounter]) -> None:
    """Write a CSV with a row per encounter: each score and the ends of its interval."""
    names = list(encounters[0].estimates)
    rows = [[*encounters[0].roles, *(name + end for name in names for end in ("", "/low", "/high"))]]
    for encounter in encounters:
        numbers = [
            number
            for estimate in encounter.estimates.values()
            for number in (estimate.value, estimate.low, estimate.high)
        ]
        rows.append([*encounter.drivers, *("" if number is None else f"{number:.5g}" for number in numbers)])
    atomic_write(path, csv_bytes(rows))


def summary_rows(encounters: Sequence[Encounter], role: int) -> list[list[str]]:
    """A table as text, header first: each driver of a role over the drivers of the other one that it met.

    Its arrivals, collisions and utility are means over these drivers; the last two columns are of the one with which it
    arrives least.
    """
    name_of_role = encounters[0].roles[role]
    arrivals, utility = f"{name_of_role}/{SUCCESS}", f"{name_of_role}/{UTILITY_ESR}"
    rows = [[name_of_role, "met", "arrives (%)", "collisions (%)", "utility", "least with", "arrives (%)"]]
    for name in drivers_of(encounters, role):
        met = [encounter for encounter in encounters if encounter.drivers[role] == name]
        means = {
            score: float(np.mean([encounter.estimates[score].value for encounter in met]))
            for score in (arrivals, COLLISIONS, utility)
        }
        worst = min(met, key=lambda encounter: encounter.estimates[arrivals].value)
        percentages = [f"{100 * means[score]:.1f}" for score in (arrivals, COLLISIONS)]
        least = [worst.drivers[1 - role], f"{100 * worst.estimates[arrivals].value:.1f}"]
        rows.append([name, str(len(met)), *percentages, f"{means[utility]:.2f}", *least])
    return rows


def matrix_rows(encounters: Sequence[Encounter], score: str) -> list[list[str]]:
    """A score as a table as text, header first: a row per driver of vehicle 0, a column per driver of the others."""
    rows = [[score, *(f"among {name}" for name in drivers_of(encounters, 1))]]
    for name, values in zip(drivers_of(encounters, 0), matrix(encounters, score), strict=True):
        rows.append([name, *(f"{value:.4g}" for value in values)])
    return rows


def plot_encounters(path: Path, encounters: Sequence[Encounter], note: str) -> None:
    """Draw the matrices of joint arrivals, collisions and utilities; the note says what was evaluated."""
    rows, columns, roles = drivers_of(encounters, 0), drivers_of(encounters, 1), encounters[0].roles
    names = ["the others" if role == OTHERS else role.replace("_", " ") for role in roles]
    panels = [  # score, title, colour map, and whether the cells are percentages
        (SUCCESS, f"{'all' if OTHERS in roles else 'both'} arrive (%)", "Blues", True),
        (COLLISIONS, "collisions (%)", "OrRd", True),
        *(
            (f"{role}/{UTILITY_ESR}", f"utility of {name}", "Purples", False)
            for role, name in zip(roles, names, strict=True)
        ),
    ]
    longest = max(map(len, [*rows, *columns]))
    width = 2 * (CELL * len(columns) + 0.085 * longest + 1.1)
    height = 2 * (CELL * len(rows) + 0.085 * longest + 0.7) + 0.6
    with figure_style():
        figure = Figure(figsize=(max(width, 8.0), max(height, 5.0)), layout="constrained")
        figure.suptitle(f"Cross-play\n{note}", fontsize=11, ha="left", x=0.02, parse_math=False)
        for axis, (score, title, colours, percent) in zip(figure.subplots(2, 2).flat, panels, strict=True):
            values = matrix(encounters, score) * (100.0 if percent else 1.0)
            _draw(axis, values, colours, (0.0, 100.0) if percent else (float(values.min()), float(values.max())))
            axis.set_title(title)
            axis.set_xticks(range(len(columns)), columns, rotation=90, fontsize=8, parse_math=False)
            axis.set_yticks(range(len(rows)), rows, fontsize=8, parse_math=False)
            axis.set_xlabel(f"driver of {names[1]}")
            axis.set_ylabel(f"driver of {names[0]}")
        save_figure(figure, path, LARGE_DPI)


def _draw(axis: Axes, values: NDArray[np.float64], colours: str, limits: tuple[float, float]) -> None:
    axis.imshow(values, cmap=colours, vmin=limits[0], vmax=limits[1], aspect="equal")
    axis.grid(visible=False)
    if max(values.shape) > MOST_WITH_NUMBERS:
        return
    dark = limits[0] + 0.6 * (limits[1] - limits[0])
    for (row, column), value in np.ndenumerate(values):
        text = f"{value:.0f}" if limits == (0.0, 100.0) else f"{value:.1f}".rstrip("0").rstrip(".")
        axis.text(column, row, text, ha="center", va="center", fontsize=6.5, color="white" if value > dark else "black")
