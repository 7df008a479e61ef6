"""Which cells of a sweep are the best, among those that can be compared, and what people call them."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import polars as pl

from algorithms.experiments.config import EnvironmentSettings, UtilitySettings, find_environment, is_ours
from algorithms.sweeps.collection import PLACE, POLICIES, Cell, Place, as_json, split_place
from algorithms.sweeps.manifest import label
from mo_deepdrive.config import EnvConfig, nearest

# What cells are ranked by: the first that there is.
SCORES = ("greedy/utility_esr", "front/hypervolume", "front/expected_utility", "stochastic/utility_esr")
TOTAL = "total"  # in the place of a vehicle: the sum of all
LOWER_IS_BETTER = ("igd_plus", "additive_epsilon", "length", "mean_g_force", "max_g_force", "mean_jerk", "max_jerk")


@dataclass(frozen=True)
class Setting:
    """Cells whose scores can be compared: same environment, utility, discount and reference point.

    Attributes:
        title: environment and utility in words.
        policy, vehicle, metric: what the cells are ranked by; vehicle "" for one, or all together, and TOTAL for the
            sum of all; all three "" where no run has a score.
        cells: best first, then those without a score.
        scores: of every run that has one, by id.
    """

    title: str
    policy: str
    vehicle: str
    metric: str
    cells: tuple[Cell, ...]
    scores: dict[str, float]

    def score(self, cell: Cell) -> float | None:
        """The mean over the runs of a cell that have a score; None where none has."""
        known = [self.scores[row.id] for row in cell.rows if row.id in self.scores]
        return float(np.mean(known)) if known else None

    @property
    def ranked(self) -> list[Cell]:
        """The cells that have a score."""
        return [cell for cell in self.cells if self.score(cell) is not None]

    @property
    def what(self) -> str:
        """The score in words."""
        words = [self.policy, self.vehicle, self.metric.removesuffix("_esr")]
        return " ".join(filter(None, words)).replace("_", " ")

    def best_first(self) -> Setting:
        """The same with the best cells first."""
        sign = 1.0 if self.metric in LOWER_IS_BETTER or self.metric.startswith("end/") else -1.0

        def badness(cell: Cell) -> float:
            score = self.score(cell)
            return np.inf if score is None else sign * score

        return replace(self, cells=tuple(sorted(self.cells, key=badness)))


def rank(cells: Sequence[Cell], scores: pl.DataFrame, metric: str | None = None) -> list[Setting]:
    """Sort cells by a score, among those with which they can be compared.

    Args:
        cells: in any order.
        scores: with the columns run, policy, vehicle, metric and value.
        metric: "greedy/utility_esr", "stochastic/vehicle_0/success" and so on; without a policy the first of
            :data:`POLICIES` that has it; None for the first of :data:`SCORES` that there is.

    Raises:
        ValueError: if no run has the metric.
    """
    groups: dict[str, list[Cell]] = {}
    for cell in cells:
        groups.setdefault(_setting_key(cell.config), []).append(cell)
    wanted = [
        (each, whose, name)
        for policy, vehicle, name in map(split_place, [metric] if metric else SCORES)
        for each in ([policy] if policy else POLICIES)
        for whose in ([vehicle] if vehicle else ["", TOTAL])
    ]
    finite = scores.select("run", *PLACE, "value").filter(pl.col("value").is_finite())
    finite = pl.concat([finite, totals(finite)])
    settings = []
    for title, members in zip(_titles(list(groups.values())), groups.values(), strict=True):
        ids = [row.id for cell in members for row in cell.rows]
        place, known = _first(wanted, finite.filter(pl.col("run").is_in(ids)))
        settings.append(Setting(title, *place, tuple(members), known).best_first())
    if metric and not any(setting.scores for setting in settings):
        found = scores.select(PLACE).unique().sort(PLACE).rows()
        raise ValueError(
            f"metric {metric!r} is not among those of the final evaluations; "
            f"{nearest(metric, ['/'.join(filter(None, place)) for place in found])}"
        )
    return settings


def _first(wanted: Iterable[Place], scores: pl.DataFrame) -> tuple[Place, dict[str, float]]:
    """The first of some metrics that there is, and its values by run."""
    for place in wanted:
        found = scores.filter(**dict(zip(PLACE, place, strict=True)))
        if len(found):
            return place, dict(found.select("run", "value").iter_rows())
    return ("", "", ""), {}


def totals(scores: pl.DataFrame) -> pl.DataFrame:
    """The sums over the vehicles of what is known of each, per run, policy and metric; their vehicle is TOTAL.

    Args:
        scores: with the columns run, policy, vehicle, metric and value, as the result has them.
    """
    of_vehicles = scores.filter(pl.col("vehicle") != "").with_columns(vehicle=pl.lit(TOTAL))
    return of_vehicles.group_by("run", *PLACE).agg(pl.col("value").sum())


def _setting_key(config: Mapping[str, Any]) -> str:
    """What the experiments of two runs must share for their scores to be compared, as text."""
    evaluation = config["evaluation"]
    return as_json([config["environment"], config["utility"], evaluation["gamma"], evaluation["reference_point"]])


def _titles(groups: Sequence[Sequence[Cell]]) -> list[str]:
    """Environment and utility of each group of cells; where that is the same, the keys that tell the groups apart."""
    titles = [_title(cells[0].config) for cells in groups]
    differing = varying([cell.keys for cells in groups for cell in cells])
    result = []
    for title, cells in zip(titles, groups, strict=True):
        keys = cells[0].keys
        inside = varying([cell.keys for cell in cells])
        apart = {key: keys[key] for key in differing if key in keys and key not in inside}
        result.append(f"{title} ({label(apart)})" if titles.count(title) > 1 else title)
    return result


def _title(config: Mapping[str, Any]) -> str:
    utility = UtilitySettings(**config["utility"]) if config["utility"] else None
    labels = environment_label(EnvironmentSettings(**config["environment"])), utility_label(utility)
    return ", ".join(filter(None, labels))


def environment_label(settings: EnvironmentSettings) -> str:
    """The id, and the arguments that are not the default."""
    if not is_ours(find_environment(settings.id)):
        return settings.id
    defaults = {name: field.default for name, field in EnvConfig.model_fields.items()}
    changed = [f"{name}={value}" for name, value in settings.arguments.items() if value != defaults[name]]
    return " ".join([settings.id, *changed])


def utility_label(settings: UtilitySettings | None) -> str:
    """The name, and those of the vehicles that have another utility; nothing where none is known."""
    if settings is None:
        return ""
    return " ".join([settings.name, *(f"{vehicle}={own.name}" for vehicle, own in settings.vehicles.items())])


# --------------------------------------------------------------------------------------------------------------- words


def varying(cells: Sequence[Mapping[str, Any]]) -> list[str]:
    """The keys that do not have the same value in all of some cells, in the cells' order."""
    keys = dict.fromkeys(key for cell in cells for key in cell)
    return [key for key in keys if len({as_json(cell.get(key)) for cell in cells}) > 1]


def short_names(keys: Sequence[str]) -> dict[str, str]:
    """``algorithm.learning_rate`` as ``learning_rate``, where no other key ends so."""
    last = Counter(key.rpartition(".")[2] for key in keys)
    return {key: end if last[end := key.rpartition(".")[2]] == 1 else key for key in keys}


def as_text(value: Any) -> str:
    """The value of a key: words as they are, anything else as JSON."""
    return value if isinstance(value, str) else json.dumps(value)


def _shown(value: Any) -> str:
    """The value of a key for people: a section by its name, a number to four digits."""
    if isinstance(value, Mapping) and isinstance(value.get("name", value.get("id")), str):
        return str(value.get("name", value.get("id")))
    if isinstance(value, float):
        return f"{value:.4g}"
    return as_text(value)


def words(values: Sequence[Any]) -> list[str]:
    """Values of a key for people; as JSON where two would look the same otherwise."""
    texts = {as_json(value): _shown(value) for value in values}
    repeated = {text for text, times in Counter(texts.values()).items() if times > 1}
    return [code if texts[code] in repeated else texts[code] for code in map(as_json, values)]


def cell_labels(cells: Sequence[Cell], keys: Sequence[str]) -> list[str]:
    """``mo_a2c_linear, learning_rate 0.001, steps 16`` and so on.

    Args:
        cells: to be named.
        keys: that tell them apart.
    """
    names = {**{key: f"{name} " for key, name in short_names(keys).items()}, "config": ""}
    values = {key: words([cell.keys.get(key) for cell in cells]) for key in keys}
    labels = []
    for i, cell in enumerate(cells):
        parts = [] if cell.trial is None else [f"trial {cell.trial}"]
        parts += [names[key] + values[key][i] for key in keys]
        labels.append(", ".join(parts) or cell.config["algorithm"]["name"])
    return labels
