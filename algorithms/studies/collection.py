"""The results of all runs of a sweep or study as data frames, which are also Parquet files for other programs.

``SWEEP/collected/`` is for anything that reads Parquet: ``pl.scan_parquet("SWEEP/collected/metrics.parquet")``,
``pandas.read_parquet("SWEEP/collected/scores.parquet")``. In every file the column "run" has the run's id:

``runs.parquet``, one row per run of the manifest:
    run, directory (relative to SWEEP), cell (its keys and values as text), trial (of a search, else null), seed,
    state ("finished", "pruned", "failed", "running", "interrupted", "trained"; "waiting" before it starts),
    step (environment steps so far), rows (of its metrics); then a column per key of the cell: numbers, booleans and
    strings as they are, other values as JSON.
``scores.parquet``, one row per metric in the final evaluation of each finished run:
    run, policy ("greedy", "stochastic" or "front"), vehicle ("" for one vehicle, or all together), metric, value,
    low and high (95% interval over the episodes, null if there is none); then the columns of ``runs.parquet``
    without directory, step and rows.
``metrics.parquet``, one row per row of each run's metrics.csv, unfinished runs included:
    run, step; then every metric of any run, null where a run or a row does not have it.
"""

from __future__ import annotations

import contextlib
import io
import json
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from algorithms.reporting.run_records import ExperimentRecord, experiment_record, final_scores
from algorithms.reporting.style import MAX_POINTS
from algorithms.reporting.training_log import read_rows
from algorithms.runs.run_directory import METRICS_FILE, read_status
from algorithms.runs.run_files import changed_files
from algorithms.studies.manifest import ManifestRow, label, read_manifest
from mo_deepdrive.evaluation.front import EVALUATION_FILE
from mo_deepdrive.evaluation.metrics import EVALUATION, STEP, MetricName, split_name
from mo_deepdrive.support.atomic_io import atomic_write, own_path

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path

    from algorithms.reporting.training_log import Columns

FOLDER = "collected"
FILES = tuple(f"{FOLDER}/{name}.parquet" for name in ("runs", "scores", "metrics"))
READ_FILES = "mo_deepdrive.logs"  # key in the metadata of metrics.parquet: size and time of every metrics.csv in it
ROW_GROUP_SIZE = 10_000  # rows; a reader skips row groups without the runs that it needs
MAX_NAMED = 3  # runs that a message lists by name
SCORE_KEYS = MetricName._fields  # columns that identify a score of a run
NUMBERS = ("value", "low", "high")


@dataclass(frozen=True)
class Cell:
    """Runs that differ in their seed alone.

    Attributes:
        keys: the varied values, by key, as in the manifest.
        trial: number of the point in a hyperparameter search; None without a search.
        rows: the runs in the manifest.
    """

    keys: dict[str, Any]
    trial: int | None
    rows: tuple[ManifestRow, ...]

    @cached_property
    def experiment(self) -> ExperimentRecord:
        """The resolved experiment of the first run."""
        return experiment_record(self.rows[0].config, f"config of run {self.rows[0].id} in the manifest")


@dataclass(frozen=True)
class Collection:
    """The results of a sweep, as returned by :func:`collect`; the module's docstring describes the frames.

    Attributes:
        sweep: its directory.
        rows: its manifest.
        runs, scores, logged: its runs, their final evaluations and their metrics.
        problems: why final evaluations are left out, by id.
        unreadable: why metrics cannot be read, one line per file.
        not_stored: why the frames are not in the sweep's directory; None if they are.
    """

    sweep: Path
    rows: tuple[ManifestRow, ...]
    runs: pl.DataFrame
    scores: pl.DataFrame
    logged: pl.DataFrame
    problems: dict[str, str]
    unreadable: list[str]
    not_stored: str | None

    @property
    def metrics(self) -> pl.DataFrame:
        """The metrics of all runs."""
        if self.logged.is_empty():
            raise ValueError(
                f"no run of sweep {str(self.sweep)!r} has any metrics yet: "
                f"mo-deepdrive sweep with --output {self.sweep} trains the runs"
            )
        return self.logged

    @cached_property
    def scored(self) -> frozenset[str]:
        """Ids of the runs with scores."""
        return frozenset(self.scores["run"])

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """The cells, in the order of the manifest."""
        rows_by_cell: dict[tuple[int | None, str], list[ManifestRow]] = {}
        for row in self.rows:
            rows_by_cell.setdefault((row.trial, as_json(row.cell)), []).append(row)
        return tuple(Cell(rows[0].cell, rows[0].trial, tuple(rows)) for rows in rows_by_cell.values())

    @property
    def remarks(self) -> list[str]:
        """Messages about missing and unreadable results, one line each."""
        remarks = []
        without = self.runs.filter(~pl.col("run").is_in([*self.scored, *self.problems]))
        if len(without):
            states = ", ".join(f"{number} {state}" for state, number in Counter(without["state"]).most_common())
            names = _shortened(without["directory"].to_list())
            remarks.append(f"{len(without)} of {len(self.rows)} runs have no final evaluation ({states}): {names}")
        broken = [*self.problems.values(), *self.unreadable]
        if broken:
            remarks.append(f"{len(broken)} files cannot be read: {_shortened(broken)}")
        return remarks

    def report_problems(self, warn: Callable[[str], None]) -> None:
        """Call ``warn`` with a line about everything that is left out or not stored."""
        for remark in self.remarks:
            warn(f"left out: {remark}")
        if self.not_stored:
            warn(f"the collected results are not stored: {self.not_stored}")

    def curves(self, runs: Sequence[str], names: Sequence[str], points: int = MAX_POINTS) -> dict[str, Columns]:
        """Learning curves of some runs, averaged within equal intervals of environment steps.

        Args:
            runs: ids.
            names: metrics.
            points: number of intervals, hence the maximum number of points per run and metric.

        Returns:
            Columns by run, as from :func:`algorithms.reporting.training_log.read_metrics`.
        """
        if not names:
            return {}
        of_runs = self.metrics.filter(pl.col("run").is_in(runs)).select("run", STEP, *names)
        last = int(of_runs.select(pl.col(STEP).max()).item() or 0)
        binned = (
            of_runs.unpivot(names, index=["run", STEP], variable_name="metric")
            .filter(pl.col("value").is_finite())
            .group_by("run", "metric", pl.col(STEP) // (last // points + 1))
            .agg(pl.col(STEP).mean().alias("mean_step"), pl.col("value").mean())
        )
        return {
            str(run): {
                name: column.to_numpy()
                for name, column in rows.sort("mean_step")
                .pivot("metric", index="mean_step", values="value")
                .rename({"mean_step": STEP})
                .fill_null(np.nan)
                .to_dict()
                .items()
            }
            for (run,), rows in binned.partition_by("run", as_dict=True).items()
        }

    def latest_scores(self) -> tuple[str, pl.DataFrame]:
        """The best scores that are known: final evaluations, or the last evaluations during training if there are none.

        Returns:
            "final" or "last", and a frame with the columns run, policy, vehicle, metric and value.
        """
        final = self.scores.select("run", *SCORE_KEYS, "value")
        if self.scored:
            return "final", final
        names = [name for name in self.metrics.columns if name.startswith(EVALUATION)]
        if not names:
            return "last", final
        last = (
            self.metrics.select("run", STEP, *names)
            .unpivot(names, index=["run", STEP], variable_name="name")
            .filter(pl.col("value").is_finite())
            .group_by("run", "name")
            .agg(pl.col("value").sort_by(STEP).last())
        )
        places = [split_name(name) for name in last["name"]]
        columns = [pl.Series(key, [place[i] for place in places], pl.String) for i, key in enumerate(SCORE_KEYS)]
        return "last", last.with_columns(columns).drop("name")


def collect(sweep: Path) -> Collection:
    """Collect the results of all runs, and update ``SWEEP/collected/`` where it can be written.

    Args:
        sweep: a directory with a manifest.
    """
    rows = tuple(read_manifest(sweep))
    if not rows:
        raise ValueError(
            f"sweep {str(sweep)!r} is empty: its manifest has no runs; mo-deepdrive sweep writes the manifest"
        )
    runs_file, scores_file, metrics_file = (own_path(sweep, name) for name in FILES)
    metrics, logs, unreadable = _read_logs(metrics_file, {row.id: sweep / row.directory / METRICS_FILE for row in rows})
    runs = _runs_frame(rows, [read_status(sweep / row.directory) for row in rows], metrics)
    finished = set(runs.filter(state="finished")["run"])
    scores, problems = _scores_frame([row for row in rows if row.id in finished], sweep)
    scores = scores.join(runs.drop("directory", "step", "rows"), on="run", how="left")
    not_stored = None
    try:
        metrics_file.parent.mkdir(exist_ok=True)
        if logs is not None:
            _write_parquet(metrics_file, metrics, {READ_FILES: json.dumps(logs)})
        _write_parquet(runs_file, runs)
        _write_parquet(scores_file, scores)
    except OSError as error:
        not_stored = str(error)
    return Collection(sweep, rows, runs, scores, metrics, problems, unreadable, not_stored)


# ------------------------------------------------------------------------------------------------------------- metrics


def _read_logs(stored: Path, files: Mapping[str, Path]) -> tuple[pl.DataFrame, dict[str, list[int]] | None, list[str]]:
    """The metrics of all runs; only those whose file has changed since they were stored are read again.

    Args:
        stored: the frame of an earlier call.
        files: metrics.csv by run; missing files are ignored.

    Returns:
        The frame; size and time (ns) of every file that is in it, or None if it is what is stored; and why other files
        cannot be read.
    """
    before, frame = _read_stored(stored)
    logs: dict[str, list[int]] = {}
    for run, path in files.items():
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            state = path.stat()
            logs[run] = [state.st_size, state.st_mtime_ns]
    unchanged = [run for run, log in logs.items() if before.get(run) == log]
    frames, unreadable = [frame.filter(pl.col("run").is_in(unchanged))], []
    for run in [run for run, log in logs.items() if before.get(run) != log]:
        try:
            frames.append(read_rows(files[run]).fill_nan(None).insert_column(0, pl.lit(run).alias("run")))
        except (ValueError, OSError) as error:
            unreadable.append(str(error))
            del logs[run]
    if logs == before:
        return frame, None, unreadable
    frame = pl.concat(frames, how="diagonal")
    return frame.select("run", STEP, *sorted(set(frame.columns) - {"run", STEP})), logs, unreadable


def _read_stored(path: Path) -> tuple[dict[str, list[int]], pl.DataFrame]:
    """The frame in a file and what :func:`_read_logs` says of it; nothing if the file is missing or damaged."""
    with contextlib.suppress(OSError, KeyError, ValueError, pl.exceptions.PolarsError):
        logs: dict[str, list[int]] = json.loads(pl.read_parquet_metadata(path)[READ_FILES])
        return logs, pl.read_parquet(path, glob=False)
    return {}, pl.DataFrame(schema={"run": pl.String, STEP: pl.Int64})


def _write_parquet(path: Path, frame: pl.DataFrame, metadata: dict[str, str] | None = None) -> None:
    """Write a table with metadata by key, atomically."""
    buffer = io.BytesIO()
    frame.write_parquet(buffer, compression_level=1, row_group_size=ROW_GROUP_SIZE, metadata=metadata)
    atomic_write(path, buffer.getvalue())


# ----------------------------------------------------------------------------------------------------- runs and scores


def _runs_frame(
    rows: Sequence[ManifestRow], statuses: Sequence[Mapping[str, Any]], metrics: pl.DataFrame
) -> pl.DataFrame:
    """The table of ``runs.parquet``."""
    keys = dict.fromkeys(key for row in rows for key in row.cell)
    logged = dict(metrics.group_by("run").len().iter_rows())
    return pl.DataFrame(
        [
            pl.Series("run", [row.id for row in rows], pl.String),
            pl.Series("directory", [row.directory for row in rows], pl.String),
            pl.Series("cell", [label(row.cell) for row in rows], pl.String),
            pl.Series("trial", [row.trial for row in rows], pl.Int64),
            pl.Series("seed", [row.seed for row in rows], pl.Int64),
            pl.Series("state", [str(status.get("state", "waiting")) for status in statuses], pl.String),
            pl.Series("step", [int(status.get("step", 0)) for status in statuses], pl.Int64, strict=False),
            pl.Series("rows", [logged.get(row.id, 0) for row in rows], pl.Int64),
            *(_key_column(key, [row.cell.get(key) for row in rows]) for key in keys),
        ]
    )


def _key_column(key: str, values: Sequence[Any]) -> pl.Series:
    """A column of values of a varied key, in the narrowest type that holds them all; else as JSON."""
    types = {type(value) for value in values if value is not None}
    for allowed, kind in (({bool}, pl.Boolean), ({int}, pl.Int64), ({int, float}, pl.Float64), ({str}, pl.String)):
        if types <= allowed:
            return pl.Series(key, values, kind, strict=False)
    return pl.Series(key, [as_json(value) for value in values], pl.String)


def _scores_frame(rows: Iterable[ManifestRow], sweep: Path) -> tuple[pl.DataFrame, dict[str, str]]:
    """The final evaluations of finished runs, and why others are left out, by id."""
    scores: list[tuple[Any, ...]] = []
    problems: dict[str, str] = {}
    for row in rows:
        run = sweep / row.directory
        changed = changed_files(run, [EVALUATION_FILE])
        if changed:
            problems[row.id] = f"{row.directory}: {changed[0]}; mo-deepdrive sweep --remake makes it again"
            continue
        try:
            scores += [
                (row.id, *split_name(name), *(getattr(estimate, number) for number in NUMBERS))
                for name, estimate in final_scores(run).items()
            ]
        except ValueError as error:
            problems[row.id] = str(error)
    types = {**dict.fromkeys(("run", *SCORE_KEYS), pl.String()), **dict.fromkeys(NUMBERS, pl.Float64())}
    return pl.DataFrame(scores, types, orient="row"), problems


def as_json(value: Any) -> str:
    """JSON with sorted keys: equal values have equal texts."""
    return json.dumps(value, sort_keys=True)


def _shortened(names: Sequence[str]) -> str:
    """The first few names, and the number of the others."""
    more = len(names) - MAX_NAMED
    return ", ".join([*names[:MAX_NAMED], *([f"and {more} more"] if more > 0 else [])])
