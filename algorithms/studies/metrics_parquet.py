"""The metrics of many runs in a few Parquet files, the parts, which are updated incrementally.

Only runs whose metrics.csv has changed are read again, and only parts that hold such runs are written again.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
from dataclasses import dataclass, replace
from itertools import count
from typing import TYPE_CHECKING

import polars as pl

from algorithms.reporting.training_log import DIGITS, read_header, read_metrics
from mo_deepdrive.evaluation.metrics import STEP
from mo_deepdrive.support.atomic_io import atomic_write

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

# A part is full when it holds this many runs, or this many bytes of metrics.csv.
PART_RUNS, PART_BYTES = 100, 64 * 2**20
ROW_GROUP_SIZE = 10_000  # rows; a reader skips row groups without the runs that it needs
METADATA = "mo_deepdrive.logs"  # key in the file's metadata: the states of the runs that a part holds


@dataclass(frozen=True)
class LogState:
    """The state of a run's metrics.csv when it was read.

    Attributes:
        size: in bytes.
        changed: time of the last modification (ns).
        rows: number of rows.
        problem: why it could not be read; "" if it could.
        sha256: hash of the file, as in the record of a finished run.
    """

    size: int
    changed: int
    rows: int = 0
    problem: str = ""
    sha256: str = ""

    def same(self, other: LogState | None) -> bool:
        """Whether both describe the same state of the file."""
        return other is not None and (self.size, self.changed) == (other.size, other.changed)


@dataclass(frozen=True)
class MetricsPart:
    """A Parquet file with the metrics of some runs.

    Attributes:
        path: the file.
        logs: states of the runs that it holds, by run id.
        columns: their names.
    """

    path: Path
    logs: dict[str, LogState]
    columns: list[str]

    @classmethod
    def open(cls, path: Path) -> MetricsPart:
        """The part in a file; an empty part if the file is damaged or not a part."""
        try:
            found = json.loads(pl.read_parquet_metadata(path)[METADATA])
            return cls(path, {run: LogState(**log) for run, log in found.items()}, list(pl.read_parquet_schema(path)))
        except (AttributeError, KeyError, TypeError, ValueError, pl.exceptions.PolarsError):
            return cls(path, {}, [])

    def updated(self, logs: Mapping[str, LogState], files: Mapping[str, Path], columns: list[str]) -> MetricsPart:
        """Give the part these runs and columns; it is written only if something has changed.

        Args:
            logs: current states of ``files``, by run.
            files: metrics.csv by run.
            columns: of the part, "run" and "step" first.

        Raises:
            OSError: if it cannot be written; the file is then unchanged.
        """
        known = {run: self.logs[run] for run, log in logs.items() if log.same(self.logs.get(run))}
        if len(known) == len(logs) == len(self.logs) and columns == self.columns:
            return self
        frames = [pl.DataFrame(schema={"run": pl.String, STEP: pl.Int64})]
        try:
            if known:
                frames.append(pl.read_parquet(self.path, glob=False).filter(pl.col("run").is_in(list(known))))
        except pl.exceptions.PolarsError:  # damaged
            known = {}
        for run, log in logs.items():
            if run in known:
                continue
            try:
                log = replace(log, sha256=hashlib.sha256(files[run].read_bytes()).hexdigest())
                frame = _read_rows(files[run]).insert_column(0, pl.lit(run).alias("run"))
            except (ValueError, OSError) as error:
                known[run] = replace(log, problem=str(error))
                continue
            known[run] = replace(log, rows=len(frame))
            frames.append(frame)
        metadata = {METADATA: json.dumps({run: vars(log) for run, log in known.items()})}
        write_parquet(self.path, pl.concat([_with_columns(frame, columns) for frame in frames]), metadata)
        return MetricsPart(self.path, known, columns)


def update_metrics(folder: Path, files: Mapping[str, Path]) -> dict[str, LogState]:
    """Update the parts in ``folder``.

    All parts get the same columns, so that any Parquet reader takes them for one table.

    Args:
        folder: of the parts.
        files: metrics.csv by run; missing files are ignored.

    Returns:
        The state of every existing file, by run.

    Raises:
        OSError: if a part cannot be written; no part is left half written.
    """
    logs = _current_states(files)
    parts = {path: MetricsPart.open(path) for path in part_files(folder)}
    plan = _assign_runs(folder, parts, logs)
    columns = {name for part in parts.values() for name in part.columns}
    read = {run: log for part in parts.values() for run, log in part.logs.items()}
    for run, log in logs.items():
        if not log.same(read.get(run)):
            with contextlib.suppress(OSError, ValueError), files[run].open("rb") as file:
                columns |= set(read_header(file.readline()))
    ordered = ["run", STEP, *sorted(columns - {"run", STEP})]
    result: dict[str, LogState] = {}
    for path, runs in plan.items():
        if runs:
            part = parts.get(path, MetricsPart(path, {}, []))
            result |= part.updated({run: logs[run] for run in runs}, files, ordered).logs
        else:
            path.unlink()
    return result


def part_files(folder: Path) -> list[Path]:
    """The files of the parts in a folder, sorted."""
    return sorted(folder.glob("part-*.parquet"))


def _current_states(files: Mapping[str, Path]) -> dict[str, LogState]:
    logs = {}
    for run, path in files.items():
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            state = path.stat()
            logs[run] = LogState(state.st_size, state.st_mtime_ns)
    return logs


def _assign_runs(
    folder: Path, parts: Mapping[Path, MetricsPart], logs: Mapping[str, LogState]
) -> dict[Path, list[str]]:
    """Assign runs to parts: each stays in its part, and new ones go to the first parts with room."""
    plan = {path: [run for run in part.logs if run in logs] for path, part in parts.items()}
    placed = {run for runs in plan.values() for run in runs}

    def is_full(runs: Sequence[str]) -> bool:
        return len(runs) >= PART_RUNS or sum(logs[run].size for run in runs) >= PART_BYTES

    paths = (folder / f"part-{number:03d}.parquet" for number in count())
    path = next(paths)
    for run in logs:
        if run not in placed:
            while is_full(plan.setdefault(path, [])):
                path = next(paths)
            plan[path].append(run)
    return plan


def _read_rows(path: Path) -> pl.DataFrame:
    """The complete rows of a metrics.csv, with null for missing values.

    Raises:
        ValueError: if it is not a metrics file.
    """
    data = path.read_bytes()
    data = data[: data.rfind(b"\n") + 1]
    # read_metrics is slow but tolerates ragged rows and says what is wrong; polars reads only files that are regular.
    with contextlib.suppress(ValueError, pl.exceptions.PolarsError):
        names = read_header(data[: data.find(b"\n") + 1])
        if data.count(b",") == (len(names) - 1) * data.count(b"\n") and b"\0" not in data:
            types = {name: pl.Int64() if name == STEP else pl.Float64() for name in names}
            frame = pl.read_csv(data, schema=types).fill_nan(None)
            if frame[STEP].is_between(0, 10**DIGITS - 1).all() and not frame[STEP].has_nulls():
                return frame
    return pl.DataFrame(read_metrics(path)).with_columns(pl.col(STEP).cast(pl.Int64)).fill_nan(None)


def _with_columns(frame: pl.DataFrame, columns: Sequence[str]) -> pl.DataFrame:
    """The frame with exactly these columns; missing metrics are null."""
    known = set(frame.columns)
    return frame.select(pl.col(name) if name in known else pl.lit(None, pl.Float64).alias(name) for name in columns)


def write_parquet(path: Path, frame: pl.DataFrame, metadata: dict[str, str] | None = None) -> None:
    """Write a table, atomically.

    Args:
        path: the file.
        frame: the table.
        metadata: of the file, by key.

    Raises:
        OSError: if it cannot be written; the file is then unchanged.
    """
    buffer = io.BytesIO()
    frame.write_parquet(buffer, compression_level=1, row_group_size=ROW_GROUP_SIZE, metadata=metadata)
    atomic_write(path, buffer.getvalue())
