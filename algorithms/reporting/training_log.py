"""The CSV file of a run's metrics: rows are appended while training, and a torn last row is not read."""

from __future__ import annotations

import csv
import io
import os
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mo_deepdrive.evaluation.metrics import STEP
from mo_deepdrive.support.atomic_io import atomic_write, csv_bytes, flush_to_disk, is_number

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

DIGITS = 16  # of a step: a run has at most 10**15
SHOWN = 40  # characters of a cell in a message
Columns = dict[str, NDArray[np.float64]]  # (rows,) each, by name


def read_metrics(path: str | Path) -> Columns:
    """The columns of a metrics.csv, including "step"; NaN where a row has no value."""
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"metrics file {str(path)!r} does not exist")
    header, rows = complete_rows(path)
    table = np.array([[float(cell or "nan") for cell in row] for row in rows]).reshape(len(rows), len(header))
    return {name: table[:, i] for i, name in enumerate(header)}


class MetricsFile:
    """A CSV file to which rows are appended; a new column rewrites the file.

    Args:
        path: the file.
        after: keep the rows up to this step and drop later ones, which a resumed run writes again; None starts a new
            file.
    """

    def __init__(self, path: Path, after: int | None = None):
        self.path = path
        self._columns: list[str] = [STEP]
        self._rows: list[list[str]] = []
        if after is not None:
            self._columns, self._rows = rows_until(path, after)
        self._rewrite()

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Append a row."""
        self._append([{STEP: str(step), **{name: format_number(value) for name, value in metrics.items()}}])

    def _append(self, rows: Sequence[Mapping[str, str]]) -> None:
        """Append rows of cells by the names of their columns."""
        new = [name for name in dict.fromkeys(name for row in rows for name in row) if name not in self._columns]
        self._columns += new
        cells = [[row.get(name, "") for name in self._columns] for row in rows]
        self._rows += cells
        if new:
            self._rewrite()
            return
        with self.path.open("r+b") as file:  # "a" would create it again, without its header
            file.seek(0, os.SEEK_END)
            file.write(csv_bytes(cells))

    def _rewrite(self) -> None:
        width = len(self._columns)
        atomic_write(self.path, csv_bytes([self._columns, *(row + [""] * (width - len(row)) for row in self._rows)]))

    def sync(self) -> None:
        """Make every row reach the disk."""
        with self.path.open("r+b") as file:
            flush_to_disk(file)


def format_number(value: float) -> str:
    """``value`` as text that reads back equal."""
    return repr(float(value))


def rows_until(path: Path, step: int) -> tuple[list[str], list[list[str]]]:
    """Header and rows up to a step, for a run that is resumed from there."""
    try:
        header, rows = complete_rows(path)
    except ValueError as error:
        raise ValueError(f"{error}; repair it, or delete it to resume without its rows") from None
    return header, [row for row in rows if int(row[0]) <= step]


def complete_rows(path: Path) -> tuple[list[str], list[list[str]]]:
    """Header and rows, without torn rows as a crash may leave them; only the header if the file is missing or empty."""
    try:
        data = path.read_bytes() if path.exists() else b""
        whole = data[: data.rfind(b"\n") + 1]
        header, *rows = _cells(whole or data) or [[STEP]]
        check_header(header)
        if not whole:  # nothing but a torn header
            return [STEP], []
        rows = [row for row in rows if len(row) == len(header)]
        for row in rows:
            _check_row(header, row)
    except OSError as error:
        raise ValueError(f"metrics file {str(path)!r} cannot be read: {error.strerror or error}") from None
    except ValueError as error:
        raise ValueError(f"metrics file {str(path)!r} {error}") from None
    return header, rows


def _check_row(header: Sequence[str], row: Sequence[str]) -> None:
    step = row[0]
    if not (step.isascii() and step.isdigit() and len(step) <= DIGITS):
        raise ValueError(f"has a row of step {step[:SHOWN]!r}; a step is an integer of at most {DIGITS} digits")
    for name, cell in zip(header, row, strict=True):
        if cell and not is_number(cell):
            raise ValueError(f"is broken: {name} = {cell[:SHOWN]!r} at step {step} is not a number")


def _cells(data: bytes) -> list[list[str]]:
    """The lines of a CSV file."""
    try:
        if b"\0" in data:
            raise csv.Error("it has NUL bytes")
        return list(csv.reader(io.StringIO(data.decode("utf-8"), newline=""), strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"is not a CSV file: {error}") from None


def read_header(line: bytes) -> list[str]:
    """The columns in the first line of a metrics.csv."""
    header = next(iter(_cells(line)), [])
    check_header(header if line.endswith(b"\n") else [])
    return header


def check_header(header: Sequence[str]) -> None:
    """Refuse what are not the columns of a metrics.csv."""
    if header[:1] != [STEP]:
        raise ValueError(f"has no column {STEP!r} at its beginning")
    repeated = [name for name, count in Counter(header).items() if count > 1]
    if repeated:
        raise ValueError(f"has two columns of the name {repeated[0][:SHOWN]!r}")
