"""Rank the cells of a sweep by a score, and label them for tables and figures."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import polars as pl

from algorithms.experiments.config import EnvironmentSettings, UtilitySettings, find_environment, is_ours
from algorithms.sweeps.collection import POLICIES, SCORE_KEYS, Cell, ScoreKey, as_json, split_score_name
from algorithms.sweeps.manifest import label
from mo_deepdrive.config import EnvConfig, nearest

# Cells are ranked by the first of these metrics that the runs have.
DEFAULT_METRICS = ("greedy/utility_esr", "front/hypervolume", "front/expected_utility", "stochastic/utility_esr")
TOTAL = "total"  # instead of a vehicle: the sum over all vehicles
LOWER_IS_BETTER = ("igd_plus", "additive_epsilon", "length", "mean_g_force", "max_g_force", "mean_jerk", "max_jerk")


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
        sign = 1.0 if self.metric in LOWER_IS_BETTER or self.metric.startswith("end/") else -1.0

        def badness(cell: Cell) -> float:
            score = self.score(cell)
            return np.inf if score is None else sign * score

        return replace(self, cells=tuple(sorted(self.cells, key=badness)))


def rank(cells: Sequence[Cell], scores: pl.DataFrame, metric: str | None = None) -> list[Ranking]:
    """Group comparable cells and rank each group by a score.

    Args:
        cells: in any order.
        scores: with the columns run, policy, vehicle, metric and value.
        metric: such as "greedy/utility_esr" or "stochastic/vehicle_0/success"; without a policy, the first of
            :data:`POLICIES` that has the metric; None for the first of :data:`DEFAULT_METRICS` that the runs have.

    Raises:
        ValueError: if no run has the metric.
    """
    groups: dict[str, list[Cell]] = {}
    for cell in cells:
        groups.setdefault(_comparison_key(cell.config), []).append(cell)
    wanted = [
        (each, whose, name)
        for policy, vehicle, name in map(split_score_name, [metric] if metric else DEFAULT_METRICS)
        for each in ([policy] if policy else POLICIES)
        for whose in ([vehicle] if vehicle else ["", TOTAL])
    ]
    finite = scores.select("run", *SCORE_KEYS, "value").filter(pl.col("value").is_finite())
    finite = pl.concat([finite, totals(finite)])
    rankings = []
    for title, members in zip(_titles(list(groups.values())), groups.values(), strict=True):
        ids = [row.id for cell in members for row in cell.rows]
        key, known = _first(wanted, finite.filter(pl.col("run").is_in(ids)))
        rankings.append(Ranking(title, *key, tuple(members), known).sorted_best_first())
    if metric and not any(ranking.scores for ranking in rankings):
        found = scores.select(SCORE_KEYS).unique().sort(SCORE_KEYS).rows()
        raise ValueError(
            f"metric {metric!r} is not a metric of the final evaluations; "
            f"{nearest(metric, ['/'.join(filter(None, key)) for key in found])}"
        )
    return rankings


def _first(wanted: Iterable[ScoreKey], scores: pl.DataFrame) -> tuple[ScoreKey, dict[str, float]]:
    """The first of ``wanted`` that some run has, and its values by run."""
    for key in wanted:
        found = scores.filter(**dict(zip(SCORE_KEYS, key, strict=True)))
        if len(found):
            return key, dict(found.select("run", "value").iter_rows())
    return ("", "", ""), {}


def totals(scores: pl.DataFrame) -> pl.DataFrame:
    """Sums over vehicles, per run, policy and metric; their vehicle is TOTAL.

    Args:
        scores: with the columns run, policy, vehicle, metric and value, like the result.
    """
    of_vehicles = scores.filter(pl.col("vehicle") != "").with_columns(vehicle=pl.lit(TOTAL))
    return of_vehicles.group_by("run", *SCORE_KEYS).agg(pl.col("value").sum())


def _comparison_key(config: Mapping[str, Any]) -> str:
    """A text that is equal for experiments whose scores are comparable."""
    evaluation = config["evaluation"]
    return as_json([config["environment"], config["utility"], evaluation["gamma"], evaluation["reference_point"]])


def _titles(groups: Sequence[Sequence[Cell]]) -> list[str]:
    """Environment and utility of each group of cells; equal titles also get the keys that differ."""
    titles = [_title(cells[0].config) for cells in groups]
    differing = varying_keys([cell.keys for cells in groups for cell in cells])
    result = []
    for title, cells in zip(titles, groups, strict=True):
        keys = cells[0].keys
        inside = varying_keys([cell.keys for cell in cells])
        distinguishing = {key: keys[key] for key in differing if key in keys and key not in inside}
        result.append(f"{title} ({label(distinguishing)})" if titles.count(title) > 1 else title)
    return result


def _title(config: Mapping[str, Any]) -> str:
    utility = UtilitySettings(**config["utility"]) if config["utility"] else None
    labels = environment_label(EnvironmentSettings(**config["environment"])), utility_label(utility)
    return ", ".join(filter(None, labels))


def environment_label(settings: EnvironmentSettings) -> str:
    """The id, and the arguments that differ from the defaults."""
    if not is_ours(find_environment(settings.id)):
        return settings.id
    defaults = {name: field.default for name, field in EnvConfig.model_fields.items()}
    changed = [f"{name}={value}" for name, value in settings.arguments.items() if value != defaults[name]]
    return " ".join([settings.id, *changed])


def utility_label(settings: UtilitySettings | None) -> str:
    """The name, followed by the vehicles with a different utility; "" if the utility is unknown."""
    if settings is None:
        return ""
    return " ".join([settings.name, *(f"{vehicle}={own.name}" for vehicle, own in settings.vehicles.items())])


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
        labels.append(", ".join(parts) or cell.config["algorithm"]["name"])
    return labels
