"""The tables of a sweep: its cells, the best first, and comparisons of algorithms where nothing else differs."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from typing import TYPE_CHECKING

import polars as pl

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
from algorithms.studies.sweep_collection import SCORE_KEYS, Collection, collect
from algorithms.studies.sweep_ranking import (
    TOTAL,
    Ranking,
    rank,
    short_names,
    totals,
    value_labels,
    value_text,
    varying_keys,
)
from mo_deepdrive.evaluation.metrics import RETURN, MetricName

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from rich.console import Console

REST = "--output FILE.csv writes every metric"
ALGORITHM_KEYS = ("config", "algorithm", "algorithm.name")  # keys of cells that choose the algorithm


def print_sweep(
    sweep: Path,
    console: Console,
    warn: Callable[[str], None],
    *,
    metric: str | None = None,
    top: int = 20,
    columns: Sequence[str] | None = None,
) -> tuple[list[ScoreGroup], list[ScoreGroup]]:
    """Print the best cells of a sweep and the first comparisons of algorithms.

    Args:
        sweep: its directory.
        console: where to print.
        warn: called with a message about everything that is left out.
        metric: to sort by; None for the utility or the hypervolume.
        top: cells to print of each table, and comparisons.
        columns: beside the metric to sort by; None for :data:`algorithms.reporting.tables.TABLE_COLUMNS`.

    Returns:
        The scores of all cells, and those by which they are compared.

    Raises:
        ValueError: if it is not a sweep, or an empty one, or no run has a final evaluation, the metric or a column.
    """
    collection = collect(sweep)
    collection.report_problems(warn)
    if not collection.scored:
        raise ValueError(
            f"no run of sweep {str(sweep)!r} has a final evaluation yet; mo-deepdrive plot draws what runs have logged"
        )
    scores = collection.scores.collect()
    all_groups: list[ScoreGroup] = []
    to_compare: list[ScoreGroup] = []
    ranked = [(each, group_cells(collection, each, columns)) for each in rank(collection.cells, scores, metric)]
    check_columns([group for _, groups in ranked for group in groups], columns)
    for ranking, groups in ranked:
        all_groups += groups
        to_compare += [_ranked_scores(ranking, group) for group in groups]
        if ranking.ranked:
            shown = min(top, len(ranking.ranked))
            title = f"{ranking.title}: {shown} of {len(ranking.cells)} cells, by {ranking.score_name}"
            rows = best_cells(ranking, groups, top, columns or TABLE_COLUMNS)
            print_rows(console, rows, title, rows[0].index(ranking.metric), rest=REST)
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
    column = pl.col("metric")
    usual = column.is_in([*TABLE_METRICS, ranking.metric]) | column.str.starts_with(RETURN)
    wanted = collection.scores.filter(usual if columns is None else pl.lit(True))
    known = wanted.select("run", *SCORE_KEYS, "value").collect()
    scores: dict[str, dict[MetricName, float]] = defaultdict(dict)
    for run, policy, vehicle, metric, value in pl.concat([known, totals(known.filter(metric=ranking.metric))]).rows():
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
        for row in cell.rows:
            if row.id in collection.scored:
                group.seeds.append(row.seed)
                for place, value in scores[row.id].items():
                    group.scores[place].append(value)
        groups += [group] if group.seeds else []
    return groups


def _ranked_scores(ranking: Ranking, group: ScoreGroup) -> ScoreGroup:
    """A group with the scores of one vehicle alone, that by which its ranking is sorted."""
    vehicle = "" if ranking.vehicle == TOTAL else ranking.vehicle
    return replace(group, scores={name: values for name, values in group.scores.items() if name.vehicle == vehicle})


def best_cells(
    ranking: Ranking, groups: Sequence[ScoreGroup], top: int, metrics: Sequence[str] = TABLE_COLUMNS
) -> Rows:
    """The best cells of a ranking for the terminal: short names of their keys, and the scores of one vehicle.

    Args:
        ranking: the cells.
        groups: their scores, in the same order.
        top: cells at most.
        metrics: the columns after the metric of the ranking.
    """
    cells = ranking.ranked[:top]
    keys = varying_keys([cell.keys for cell in ranking.cells])
    columns = {name: value_labels([cell.keys.get(key) for cell in cells]) for key, name in short_names(keys).items()}
    brief = []
    for i, group in enumerate(groups[: len(cells)]):
        trial = {name: text for name, text in group.about.items() if name == "trial"}
        names = {name: texts[i] for name, texts in columns.items()}
        brief.append(replace(_ranked_scores(ranking, group), about={**trial, **names}))
    rows = scores_table(brief, [ranking.metric, *(name for name in metrics if name != ranking.metric)])
    return [[cell for name, cell in zip(rows[0], row, strict=True) if name != "vehicle"] for row in rows]
