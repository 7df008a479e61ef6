"""The metrics of many runs as a few Parquet files, the parts; only what has changed is read and written again."""

from __future__ import annotations

import contextlib
import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

import polars as pl

from algorithms.common.atomic_io import atomic_write
from algorithms.common.metrics_file import read_metrics

# A part is full with so many runs, or so many bytes of metrics.csv.
PART_RUNS, PART_BYTES = 100, 64 * 2**20
ROW_GROUP = 10_000  # rows; a reader passes over those of runs that it does not want
METADATA = "mo_deepdrive.metrics"  # key in the file: which state of which runs a part holds


@dataclass(frozen=True)
class Log:
    """What a part knows of a run's metrics.csv.

    Attributes:
        size: when it was read (bytes).
        changed: when it had been changed (ns).
        rows: that it had.
        problem: why it could not be read; "" if it could.
    """

    size: int
    changed: int
    rows: int = 0
    problem: str = ""

    def same(self, other: Log | None) -> bool:
        """Whether both are of the same state of the file."""
        return other is not None and (self.size, self.changed) == (other.size, other.changed)


@dataclass(frozen=True)
class Part:
    """A Parquet file with the metrics of some runs."""

    path: Path
    logs: dict[str, Log]
    columns: list[str]

    @classmethod
    def open(cls, path: Path) -> Part:
        """The part in a file; an empty one if the file is not whole or not ours."""
        try:
            found = json.loads(pl.read_parquet_metadata(path)[METADATA])
            return cls(path, {run: Log(**log) for run, log in found.items()}, list(pl.read_parquet_schema(path)))
        except (KeyError, TypeError, ValueError, pl.exceptions.PolarsError):
            return cls(path, {}, [])

    def updated(self, logs: Mapping[str, Log], files: Mapping[str, Path], columns: list[str]) -> Part:
        """The part with the runs and columns that it should have: written again if need be, from what has changed.

        Args:
            logs: by run, the states that ``files`` have now.
            files: metrics.csv by run.
            columns: of the part, "run" and "step" first.

        Raises:
            OSError: if it cannot be written; it is then as it was.
        """
        known = {run: self.logs[run] for run, log in logs.items() if log.same(self.logs.get(run))}
        if len(known) == len(logs) == len(self.logs) and columns == self.columns:
            return self
        frames = [pl.DataFrame(schema={"run": pl.String, "step": pl.Int64})]
        if known:
            frames.append(pl.read_parquet(self.path, glob=False).filter(pl.col("run").is_in(list(known))))
        for run, log in logs.items():
            if run in known:
                continue
            try:
                frame = _read(files[run]).insert_column(0, pl.lit(run).alias("run"))
            except (ValueError, OSError) as error:
                known[run] = replace(log, problem=str(error))
                continue
            known[run] = replace(log, rows=len(frame))
            frames.append(frame)
        metadata = {METADATA: json.dumps({run: vars(log) for run, log in known.items()})}
        write_parquet(self.path, pl.concat([_with_columns(frame, columns) for frame in frames]), metadata)
        return Part(self.path, known, columns)


def update_metrics(folder: Path, files: Mapping[str, Path]) -> dict[str, Log]:
    """Bring the parts in ``folder`` up to date; only what has changed is read and written.

    All parts have the same columns, so that any reader takes them for one table.

    Args:
        folder: of the parts.
        files: metrics.csv by run; those that do not exist are passed over.

    Returns:
        What is known of every run that has a file.

    Raises:
        OSError: if a part cannot be written; every part is whole.
    """
    logs = _states(files)
    parts = {path: Part.open(path) for path in part_files(folder)}
    plan = _plan(folder, parts, logs)
    columns = {name for part in parts.values() for name in part.columns}
    read = {run: log for part in parts.values() for run, log in part.logs.items()}
    for run, log in logs.items():
        if not log.same(read.get(run)):
            with contextlib.suppress(OSError), files[run].open("rb") as file:
                columns |= set(_header(file.readline()))
    ordered = ["run", "step", *sorted(columns - {"run", "step"})]
    result: dict[str, Log] = {}
    for path, runs in plan.items():
        if runs:
            part = parts.get(path, Part(path, {}, []))
            result |= part.updated({run: logs[run] for run in runs}, files, ordered).logs
        else:
            path.unlink()
    return result


def part_files(folder: Path) -> list[Path]:
    """The parts in a folder, sorted."""
    return sorted(folder.glob("part-*.parquet"))


def _states(files: Mapping[str, Path]) -> dict[str, Log]:
    logs = {}
    for run, path in files.items():
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            state = path.stat()
            logs[run] = Log(state.st_size, state.st_mtime_ns)
    return logs


def _plan(folder: Path, parts: Mapping[Path, Part], logs: Mapping[str, Log]) -> dict[Path, list[str]]:
    """Which runs each part is to hold: those that it has, and new ones where there is room."""
    plan: dict[Path, list[str]] = {}
    placed: set[str] = set()
    for path, part in parts.items():
        plan[path] = [run for run in part.logs if run in logs and run not in placed]
        placed.update(plan[path])
    sizes = {path: sum(logs[run].size for run in runs) for path, runs in plan.items()}

    def is_full(path: Path) -> bool:
        return len(plan[path]) >= PART_RUNS or sizes[path] >= PART_BYTES

    numbered = (folder / f"part-{number:03d}.parquet" for number in count())
    room = [path for path in plan if not is_full(path)]
    for run in logs:
        if run in placed:
            continue
        if not room:
            path = next(path for path in numbered if path not in plan)
            room, plan[path], sizes[path] = [path], [], 0
        path = room[0]
        plan[path].append(run)
        sizes[path] += logs[run].size
        if is_full(path):
            room.pop(0)
    return plan


def _header(line: bytes) -> list[str]:
    """The columns that the first line of a metrics.csv names; none where it is torn or something else."""
    names = next(csv.reader([line.decode(errors="replace")]), []) if line.endswith(b"\n") else []
    return names if names[:1] == ["step"] else []


def _read(path: Path) -> pl.DataFrame:
    """The whole rows of a metrics.csv, null where one has no value.

    Raises:
        ValueError: if it is not a metrics file.
    """
    data = path.read_bytes()
    data = data[: data.rfind(b"\n") + 1]
    names = _header(data[: data.find(b"\n") + 1])
    # What polars would read in another way than read_metrics, read_metrics reads: slowly, and naming what is wrong.
    if names and data.count(b",") == (len(names) - 1) * data.count(b"\n"):
        with contextlib.suppress(pl.exceptions.PolarsError):
            types = {name: pl.Int64() if name == "step" else pl.Float64() for name in names}
            return pl.read_csv(data, schema=types).fill_nan(None)
    try:
        columns = read_metrics(path)
    except UnicodeDecodeError as error:
        raise ValueError(f"metrics file {str(path)!r} is broken: {error}") from None
    return pl.DataFrame(columns).with_columns(pl.col("step").cast(pl.Int64)).fill_nan(None)


def _with_columns(frame: pl.DataFrame, columns: Sequence[str]) -> pl.DataFrame:
    """The frame with these columns; metrics that it does not have are null."""
    there = set(frame.columns)
    return frame.select(pl.col(name) if name in there else pl.lit(None, pl.Float64).alias(name) for name in columns)


def write_parquet(path: Path, frame: pl.DataFrame, metadata: dict[str, str] | None = None) -> None:
    """Write a table, atomically.

    Args:
        path: the file.
        frame: the table.
        metadata: of the file, by key.

    Raises:
        OSError: if it cannot be written; it is then as it was.
    """
    buffer = io.BytesIO()
    frame.write_parquet(buffer, compression_level=1, row_group_size=ROW_GROUP, metadata=metadata)
    atomic_write(path, buffer.getvalue())
