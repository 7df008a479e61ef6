"""The CSV file of a run's metrics: rows are appended while training, and a torn last row is not read."""

from __future__ import annotations

import csv
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mo_deepdrive.evaluation.metrics import STEP
from mo_deepdrive.support.atomic_io import atomic_write, csv_bytes, flush_to_disk

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import polars as pl

POLICY = "policy"  # its number, in files of fronts
Columns = dict[str, NDArray[np.float64]]  # (rows,) each, by name


def read_metrics(path: str | Path) -> Columns:
    """The columns of a metrics.csv, including "step"; NaN where a row has no value."""
    if not Path(path).is_file():
        raise ValueError(f"metrics file {str(path)!r} does not exist")
    return {column.name: column.to_numpy().astype(np.float64) for column in read_rows(Path(path))}


def read_rows(path: Path) -> pl.DataFrame:
    """The complete rows of a metrics.csv, with null where a row has no value; none if it is missing or empty."""
    import polars as pl  # not earlier: no environment needs it

    try:
        data = path.read_bytes() if path.exists() else b""
        data = data[: data.rfind(b"\n") + 1]  # without a torn row, as a crash may leave it
        header = next(csv.reader(data.decode().splitlines()[:1]), [STEP])
        if header[:1] != [STEP] or len({*header}) < len(header):
            raise ValueError(f"its columns must be {STEP!r}, then different metrics")
        types = {name: pl.Int64() if name in (STEP, POLICY) else pl.Float64() for name in header}
        frame = pl.read_csv(data, schema=types) if data else pl.DataFrame(schema=types)
        if frame[STEP].has_nulls():
            raise ValueError(f"a row has no {STEP}")
    except (OSError, ValueError, csv.Error, pl.exceptions.PolarsError) as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(f"metrics file {str(path)!r} cannot be read: {reason}") from None
    return frame


def rows_until(path: Path, step: int) -> pl.DataFrame:
    """The rows up to a step, for a run that is resumed from there."""
    try:
        frame = read_rows(path)
    except ValueError as error:
        raise ValueError(f"{error}; repair it, or delete it to resume without its rows") from None
    return frame.filter(frame[STEP] <= step)


class MetricsFile:
    """A CSV file to which rows are appended; a new column rewrites the file.

    Rows ``after`` a step, which a resumed run writes again, are dropped; with None the file is a new one.
    """

    def __init__(self, path: Path, after: int | None = None):
        self.path = path
        self._columns: list[str] = [STEP]
        self._rows: list[list[str]] = []
        if after is not None:
            frame = rows_until(path, after)
            self._columns = frame.columns
            self._rows = [["" if cell is None else repr(cell) for cell in row] for row in frame.iter_rows()]
        self._rewrite()

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Append a row."""
        self._append([{STEP: str(step), **{name: repr(float(value)) for name, value in metrics.items()}}])

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
