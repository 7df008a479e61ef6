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

import io
import json
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from algorithms.reporting.run_records import ExperimentRecord, experiment_record, final_scores
from algorithms.reporting.training_log import read_rows
from algorithms.runs.run_directory import METRICS_FILE, changed_files, read_status
from algorithms.studies.manifest import ManifestRow, first_of, label, read_manifest
from mo_deepdrive.evaluation.front import EVALUATION_FILE
from mo_deepdrive.evaluation.metrics import EVALUATION, STEP, MetricName, split_name
from mo_deepdrive.support.atomic_io import atomic_write, own_path

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from algorithms.reporting.training_log import Columns

FOLDER = "collected"
MAX_NAMED = 3  # runs that a message lists by name
SCORE_KEYS = MetricName._fields  # columns that identify a score of a run
SCORE_TYPES = dict.fromkeys(("run", *SCORE_KEYS), pl.String) | dict.fromkeys(("value", "low", "high"), pl.Float64)
RUN_TYPES = dict.fromkeys(("run", "directory", "cell"), pl.String) | {"trial": pl.Int64, "seed": pl.Int64}
RUN_TYPES |= {"state": pl.String, "step": pl.Int64, "rows": pl.Int64}


@dataclass(frozen=True)
class Cell:
    """Runs that differ in their seed alone: the varied values and the number of the trial, as in the manifest."""

    keys: dict[str, Any]
    trial: int | None
    rows: tuple[ManifestRow, ...]

    @cached_property
    def experiment(self) -> ExperimentRecord:
        """The resolved experiment of the first run."""
        return experiment_record(self.rows[0].config, f"config of run {self.rows[0].id} in the manifest")


@dataclass(frozen=True)
class Collection:
    """The manifest of a sweep, its runs, their final evaluations and what they logged, as in the module's docstring."""

    sweep: Path
    rows: tuple[ManifestRow, ...]
    runs: pl.DataFrame
    scores: pl.DataFrame
    logged: pl.DataFrame

    @property
    def metrics(self) -> pl.DataFrame:
        """The metrics of all runs."""
        if self.logged.is_empty():
            hint = f"mo-deepdrive sweep with --output {self.sweep} trains the runs"
            raise ValueError(f"no run of sweep {str(self.sweep)!r} has any metrics yet: {hint}")
        return self.logged

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """The cells, in the order of the manifest."""
        rows_by_cell: dict[tuple[int | None, str], list[ManifestRow]] = {}
        for row in self.rows:
            rows_by_cell.setdefault((row.trial, as_json(row.cell)), []).append(row)
        return tuple(Cell(rows[0].cell, rows[0].trial, tuple(rows)) for rows in rows_by_cell.values())

    def columns_of(self, run: str, names: Sequence[str]) -> Columns:
        """The steps and some metrics of a run, as :func:`algorithms.reporting.training_log.read_metrics` has them."""
        frame = self.metrics.filter(run=run).select(STEP, *names)
        return {name: column.cast(pl.Float64).fill_null(np.nan).to_numpy() for name, column in frame.to_dict().items()}

    def latest_scores(self) -> tuple[str, pl.DataFrame]:
        """The best scores that are known, "final" ones or, if there are none, the "last" ones during training."""
        final = self.scores.select("run", *SCORE_KEYS, "value")
        names = [name for name in self.metrics.columns if name.startswith(EVALUATION)]
        if len(final) or not names:
            return "final" if len(final) else "last", final
        last = (
            self.metrics.select("run", STEP, *names)
            .unpivot(names, index=["run", STEP], variable_name="name")
            .filter(pl.col("value").is_finite())
            .group_by("run", "name")
            .agg(pl.col("value").sort_by(STEP).last())
        )
        rows = [(run, *split_name(name), value) for run, name, value in last.select("run", "name", "value").rows()]
        return "last", pl.DataFrame(rows, final.schema, orient="row")


def collect(sweep: Path, warn: Callable[[str], None]) -> Collection:
    """Collect the results of all runs, and write ``SWEEP/collected/``; ``warn`` is told what is left out."""
    rows = tuple(read_manifest(sweep))
    if not rows:
        hint = "its manifest has no runs; mo-deepdrive sweep writes the manifest"
        raise ValueError(f"sweep {str(sweep)!r} is empty: {hint}")
    about: list[tuple[Any, ...]] = []
    scores: list[tuple[Any, ...]] = []
    logged = [pl.DataFrame(schema={"run": pl.String, STEP: pl.Int64})]
    without: dict[str, str] = {}  # directories of runs without a final evaluation, with their states
    unreadable: list[str] = []
    for row in rows:
        directory, length = sweep / row.directory, 0
        status = read_status(directory)
        state = str(status.get("state", "waiting"))
        try:
            logged.append(
                read_rows(directory / METRICS_FILE).fill_nan(None).insert_column(0, pl.lit(row.id).alias("run"))
            )
            length = len(logged[-1])
        except ValueError as error:
            unreadable.append(str(error))
        about.append(
            (row.id, row.directory, label(row.cell), row.trial, row.seed, state, status.get("step", 0), length)
        )
        try:
            if state == "finished" and (changed := changed_files(directory, [EVALUATION_FILE])):
                raise ValueError(f"{row.directory}: {changed[0]}; mo-deepdrive sweep --remake makes it again")
            known = final_scores(directory) if state == "finished" else {}
        except ValueError as error:
            unreadable.append(str(error))
            continue
        scores += [(row.id, *split_name(name), score.value, score.low, score.high) for name, score in known.items()]
        if not known:
            without[row.directory] = state
    if without:
        states = ", ".join(f"{number} {state}" for state, number in Counter(without.values()).most_common())
        names = ", ".join(first_of([*without], MAX_NAMED))
        warn(f"left out: {len(without)} of {len(rows)} runs have no final evaluation ({states}): {names}")
    if unreadable:
        names = ", ".join(first_of(unreadable, MAX_NAMED))
        warn(f"left out: {len(unreadable)} files cannot be read: {names}")
    keys = dict.fromkeys(key for row in rows for key in row.cell)
    columns = (_key_column(key, [row.cell.get(key) for row in rows]) for key in keys)
    runs = pl.DataFrame(about, RUN_TYPES, orient="row").with_columns(columns)
    of_scores = pl.DataFrame(scores, SCORE_TYPES, orient="row").join(
        runs.drop("directory", "step", "rows"), on="run", how="left"
    )
    metrics = pl.concat(logged, how="diagonal")
    metrics = metrics.select("run", STEP, *sorted({*metrics.columns} - {"run", STEP}))
    try:
        for name, frame in (("metrics", metrics), ("runs", runs), ("scores", of_scores)):
            buffer = io.BytesIO()
            # A reader skips row groups without the runs that it needs.
            frame.write_parquet(buffer, compression_level=1, row_group_size=10_000)
            file = own_path(sweep, f"{FOLDER}/{name}.parquet")
            file.parent.mkdir(exist_ok=True)
            atomic_write(file, buffer.getvalue())
    except OSError as error:
        warn(f"the collected results are not stored: {error}")
    return Collection(sweep, rows, runs, of_scores, metrics)


def _key_column(key: str, values: Sequence[Any]) -> pl.Series:
    """A column of values of a varied key, in the narrowest type that holds them all; else as JSON."""
    types = {type(value) for value in values if value is not None}
    for allowed, kind in (({bool}, pl.Boolean), ({int}, pl.Int64), ({int, float}, pl.Float64), ({str}, pl.String)):
        if types <= allowed:
            return pl.Series(key, values, kind, strict=False)
    return pl.Series(key, [as_json(value) for value in values], pl.String)


def as_json(value: Any) -> str:
    """JSON with sorted keys: equal values have equal texts."""
    return json.dumps(value, sort_keys=True)
