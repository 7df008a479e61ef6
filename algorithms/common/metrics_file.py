"""The CSV file of a run's metrics: rows are appended while training, and a torn last row is not read."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from algorithms.common.atomic_io import atomic_write, csv_bytes

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray


def read_metrics(path: str | Path) -> dict[str, NDArray[np.float64]]:
    """The columns of a metrics.csv, including "step"; NaN where a row has no value.

    Raises:
        ValueError: if the file is missing or not a metrics file.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"metrics file {str(path)!r} does not exist")
    header, rows = complete_rows(path)
    if header[0] != "step":
        raise ValueError(f"metrics file {str(path)!r} has no column 'step' at its beginning")
    try:
        table = np.array([[float(cell or "nan") for cell in row] for row in rows]).reshape(len(rows), len(header))
    except ValueError as error:
        raise ValueError(f"metrics file {str(path)!r} is broken: {error}") from None
    return {name: table[:, i] for i, name in enumerate(header)}


class MetricsFile:
    """A CSV file with one row per call; a new column rewrites the file.

    Args:
        path: the file.
        after: keep the rows up to this step and drop later ones, which a resumed run writes again; None starts a new
            file.
    """

    def __init__(self, path: Path, after: int | None = None):
        self.path = path
        self._columns, self._rows = ["step"], []
        if after is not None:
            columns, rows = complete_rows(path)
            self._columns, self._rows = columns, [row for row in rows if int(row[0]) <= after]
        self._rewrite()

    def _rewrite(self) -> None:
        width = len(self._columns)
        lines = [csv_line(self._columns), *(csv_line(row + [""] * (width - len(row))) for row in self._rows)]
        atomic_write(self.path, "".join(lines).encode())

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Append a row.

        Raises:
            OSError: if it cannot be written.
        """
        new = [name for name in metrics if name not in self._columns]
        self._columns += new
        cells = {"step": str(step), **{name: format_number(value) for name, value in metrics.items()}}
        row = [cells.get(name, "") for name in self._columns]
        self._rows.append(row)
        if new:
            self._rewrite()
        else:
            with self.path.open("a") as file:
                file.write(csv_line(row))


def format_number(value: float) -> str:
    """``value`` as text that reads back equal."""
    return repr(float(value))


def csv_line(cells: Sequence[str]) -> str:
    """``cells`` as one line of a CSV file."""
    return csv_bytes([cells]).decode()


def complete_rows(path: Path) -> tuple[list[str], list[list[str]]]:
    """Header and rows, without the torn row that a crash may leave at the end."""
    text = path.read_text() if path.exists() else ""
    lines = list(csv.reader(text[: text.rfind("\n") + 1].splitlines()))
    if not lines:
        return ["step"], []
    header, *rows = lines
    return header, [row for row in rows if len(row) == len(header)]
