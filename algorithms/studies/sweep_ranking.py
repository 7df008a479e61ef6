"""Rank the cells of a sweep by a score, and label them for tables and figures."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import polars as pl

from algorithms.studies.sweep_collection import SCORE_KEYS, Cell, as_json
from algorithms.studies.sweep_manifest import label
from mo_deepdrive.evaluation.metrics import (
    EXPECTED_UTILITY,
    FRONT,
    GREEDY,
    HYPERVOLUME,
    POLICIES,
    STOCHASTIC,
    UTILITY_ESR,
    MetricName,
    known_metric,
    lower_is_better,
    split_name,
)

# Cells are ranked by the first of these metrics that the runs have.
DEFAULT_METRICS = (
    MetricName(GREEDY, "", UTILITY_ESR),
    MetricName(FRONT, "", HYPERVOLUME),
    MetricName(FRONT, "", EXPECTED_UTILITY),
    MetricName(STOCHASTIC, "", UTILITY_ESR),
)
TOTAL = "total"  # instead of a vehicle: the sum over all vehicles


@dataclass(frozen=True)
class Ranking:
    """Cells whose scores are comparable, ranked: same environment, utility, discount and reference point.

    Attributes:
        title: environment and utility as text.
        policy, vehicle, metric: the score that the cells are ranked by. The vehicle is "" for one vehicle, or all
            together, and TOTAL for the sum over vehicles; all three are "" if no run has a score.
        cells: best first, then those without a score.
        scores: by run id.
    """

    title: str
    policy: str
    vehicle: str
    metric: str
    cells: tuple[Cell, ...]
    scores: dict[str, float]

    def score(self, cell: Cell) -> float | None:
        """The mean score of a cell's runs; None if none of them has a score."""
        known = [self.scores[row.id] for row in cell.rows if row.id in self.scores]
        return float(np.mean(known)) if known else None

    @property
    def ranked(self) -> list[Cell]:
        """The cells with a score, best first."""
        return [cell for cell in self.cells if self.score(cell) is not None]

    @property
    def score_name(self) -> str:
        """The score as text, such as "greedy total utility"."""
        words = [self.policy, self.vehicle, self.metric.removesuffix("_esr")]
        return " ".join(filter(None, words)).replace("_", " ")

    def sorted_best_first(self) -> Ranking:
        """The ranking with its cells sorted."""
        sign = 1.0 if lower_is_better(self.metric) else -1.0

        def sort_key(cell: Cell) -> float:
            score = self.score(cell)
            return np.inf if score is None else sign * score

        return replace(self, cells=tuple(sorted(self.cells, key=sort_key)))


def rank(cells: Sequence[Cell], scores: pl.DataFrame, metric: str | None = None) -> list[Ranking]:
    """Group comparable cells and rank each group by a score.

    Args:
        cells: in any order.
        scores: with the columns run, policy, vehicle, metric and value.
        metric: such as "greedy/utility_esr" or "stochastic/vehicle_0/success"; without a policy, the first of
            :data:`mo_deepdrive.evaluation.metrics.POLICIES` that has the metric; None for the first of
            :data:`DEFAULT_METRICS` that the runs have.

    Raises:
        ValueError: if no run has the metric, as :func:`check_metric`.
    """
    groups: dict[str, list[Cell]] = {}
    for cell in cells:
        experiment = cell.experiment
        groups.setdefault(f"{experiment.task_key} {experiment.evaluation.split}", []).append(cell)
    finite = scores.select("run", *SCORE_KEYS, "value").filter(pl.col("value").is_finite())
    if metric is not None:
        check_metric(metric, finite)
    wanted = [
        MetricName(policy, vehicle, given.metric)
        for given in (DEFAULT_METRICS if metric is None else (split_name(metric),))
        for policy in ([given.policy] if given.policy else POLICIES)
        for vehicle in ([given.vehicle] if given.vehicle else ["", TOTAL])
    ]
    finite = pl.concat([finite, totals(finite)])
    rankings = []
    for title, members in zip(_titles(list(groups.values())), groups.values(), strict=True):
        ids = [row.id for cell in members for row in cell.rows]
        name, known = _first(wanted, finite.filter(pl.col("run").is_in(ids)))
        rankings.append(Ranking(title, *name, tuple(members), known).sorted_best_first())
    return rankings


def check_metric(metric: str, scores: pl.DataFrame) -> None:
    """Check that some run has a metric; its policy and vehicle may be omitted.

    Args:
        metric: such as "greedy/vehicle_0/success".
        scores: with the columns policy, vehicle and metric.

    Raises:
        ValueError: as :func:`mo_deepdrive.evaluation.metrics.known_metric`.
    """
    places = scores.select(SCORE_KEYS).unique().sort(SCORE_KEYS).rows()
    names = ["/".join(filter(None, place)) for place in places]
    shortened = {
        "/".join(filter(None, parts))
        for policy, vehicle, name in places
        for parts in ((vehicle, name), (policy, name), (name,))
    }
    if metric not in shortened:
        known_metric(metric, names)


def _first(wanted: Iterable[MetricName], scores: pl.DataFrame) -> tuple[MetricName, dict[str, float]]:
    """The first of ``wanted`` that some run has, and its values by run."""
    for name in wanted:
        found = scores.filter(**name._asdict())
        if len(found):
            return name, dict(found.select("run", "value").iter_rows())
    return MetricName("", "", ""), {}


def totals(scores: pl.DataFrame) -> pl.DataFrame:
    """Sums over vehicles, per run, policy and metric; their vehicle is TOTAL.

    Args:
        scores: with the columns run, policy, vehicle, metric and value, like the result.
    """
    of_vehicles = scores.filter(pl.col("vehicle") != "").with_columns(vehicle=pl.lit(TOTAL))
    return of_vehicles.group_by("run", *SCORE_KEYS).agg(pl.col("value").sum())


def _titles(groups: Sequence[Sequence[Cell]]) -> list[str]:
    """Environment and utility of each group of cells; equal titles also get the keys that differ."""
    titles = [cells[0].experiment.title for cells in groups]
    differing = varying_keys([cell.keys for cells in groups for cell in cells])
    result = []
    for title, cells in zip(titles, groups, strict=True):
        keys = cells[0].keys
        inside = varying_keys([cell.keys for cell in cells])
        distinguishing = {key: keys[key] for key in differing if key in keys and key not in inside}
        result.append(f"{title} ({label(distinguishing)})" if titles.count(title) > 1 else title)
    return result


# -------------------------------------------------------------------------------------------------------------- labels


def varying_keys(cells: Sequence[Mapping[str, Any]]) -> list[str]:
    """The keys whose values differ between cells, in the order of the cells."""
    keys = dict.fromkeys(key for cell in cells for key in cell)
    return [key for key in keys if len({as_json(cell.get(key)) for cell in cells}) > 1]


def short_names(keys: Sequence[str]) -> dict[str, str]:
    """``learning_rate`` for ``algorithm.learning_rate``, unless another key has the same last part."""
    last = Counter(key.rpartition(".")[2] for key in keys)
    return {key: end if last[end := key.rpartition(".")[2]] == 1 else key for key in keys}


def value_text(value: Any) -> str:
    """The value of a key as text: strings as they are, anything else as JSON."""
    return value if isinstance(value, str) else json.dumps(value)


def _short_text(value: Any) -> str:
    """The value of a key as short text: a section by its name, a number with four significant digits."""
    if isinstance(value, Mapping) and isinstance(value.get("name", value.get("id")), str):
        return str(value.get("name", value.get("id")))
    if isinstance(value, float):
        return f"{value:.4g}"
    return value_text(value)


def value_labels(values: Sequence[Any]) -> list[str]:
    """Short texts of the values of a key; in full, as JSON, where two different values would look the same."""
    texts = {as_json(value): _short_text(value) for value in values}
    repeated = {text for text, times in Counter(texts.values()).items() if times > 1}
    return [code if texts[code] in repeated else texts[code] for code in map(as_json, values)]


def cell_labels(cells: Sequence[Cell], keys: Sequence[str]) -> list[str]:
    """Labels of cells, such as ``mo_a2c_linear, learning_rate 0.001, steps 16``.

    Args:
        cells: to label.
        keys: whose values the labels show.
    """
    names = {**{key: f"{name} " for key, name in short_names(keys).items()}, "config": ""}
    values = {key: value_labels([cell.keys.get(key) for cell in cells]) for key in keys}
    labels = []
    for i, cell in enumerate(cells):
        parts = [] if cell.trial is None else [f"trial {cell.trial}"]
        parts += [names[key] + values[key][i] for key in keys]
        labels.append(", ".join(parts) or cell.experiment.algorithm.name)
    return labels
