"""Bounds by searched rules in settings that may become tasks, as a table.

python scripts/bounds/rule_bounds.py V1 R3 --output docs/results/suite2_bounds.csv

A floor is the best rule that is blind to what the setting tests; rows of other settings stay in the file.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from algorithms.driving.intersection_rules import STRANGERS
from algorithms.runs import cli
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.support.atomic_io import atomic_write, csv_bytes
from mo_deepdrive.utilities import RISK_AVERSE, make_utility
from scripts.bounds.rule_search import (
    BLIND,
    ROUNDS,
    SEEING,
    Family,
    Objective,
    Setting,
    certainty_equivalent,
    mean_utility,
    measure,
    search,
    worst_family,
    worst_off,
)
from scripts.bounds.suite_bounds import ROUNDS_FOR_RISK, ROUNDS_IN_ROUNDABOUTS, ROUNDS_WITH_PARTNERS

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

HEAD = ["task", "kind", "value", "low", "high", "by", "episodes"]
AMONG = tuple(f"rule:drawn_{number}" for number in range(20))
ROUNDS_AMONG = ((48, 1), (12, 2), (4, 4))  # episodes with each of them
SATISFICING = "one_waypoint_satisficing"


class Search(NamedTuple):
    """A search, of a rule for one objective, and what is measured of it."""

    kind: str  # floor or rule
    family: Family
    objective: Objective  # that is searched for
    measured: dict[str, Objective]  # by what is added to the name of the setting


class Case(NamedTuple):
    """A setting with its searches."""

    setting: Setting
    searches: list[Search]
    rounds: Sequence[tuple[int, int]]
    episodes: int  # of the test split, with each partner


def cases() -> dict[str, Case]:
    """The settings by name."""
    return {
        "V1": _strangers(),
        "K4": _limits(),
        "K5": _risk(),
        "R3": _roundabout(AMONG, ROUNDS_AMONG, 25),
        "R4": _roundabout((), ROUNDS_IN_ROUNDABOUTS, 500),
    }


def _utility(name: str, setting: Setting) -> Any:
    return make_utility(name, EnvAdapter(make_env(setting.env_id, 1, dict(setting.arguments))).objectives)


def _strangers() -> Case:
    setting = Setting("mo-deepdrive-intersection-v1", {}, STRANGERS)
    utility = _utility("intersection_hurried", setting)
    mean, worst = mean_utility(utility), worst_family(utility, STRANGERS)
    searches = [
        search
        for kind, families in (("floor", BLIND), ("rule", SEEING))
        for search in (
            Search(kind, families["intersection"], mean, {"": mean, " (worst family of the best mean)": worst}),
            Search(kind, families["intersection"], worst, {" (worst family)": worst}),
        )
    ]
    return Case(setting, searches, ROUNDS_WITH_PARTNERS, 50)


def _limits() -> Case:
    setting = Setting("mo-deepdrive-one-waypoint-v1", {})
    utility, family = mean_utility(_utility(SATISFICING, setting)), SEEING["one_waypoint"]
    linear = mean_utility(_utility("one_waypoint_linear", setting))
    time = EnvAdapter(make_env(setting.env_id, 1, {})).objectives.index("time")
    fast = Objective(lambda met: met[0].returns[:, 0, time], np.mean)  # whoever does not arrive has 60 s
    searches = [
        Search("floor", family, fast, {" (driven for time alone)": utility}),
        Search("floor", family, linear, {" (driven for the linear utility)": utility}),
        Search("rule", family, utility, {"": utility}),
    ]
    return Case(setting, searches, ((1024, 8), *ROUNDS), 128)


def _risk() -> Case:
    name = "left_turn_hurried_risk_averse"
    setting = Setting("mo-deepdrive-left-turn-v1", {})
    certain = certainty_equivalent(_utility(name, setting), RISK_AVERSE[name])
    searches = [
        Search(kind, families["left_turn"], certain, {"": certain})
        for kind, families in (("floor", BLIND), ("rule", SEEING))
    ]
    return Case(setting, searches, ROUNDS_FOR_RISK, 1000)


def _roundabout(partners: tuple[str, ...], rounds: Sequence[tuple[int, int]], episodes: int) -> Case:
    """One among strangers, or the worst off of eight alike."""
    setting = Setting("mo-deepdrive-roundabout-v0", {"vehicles": 8}, partners)
    utility = _utility("roundabout_linear", setting)
    objective = mean_utility(utility) if partners else worst_off(utility)
    searches = [
        Search(kind, families["roundabout"], objective, {"": objective})
        for kind, families in (("floor", BLIND), ("rule", SEEING))
    ]
    return Case(setting, searches, rounds, episodes)


def compute(options: argparse.Namespace) -> int:
    """Search and measure, and write the rows in place of those that the file has of the same settings."""
    cli.check_file("--output", options.output)
    for name in options.settings:
        case, rows = cases()[name], []
        for each in case.searches:
            rule = search(case.setting, each.family, each.objective, case.rounds)
            for suffix, objective in each.measured.items():
                found = measure(case.setting, each.family, rule, objective, case.episodes)
                numbers = [f"{value:.4g}" for value in (found.value, found.low, found.high)]
                rows.append([name + suffix, each.kind, *numbers, each.family.name(rule), case.episodes])
                print(*rows[-1], sep=", ", flush=True)
        kept: list[list[Any]] = []
        if options.output.is_file():
            with options.output.open(encoding="utf-8", newline="") as stream:
                kept = [row for row in list(csv.reader(stream))[1:] if row[0].split(" ")[0] != name]
        atomic_write(options.output, csv_bytes([HEAD, *sorted(kept + rows, key=lambda row: row[0].split(" ")[0])]))
    return 0


OPTIONS = (
    cli.option("settings", "SETTING", "", nargs="+", choices=("V1", "K4", "K5", "R3", "R4")),
    cli.option("--output", "FILE", "CSV file", type=Path, required=True),
)
main = cli.Command("", __doc__, OPTIONS, compute)

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
