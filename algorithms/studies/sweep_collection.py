"""The metrics and scores of all runs of a sweep as Parquet files, updated on demand.

``SWEEP/collected/`` is for anything that reads Parquet: ``pl.scan_parquet("SWEEP/collected/metrics/*.parquet")``,
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
``metrics/part-*.parquet``, one row per row of each run's metrics.csv, unfinished runs included:
    run, step; then every metric of any run, null where a run or a row does not have it.
"""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from algorithms.reporting.run_records import ExperimentRecord, experiment_record, final_scores
from algorithms.reporting.style import MAX_POINTS
from algorithms.runs.run_directory import METRICS_FILE, read_status
from algorithms.runs.run_files import changed_files
from algorithms.studies.metrics_parquet import LogState, part_files, update_metrics, write_parquet
from algorithms.studies.sweep_manifest import ManifestRow, label, read_manifest
from mo_deepdrive.evaluation.front import EVALUATION_FILE
from mo_deepdrive.evaluation.metrics import EVALUATION, STEP, MetricName, split_name
from mo_deepdrive.support.atomic_io import leftovers, lock, own_path

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from algorithms.reporting.training_log import Columns

FOLDER = "collected"
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
        return experiment_record(self.rows[0].config)


@dataclass(frozen=True)
class Collection:
    """The collected results of a sweep, as returned by :func:`collect`.

    Attributes:
        sweep: its directory.
        rows: its manifest.
        states: of all runs, by id.
        logs: of the runs with a metrics.csv, by id.
        scored: ids of the runs with scores.
        problems: why final evaluations cannot be read, by id.
        altered: what differs from the record of a finished run's files, by id.
        folder: of the files.
        not_stored: why they are not in the sweep; None if they are.
        temporary: the folder that then has them, and is deleted with this object.
    """

    sweep: Path
    rows: tuple[ManifestRow, ...]
    states: dict[str, str]
    logs: dict[str, LogState]
    scored: frozenset[str]
    problems: dict[str, str]
    altered: dict[str, list[str]]
    folder: Path
    not_stored: str | None = None
    temporary: tempfile.TemporaryDirectory[str] | None = None

    @property
    def runs(self) -> pl.LazyFrame:
        """Lazy frame of ``runs.parquet``."""
        return pl.scan_parquet(self.folder / "runs.parquet", glob=False)

    @property
    def scores(self) -> pl.LazyFrame:
        """Lazy frame of ``scores.parquet``."""
        return pl.scan_parquet(self.folder / "scores.parquet", glob=False)

    @property
    def metrics(self) -> pl.LazyFrame:
        """Lazy frame of the metrics of all runs.

        Raises:
            ValueError: if no run has any.
        """
        if not any(log.rows for log in self.logs.values()):
            raise ValueError(
                f"no run of sweep {str(self.sweep)!r} has any metrics yet: "
                f"mo-deepdrive sweep with --output {self.sweep} trains the runs"
            )
        return pl.scan_parquet(part_files(self.folder / "metrics"), glob=False)

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """The cells, in the order of the manifest."""
        found: dict[tuple[int | None, str], list[ManifestRow]] = {}
        for row in self.rows:
            found.setdefault((row.trial, as_json(row.cell)), []).append(row)
        return tuple(Cell(rows[0].cell, rows[0].trial, tuple(rows)) for rows in found.values())

    @property
    def remarks(self) -> list[str]:
        """Messages about missing, unreadable and altered results, one line each."""
        found = []
        left_out = {run: changes for run, changes in self.altered.items() if _unreliable(changes)}
        told = {*self.scored, *left_out, *self.problems}
        without = [row for row in self.rows if row.id not in told]
        if without:
            counts = Counter(self.states[row.id] for row in without).most_common()
            states = ", ".join(f"{number} {state}" for state, number in counts)
            names = _shortened([row.directory for row in without])
            found.append(f"{len(without)} of {len(self.rows)} runs have no final evaluation ({states}): {names}")
        broken = [*self.problems.values(), *(log.problem for log in self.logs.values() if log.problem)]
        if broken:
            found.append(f"{len(broken)} files cannot be read: {_shortened(broken)}")
        return [*found, *self._describe(left_out)]

    def report_problems(self, warn: Callable[[str], None]) -> None:
        """Call ``warn`` with a line about everything that is left out, not stored, or altered beside the scores."""
        for remark in self.remarks:
            warn(f"left out: {remark}")
        if self.not_stored:
            warn(f"the collected results are not stored: {self.not_stored}")
        for line in self._describe({run: each for run, each in self.altered.items() if not _unreliable(each)}):
            warn(line)

    def _describe(self, altered: Mapping[str, Sequence[str]]) -> list[str]:
        named = [f"{row.directory}: {'; '.join(altered[row.id])}" for row in self.rows if row.id in altered]
        advice = "mo-deepdrive sweep --remake makes them again"
        return [f"{len(named)} runs differ from the record of their files, {advice}: {_shortened(named)}"] * bool(named)

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
        mine = self.metrics.filter(pl.col("run").is_in(runs)).select("run", STEP, *names)
        last = self._read(mine.select(pl.col(STEP).max())).item() or 0
        wanted = (
            mine.unpivot(names, index=["run", STEP], variable_name="metric")
            .filter(pl.col("value").is_finite())
            .group_by("run", "metric", pl.col(STEP) // (last // points + 1))
            .agg(pl.col(STEP).mean().alias("mean_step"), pl.col("value").mean())
        )
        binned = self._read(wanted)
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

    def _read(self, frame: pl.LazyFrame) -> pl.DataFrame:
        """The rows of a frame of the metrics.

        Raises:
            ValueError: if their files are damaged.
        """
        try:
            return frame.collect(engine="streaming")
        except pl.exceptions.PolarsError as error:
            folder = self.sweep / FOLDER / "metrics"
            reason = " ".join(str(error).split())
            raise ValueError(f"{str(folder)!r} is damaged; delete it, and it is made again: {reason}") from None

    def latest_scores(self) -> tuple[str, pl.DataFrame]:
        """The best scores that are known: final evaluations, or the last evaluations during training if there are none.

        Returns:
            "final" or "last", and a frame with the columns run, policy, vehicle, metric and value.

        Raises:
            ValueError: if no run has any metrics.
        """
        final = self.scores.select("run", *SCORE_KEYS, "value").collect()
        if self.scored:
            return "final", final
        metrics = self.metrics.filter(~pl.col("run").is_in([run for run in self.altered if run not in self.scored]))
        names = [name for name in metrics.collect_schema().names() if name.startswith(EVALUATION)]
        if not names:
            return "last", final
        wanted = (
            metrics.select("run", STEP, *names)
            .unpivot(names, index=["run", STEP], variable_name="name")
            .filter(pl.col("value").is_finite())
            .group_by("run", "name")
            .agg(pl.col("value").sort_by(STEP).last())
        )
        long = self._read(wanted)
        places = [split_name(name) for name in long["name"]]
        columns = [pl.Series(key, [place[i] for place in places], pl.String) for i, key in enumerate(SCORE_KEYS)]
        return "last", long.with_columns(columns).drop("name")


def collect(sweep: Path) -> Collection:
    """Update ``SWEEP/collected/``; the module's docstring describes its files.

    Where it cannot be written, such as on a read-only disk, the files are in a temporary folder instead.

    Args:
        sweep: a directory with a manifest.

    Raises:
        ValueError: if there is no manifest, it is broken or empty, or a link leads out of ``collected``.
        OSError: if something cannot be read, or written anywhere.
    """
    rows = tuple(read_manifest(sweep))
    if not rows:
        raise ValueError(
            f"sweep {str(sweep)!r} is empty: its manifest has no runs; mo-deepdrive sweep writes the manifest"
        )
    for row in rows:
        experiment_record(row.config, f"config of run {row.id} in the manifest of {str(sweep)!r}")
    folder = own_path(sweep, f"{FOLDER}/metrics").parent
    try:
        return _collect(sweep, rows, folder)
    except OSError as error:
        temporary = tempfile.TemporaryDirectory(prefix="mo-deepdrive-")
        collection = _collect(sweep, rows, Path(temporary.name))
        return replace(collection, not_stored=str(error), temporary=temporary)


def _collect(sweep: Path, rows: tuple[ManifestRow, ...], folder: Path) -> Collection:
    """As :func:`collect`, with the files in ``folder``."""
    with _locked(folder):
        status = {row.id: read_status(sweep / row.directory) for row in rows}
        states = {run: str(each.get("state", "waiting")) for run, each in status.items()}
        logs = update_metrics(folder / "metrics", {row.id: sweep / row.directory / METRICS_FILE for row in rows})
        steps = [int(status[row.id].get("step", 0)) for row in rows]
        runs = _runs_frame(rows, states, steps, logs)
        finished = [row for row in rows if states[row.id] == "finished"]
        changed = {row.id: _changed(sweep / row.directory, status[row.id], logs.get(row.id)) for row in finished}
        scores, problems = _scores_frame([row for row in finished if not _unreliable(changed[row.id])], sweep)
        of_runs = runs.drop("directory", "step", "rows")
        write_parquet(folder / "runs.parquet", runs)
        write_parquet(folder / "scores.parquet", scores.join(of_runs, on="run", how="left"))
    altered = {run: found for run, found in changed.items() if found}
    return Collection(sweep, rows, states, logs, frozenset(scores["run"].unique()), problems, altered, folder)


def _changed(run: Path, status: Mapping[str, Any], log: LogState | None) -> list[str]:
    """What differs from a finished run's record: the final evaluation and the metrics by hash, the rest by size."""
    record = status.get("files")
    if not isinstance(record, dict):
        return []
    suspects = [EVALUATION_FILE]
    for name, entry in record.items():
        if name == METRICS_FILE:
            same = log is not None and {"size": log.size, "sha256": log.sha256} == entry
        else:
            path = run / name
            same = path.is_file() and isinstance(entry, dict) and path.stat().st_size == entry.get("size")
        suspects += [] if same else [name]
    return changed_files(run, suspects)


def _unreliable(changes: Sequence[str]) -> bool:
    """Whether what differs is what tables and figures show."""
    return any(change.partition(":")[0] in (EVALUATION_FILE, METRICS_FILE) for change in changes)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Create the folders, and hold a lock so that processes that collect the same sweep wait for each other."""
    (folder / "metrics").mkdir(parents=True, exist_ok=True)
    held = lock(own_path(folder, ".lock"), wait=True)
    try:
        for leftover in (*leftovers(folder), *leftovers(folder / "metrics")):
            leftover.unlink()
        yield
    finally:
        held.release()


def _runs_frame(
    rows: Sequence[ManifestRow], states: Mapping[str, str], steps: Sequence[int], logs: Mapping[str, LogState]
) -> pl.DataFrame:
    """The table of ``runs.parquet``."""
    keys = dict.fromkeys(key for row in rows for key in row.cell)
    return pl.DataFrame(
        [
            pl.Series("run", [row.id for row in rows], pl.String),
            pl.Series("directory", [row.directory for row in rows], pl.String),
            pl.Series("cell", [label(row.cell) for row in rows], pl.String),
            pl.Series("trial", [row.trial for row in rows], pl.Int64),
            pl.Series("seed", [row.seed for row in rows], pl.Int64),
            pl.Series("state", [states[row.id] for row in rows], pl.String),
            pl.Series("step", steps, pl.Int64, strict=False),
            pl.Series("rows", [logs[row.id].rows if row.id in logs else 0 for row in rows], pl.Int64),
            *(_key_column(key, [row.cell.get(key) for row in rows]) for key in keys),
        ]
    )


def _key_column(key: str, values: Sequence[Any]) -> pl.Series:
    """A column of values of a varied key, in the narrowest type that holds them all; else as JSON."""
    types = {type(value) for value in values if value is not None}
    for wanted, kind in (({bool}, pl.Boolean), ({int}, pl.Int64), ({int, float}, pl.Float64), ({str}, pl.String)):
        if types <= wanted:
            return pl.Series(key, values, kind, strict=False)
    return pl.Series(key, [as_json(value) for value in values], pl.String)


def _scores_frame(rows: Iterable[ManifestRow], sweep: Path) -> tuple[pl.DataFrame, dict[str, str]]:
    """The final evaluations, and messages about those that cannot be read, by id."""
    found: list[tuple[Any, ...]] = []
    problems: dict[str, str] = {}
    for row in rows:
        try:
            found += [
                (row.id, *split_name(name), *(getattr(estimate, number) for number in NUMBERS))
                for name, estimate in final_scores(sweep / row.directory).items()
            ]
        except ValueError as error:
            problems[row.id] = str(error)
    types = {**dict.fromkeys(("run", *SCORE_KEYS), pl.String()), **dict.fromkeys(NUMBERS, pl.Float64())}
    return pl.DataFrame(found, types, orient="row"), problems


def as_json(value: Any) -> str:
    """JSON with sorted keys: equal values have equal texts."""
    return json.dumps(value, sort_keys=True)


def _shortened(names: Sequence[str]) -> str:
    """The first few names, and the number of the others."""
    more = len(names) - MAX_NAMED
    return ", ".join([*names[:MAX_NAMED], *([f"and {more} more"] if more > 0 else [])])
