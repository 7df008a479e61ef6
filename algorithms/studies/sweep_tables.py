"""The results of a sweep or study: data frames, tables and figures of its cells, the best first, and comparisons.

The data frames are also Parquet files for other programs.

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
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import polars as pl

from algorithms.reporting.run_records import ExperimentRecord, distinct_labels, experiment_record, final_scores
from algorithms.reporting.tables import (
    TABLE_COLUMNS,
    TABLE_METRICS,
    Rows,
    ScoreGroup,
    check_columns,
    comparison_table,
    interval_note,
    print_rows,
    scores_table,
)
from algorithms.reporting.training_log import read_rows
from algorithms.runs.run_directory import METRICS_FILE, changed_files, read_status
from algorithms.studies.manifest import ManifestRow, label, read_manifest, value_text
from mo_deepdrive.evaluation import metrics
from mo_deepdrive.evaluation.front import EVALUATION_FILE
from mo_deepdrive.evaluation.metrics import EVALUATION, FRONT, POLICIES, STEP, UTILITY_ESR, MetricName, split_name
from mo_deepdrive.support.atomic_io import atomic_write, own_path

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from rich.console import Console

    from algorithms.reporting.curves import CurveGroup, VariedScores

FOLDER = "collected"
MAX_NAMED = 3  # runs that a message lists by name
SCORE_KEYS = MetricName._fields  # columns that identify a score of a run
SCORE_TYPES = dict.fromkeys(("run", *SCORE_KEYS), pl.String) | dict.fromkeys(("value", "low", "high"), pl.Float64)
RUN_TYPES = dict.fromkeys(("run", "directory", "cell"), pl.String) | {"trial": pl.Int64, "seed": pl.Int64}
RUN_TYPES |= {"state": pl.String, "step": pl.Int64, "rows": pl.Int64}
REST = "--output FILE.csv writes every metric"
ALGORITHM_KEYS = ("config", "algorithm", "algorithm.name")  # keys of cells that choose the algorithm
# Cells are ranked by the first of these metrics that the runs have.
DEFAULT_METRICS = (
    MetricName(metrics.GREEDY, "", UTILITY_ESR),
    MetricName(FRONT, "", metrics.HYPERVOLUME),
    MetricName(FRONT, "", metrics.EXPECTED_UTILITY),
    MetricName(metrics.STOCHASTIC, "", UTILITY_ESR),
)
MAX_CURVES = 8  # cells, as many as there are markers
TOTAL = "total"  # instead of a vehicle: the sum over all vehicles


# ------------------------------------------------------------------------------------------------------- data frames


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

    rows: tuple[ManifestRow, ...]
    runs: pl.DataFrame
    scores: pl.DataFrame
    metrics: pl.DataFrame

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """The cells, in the order of the manifest."""
        rows_by_cell: dict[tuple[int | None, str], list[ManifestRow]] = {}
        for row in self.rows:
            rows_by_cell.setdefault((row.trial, as_json(row.cell)), []).append(row)
        return tuple(Cell(rows[0].cell, rows[0].trial, tuple(rows)) for rows in rows_by_cell.values())

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
        warn(
            f"left out: {len(without)} of {len(rows)} runs have no final evaluation ({states}): {_first_of([*without])}"
        )
    if unreadable:
        warn(f"left out: {len(unreadable)} files cannot be read: {_first_of(unreadable)}")
    keys = dict.fromkeys(key for row in rows for key in row.cell)
    columns = (_key_column(key, [row.cell.get(key) for row in rows]) for key in keys)
    runs = pl.DataFrame(about, RUN_TYPES, orient="row").with_columns(columns)
    of_scores = pl.DataFrame(scores, SCORE_TYPES, orient="row").join(
        runs.drop("directory", "step", "rows"), on="run", how="left"
    )
    logs = pl.concat(logged, how="diagonal")
    logs = logs.select("run", STEP, *sorted({*logs.columns} - {"run", STEP}))
    try:
        for name, frame in (("metrics", logs), ("runs", runs), ("scores", of_scores)):
            buffer = io.BytesIO()
            # A reader skips row groups without the runs that it needs.
            frame.write_parquet(buffer, compression_level=1, row_group_size=10_000)
            file = own_path(sweep, f"{FOLDER}/{name}.parquet")
            file.parent.mkdir(exist_ok=True)
            atomic_write(file, buffer.getvalue())
    except OSError as error:
        warn(f"the collected results are not stored: {error}")
    return Collection(rows, runs, of_scores, logs)


def _key_column(key: str, values: Sequence[Any]) -> pl.Series:
    """A column of values of a varied key, in the narrowest type that holds them all; else as JSON."""
    types = {type(value) for value in values if value is not None}
    for allowed, kind in (({bool}, pl.Boolean), ({int}, pl.Int64), ({int, float}, pl.Float64), ({str}, pl.String)):
        if types <= allowed:
            return pl.Series(key, values, kind, strict=False)
    return pl.Series(key, [as_json(value) for value in values], pl.String)


def _first_of(names: Sequence[str]) -> str:
    """The first names, and the number of the others."""
    more = len(names) - MAX_NAMED
    return ", ".join([*names[:MAX_NAMED], *([f"and {more} more"] if more > 0 else [])])


def as_json(value: Any) -> str:
    """JSON with sorted keys: equal values have equal texts."""
    return json.dumps(value, sort_keys=True)


# ------------------------------------------------------------------------------------------------------------- tables


def print_sweep(
    sweep: Path,
    console: Console,
    warn: Callable[[str], None],
    *,
    metric: str | None = None,
    top: int = 20,
    columns: Sequence[str] | None = None,
) -> tuple[list[ScoreGroup], list[ScoreGroup]]:
    """Print the best cells and the first comparisons of algorithms; the scores of cells, and those of comparisons."""
    collection = collect(sweep, warn)
    if collection.scores.is_empty():
        hint = "mo-deepdrive plot draws what runs have logged"
        raise ValueError(f"no run of sweep {str(sweep)!r} has a final evaluation yet; {hint}")
    groups_by_ranking = [
        (ranking, group_cells(collection, ranking, columns))
        for ranking in rank(collection.cells, collection.scores, metric)
    ]
    all_groups = [group for _, groups in groups_by_ranking for group in groups]
    check_columns(all_groups, columns)
    to_compare: list[ScoreGroup] = []
    for ranking, groups in groups_by_ranking:
        # Those of one vehicle alone, that by which the ranking is sorted.
        vehicle = "" if ranking.place.vehicle == TOTAL else ranking.place.vehicle
        of_vehicle = [
            replace(group, scores={name: values for name, values in group.scores.items() if name.vehicle == vehicle})
            for group in groups
        ]
        to_compare += of_vehicle
        if ranking.ranked:
            shown = min(top, len(ranking.ranked))
            title = f"{ranking.title}: {shown} of {len(ranking.cells)} cells, by {ranking.score_name}"
            rows = best_cells(ranking, of_vehicle[:shown], columns)
            print_rows(console, rows, title, rows[0].index(ranking.place.metric), rest=REST)
        elif groups:
            warn(f"left out: no run has {metric or 'a utility or an indicator of a front'} in {ranking.title}")
    compared = comparison_table(to_compare)
    if len(compared) > 1:
        count = len(compared) - 1
        title = f"algorithms where nothing else differs: {min(top, count)} of {count} comparisons"
        print_rows(console, compared[: 1 + top], title, compared[0].index("mean"))
    console.print(interval_note(all_groups), highlight=False)
    return all_groups, to_compare


def group_cells(collection: Collection, ranking: Ranking, columns: Sequence[str] | None = None) -> list[ScoreGroup]:
    """The cells of a ranking that have final evaluations, in its order; with all metrics if columns are chosen."""
    ranked_by, column = ranking.place.metric, pl.col("metric")
    known = collection.scores.select("run", *SCORE_KEYS, "value")
    if columns is None:
        known = known.filter(column.is_in([*TABLE_METRICS, ranked_by]) | column.str.starts_with(metrics.RETURN))
    scores: dict[str, dict[MetricName, float]] = defaultdict(dict)
    for run, policy, vehicle, metric, value in pl.concat([known, totals(known.filter(metric=ranked_by))]).rows():
        # A total is in the row of all vehicles together if that has no such score itself.
        scores[run].setdefault(MetricName(policy, "" if vehicle == TOTAL else vehicle, metric), value)
    groups = []
    for cell in ranking.cells:
        texts = {key: value_text(value) for key, value in cell.keys.items()}
        task = {key: text for key, text in texts.items() if key not in ALGORITHM_KEYS}
        trial = {} if cell.trial is None else {"trial": str(cell.trial)}
        algorithm = cell.experiment.algorithm.name
        group = ScoreGroup({**trial, **texts}, task, algorithm, ranking.title, wanted=len(cell.rows))
        group.evaluation = cell.experiment.evaluation
        for row in (row for row in cell.rows if row.id in scores):
            group.seeds.append(row.seed)
            for place, value in scores[row.id].items():
                group.scores[place].append(value)
        groups += [group] if group.seeds else []
    return groups


def best_cells(ranking: Ranking, groups: Sequence[ScoreGroup], columns: Sequence[str] | None) -> Rows:
    """The first cells of a ranking for the terminal: short names of their keys, and the scores of one vehicle."""
    rows = scores_table(groups, list(dict.fromkeys([ranking.place.metric, *(columns or TABLE_COLUMNS)])))
    keys = short_names(varying_keys([cell.keys for cell in ranking.cells]))
    hidden = {"vehicle", *(key for cell in ranking.cells for key in cell.keys if key not in keys)}
    shown = [i for i, name in enumerate(rows[0]) if name not in hidden]
    body = [[row[i] for i in shown] for row in rows[1:]]
    return [[keys.get(rows[0][i], rows[0][i]) for i in shown], *body]


# ------------------------------------------------------------------------------------------------------------- ranking


class Ranking(NamedTuple):
    """Cells whose scores are comparable, ranked: same environment, utility, discount and reference point."""

    title: str
    place: MetricName  # by which they are ranked, all "" if no run has a score; the vehicle may be TOTAL
    cells: tuple[Cell, ...]  # best first, then those without a score
    ranked: tuple[float, ...]  # the means of the former
    scores: dict[str, float]  # by run id

    @property
    def score_name(self) -> str:
        """The score as text, such as "greedy total utility"."""
        return " ".join(filter(None, self.place)).removesuffix("_esr").replace("_", " ")


def rank(cells: Sequence[Cell], scores: pl.DataFrame, metric: str | None = None) -> list[Ranking]:
    """Group comparable cells and rank each group by a metric, whose policy and vehicle may be omitted."""
    comparable: dict[str, list[int]] = defaultdict(list)
    for i, cell in enumerate(cells):
        comparable[f"{cell.experiment.task_key} {cell.experiment.evaluation.split}"].append(i)
    finite = scores.select("run", *SCORE_KEYS, "value").filter(pl.col("value").is_finite())
    if metric is not None:
        places = sorted(finite.select(SCORE_KEYS).unique().rows())
        forms = (form for place in places for form in (place, place[1:], (place[0], place[2]), place[2:]))
        metrics.known_metric(metric, dict.fromkeys("/".join(filter(None, form)) for form in forms))
    candidates = [
        MetricName(policy, vehicle, given.metric)
        for given in (DEFAULT_METRICS if metric is None else (split_name(metric),))
        for policy in ([given.policy] if given.policy else POLICIES)
        for vehicle in ([given.vehicle] if given.vehicle else ["", TOTAL])
    ]
    runs = [(row.id, i) for i, cell in enumerate(cells) for row in cell.rows]
    cell_of_run = pl.DataFrame(runs, {"run": pl.String, "cell": pl.Int64}, orient="row")
    known = pl.concat([finite, totals(finite)]).join(cell_of_run, on="run")
    experiments = [cells[members[0]].experiment for members in comparable.values()]
    tasks = [
        {name: section or {} for name, section in experiment.task.items()} | {"split": experiment.evaluation.split}
        for experiment in experiments
    ]
    titles = distinct_labels([experiment.title for experiment in experiments], tasks)
    rankings = []
    for title, members in zip(titles, comparable.values(), strict=True):
        of_members = known.filter(pl.col("cell").is_in(members))
        by_name = of_members.partition_by(SCORE_KEYS, as_dict=True)
        place = next((place for place in candidates if place in by_name), MetricName("", "", ""))
        chosen = by_name.get(place, of_members.clear())
        descending = not metrics.lower_is_better(place.metric)
        means = chosen.group_by("cell").agg(pl.col("value").mean())
        means = means.sort("value", "cell", descending=[descending, False])
        best = means["cell"].to_list()
        ordered = [cells[i] for i in [*best, *(i for i in members if i not in best)]]
        by_run = dict(chosen.select("run", "value").rows())
        rankings.append(Ranking(title, place, tuple(ordered), tuple(means["value"]), by_run))
    return rankings


def totals(scores: pl.DataFrame) -> pl.DataFrame:
    """Sums over vehicles, per run, policy and metric; their vehicle is TOTAL. The columns are those of ``scores``."""
    of_vehicles = scores.filter(pl.col("vehicle") != "").with_columns(vehicle=pl.lit(TOTAL))
    return of_vehicles.group_by("run", *SCORE_KEYS).agg(pl.col("value").sum())


def varying_keys(cells: Sequence[Mapping[str, Any]]) -> list[str]:
    """The keys whose values differ between cells, in the order of the cells."""
    keys = dict.fromkeys(key for cell in cells for key in cell)
    return [key for key in keys if len({as_json(cell.get(key)) for cell in cells}) > 1]


def short_names(keys: Sequence[str]) -> dict[str, str]:
    """``learning_rate`` for ``algorithm.learning_rate``, unless another key has the same last part."""
    last = Counter(key.rpartition(".")[2] for key in keys)
    return {key: end if last[end := key.rpartition(".")[2]] == 1 else key for key in keys}


def value_labels(values: Sequence[Any]) -> list[str]:
    """Short texts of the values of a key; in full, as JSON, where two different values would look the same."""
    texts = {as_json(value): _short_text(value) for value in values}
    times = Counter(texts.values())
    return [code if times[texts[code]] > 1 else texts[code] for code in map(as_json, values)]


def _short_text(value: Any) -> str:
    """A section by its name, a number with four significant digits."""
    if isinstance(value, Mapping) and isinstance(value.get("name", value.get("id")), str):
        return str(value.get("name", value.get("id")))
    return f"{value:.4g}" if isinstance(value, float) else value_text(value)


def cell_labels(cells: Sequence[Cell], keys: Sequence[str]) -> list[str]:
    """Labels of cells by the values of some keys, such as ``mo_a2c_linear, learning_rate 0.001, steps 16``."""
    names = {**{key: f"{name} " for key, name in short_names(keys).items()}, "config": ""}
    values = {key: value_labels([cell.keys.get(key) for cell in cells]) for key in keys}
    labels = []
    for i, cell in enumerate(cells):
        parts = [] if cell.trial is None else [f"trial {cell.trial}"]
        parts += [names[key] + values[key][i] for key in keys]
        labels.append(", ".join(parts) or cell.experiment.algorithm.name)
    return labels


# ------------------------------------------------------------------------------------------------------------ figures


def plot_sweep(sweep: Path, output: Path, print_line: Callable[[str], None], warn: Callable[[str], None]) -> None:
    """Draw the best cells of a sweep, and into ``OUTPUT-cells`` the scores of all runs against each key that varies."""
    from algorithms.reporting.curves import describe, plot, plot_effects  # not earlier: tables need no matplotlib

    collection = collect(sweep, warn)
    if collection.metrics.is_empty():
        hint = f"mo-deepdrive sweep with --output {sweep} trains the runs"
        raise ValueError(f"no run of sweep {str(sweep)!r} has any metrics yet: {hint}")
    when, scores = collection.latest_scores()
    rankings = rank(collection.cells, scores)
    score = f"{when} {' or '.join(dict.fromkeys(ranking.score_name for ranking in rankings if ranking.scores))}"
    groups = best_curves(collection, rankings)
    count = len(collection.cells)
    left_out = count - len(groups)
    remark = f"the best {len(groups)} of {count} cells, by {score}; {left_out} left out" if left_out else ""
    plot(groups, output, remark)
    for line in [*describe(groups), *([remark] if remark else []), str(output)]:
        print_line(line)
    if varied := [effects for ranking in rankings if (effects := varied_scores(collection, ranking)).keys]:
        path = output.with_name(f"{output.stem}-cells{output.suffix}")
        plot_effects(varied, path, f"{sweep.resolve().name}: {score}")
        print_line(str(path))


def best_curves(collection: Collection, rankings: Sequence[Ranking]) -> list[CurveGroup]:
    """The curves of the best cells of every ranking, of runs that have a score; of several, evaluations alone."""
    from algorithms.reporting.curves import CurveGroup

    places = sorted((place, r) for r, ranking in enumerate(rankings) for place in range(len(ranking.ranked)))
    cells = [rankings[r].cells[place] for r, place in sorted((r, place) for place, r in places[:MAX_CURVES])]
    names = [name for name in collection.metrics.columns if name.startswith(EVALUATION) or len(cells) == 1]
    shown = collection.metrics.select("run", STEP, *sorted({*names} - {"run", STEP}))
    metrics_by_run = shown.partition_by("run", as_dict=True, include_key=False)
    runs = {run for ranking in rankings for run in ranking.scores}
    labels = cell_labels(cells, varying_keys([cell.keys for cell in collection.cells]))
    groups = []
    for name, cell in zip(labels, cells, strict=True):
        logged = [metrics_by_run[row.id,] for row in cell.rows if row.id in runs and (row.id,) in metrics_by_run]
        columns = ({column.name: column.to_numpy().astype(np.float64) for column in frame} for frame in logged)
        groups += [CurveGroup(name, cell.experiment, tuple(columns))] if logged else []
    return groups


def varied_scores(collection: Collection, ranking: Ranking) -> VariedScores:
    """The scores of a ranking's runs, and the values of each key that varies among them, in the manifest's order."""
    from algorithms.reporting.curves import VariedScores

    rows = [row for row in collection.rows if row.id in ranking.scores]
    algorithms = {row.id: cell.experiment.algorithm.name for cell in ranking.cells for row in cell.rows}
    values = {}
    for key, name in short_names(varying_keys([row.cell for row in rows])).items():
        given = [row.cell.get(key) for row in rows]
        numbers = all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in given)
        values[name] = np.array(given, dtype=np.float64) if numbers else value_labels(given)
    scores = np.array([ranking.scores[row.id] for row in rows])
    return VariedScores(ranking.title, ranking.score_name, scores, tuple(algorithms[row.id] for row in rows), values)
