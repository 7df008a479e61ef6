"""The floors and ceilings of the suite, computed anew.

python scripts/bounds/suite.py plan K1 U2 --scenarios 100    # search for drives, and write them into the package
python scripts/bounds/suite.py bounds K1 V1 --output docs/results/suite2_bounds.csv

A floor is the best rule or learner that is blind to what the task tests. A ceiling is what was planned, or else the
best rule. Rows of other tasks stay in the file; mo_deepdrive/data/suite.yaml has the numbers, too.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import track

from algorithms.runs import cli
from mo_deepdrive import suite
from mo_deepdrive.evaluation.drives import Playback
from mo_deepdrive.evaluation.episodes import OUR_ENVS
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.evaluation.statistics import iqm, of_mean
from mo_deepdrive.suite.plans import planned, planned_actions, planned_scenarios
from mo_deepdrive.suite.scorers import open_drives
from mo_deepdrive.suite.tasks import DATA
from mo_deepdrive.support.atomic_io import atomic_write, csv_bytes
from mo_deepdrive.utilities import make_utility
from scripts.bounds.planning import ScenarioPlanner, plan_changes, plan_preferences, plan_utility, write_plans
from scripts.bounds.rule_search import (
    BLIND,
    DEADLINE,
    FOLLOWING,
    ROUNDS,
    SEEING,
    Family,
    Objective,
    objective_of,
    search,
    setting_of,
)

if TYPE_CHECKING:
    import argparse

HEAD = ["task", "kind", "column", "value", "low", "high", "by"]
RESULTS = Path("docs/results/suite2_bounds.csv")
LEARNERS = Path("docs/results/suite.csv")
FLOOR, RULE, CEILING = "floor", "rule", "ceiling"
# Rules of the rounds of a search, and their episodes (with each partner): many where a rare collision decides.
ROUNDS_BY_TASK = {
    "K5": ((128, 32), (32, 256), (8, 1024)),
    "V1": ((256, 2), (64, 6), (16, 24)),
    "R3": ((48, 1), (12, 2), (4, 4)),
    "R5": ((16, 32), (8, 128), (4, 500)),
}
CHANGES_OF = {"U4": "U2"}  # whose preferences change
# Learners that are blind to what a task tests.
BLIND_LEARNERS = {
    "K3": ("lintune", "accrued_blind"),
    "K4": ("lintune",),
    "U2": ("one_policy",),
    "U4": ("one_policy", "first_alone"),
}
# Rules that are known from elsewhere.
KNOWN = {
    "K5": (SEEING["left_turn"], (4.5, 3.5, 6.5, 9.0, 0.73, 0.0)),
    "R3": (SEEING["roundabout"], (2.5, 4.2, 4.3, 5.5, 0.9)),
    "R5": (SEEING["roundabout"], (4.5, 4.2, 5.0, 6.0, 0.9)),
}


class Search(NamedTuple):
    """A search of a rule."""

    kind: str
    family: Family
    objective: Objective


def searches(task_id: str) -> list[Search]:
    """The searches of rules for a task."""
    task = suite.load().task(task_id)
    own, scenario = objective_of(task), task.config().scenario
    if task_id == "K4":
        linear = make_utility("one_waypoint_linear", task.objectives())
        fast = make_utility("linear", task.objectives(), weights={"time": 1.0})
        blind = [Search(FLOOR, FOLLOWING, objective_of(task, utility)) for utility in (fast, linear)]
        return [*blind, Search(RULE, FOLLOWING, own)]
    if task_id == "smoke":
        return []
    if task_id in ("K1", "K3"):
        return [Search(FLOOR, FOLLOWING, own), *([Search(RULE, DEADLINE, own)] if task_id == "K3" else [])]
    pairs = ((FLOOR, BLIND), (RULE, SEEING))
    return [Search(kind, families[scenario], own) for kind, families in pairs if scenario in families]


def scored(task_id: str, kind: str, by: str, policy: Any, episodes: int | None = None) -> list[list[Any]]:
    """The rows of a policy: its score on the test split, and further columns."""
    rows = suite.score(policy, task_id, perturbed=False, episodes=episodes)
    return [[task_id, kind, row.column, row.value, row.low, row.high, by] for row in rows if row.low is not None]


class ForPreferences:
    """The planned drives of a task, told the preference as a learner is."""

    def __init__(self, task_id: str):
        self._task_id, self._told = task_id, suite.load().task(task_id).told_weights()

    def for_preference(self, weights: Any) -> Playback:
        """The drives that were planned for the nearest of the task's preferences."""
        return planned(self._task_id, int(np.abs(self._told - weights).sum(axis=1).argmin()))


def changed(task_id: str, of: str) -> Any:
    """(E, P) what the drives ``of`` a task with P preferences are worth, each of which gives way to the next one."""
    task = suite.load().task(task_id)
    weights, times = task.hidden_weights(), task.preferences.change_times()  # type: ignore[union-attr]
    with open_drives(task, {}, SPLITS["test"].start, planned_scenarios(task_id), greedy=True) as drives:
        pairs = zip(weights, np.roll(weights, -1, axis=0), times, strict=True)
        followed = [
            drives.changing(playback := planned(of, p), playback, np.stack([before, after]), time)
            for p, (before, after, time) in enumerate(pairs)
        ]
    return np.stack(followed, axis=1)


def worth_of_plans(task_id: str) -> Any:
    """(E, 1) the utility of the planned drive of each scenario, of as many at a time as can be replayed."""
    parts: list[Any] = []
    start = SPLITS["test"].start
    for first in range(0, planned_scenarios(task_id), OUR_ENVS):
        samples: suite.Samples = {}
        count = min(OUR_ENVS, planned_scenarios(task_id) - first)
        options = {"perturbed": False, "first_episode": start + first, "episodes": count, "samples": samples}
        suite.score(planned(task_id, first=first), task_id, **options)  # type: ignore[arg-type]
        parts += samples.values()
    return np.concatenate(parts)


def learnt(task_id: str) -> list[list[Any]]:
    """The rows of learners that are blind to what a task tests, of those that have results.

    The best policies are sought: a seed that fails does not lower the floor, nor one that is lucky raise it.
    """
    by_learner: dict[str, list[float]] = {name: [] for name in BLIND_LEARNERS.get(task_id, ())}
    policy = suite.load().task(task_id).policy
    for row in suite.read_rows(LEARNERS):
        of_score = (row.task, row.policy, row.column) == (task_id, policy, "score")
        if of_score and row.value is not None and row.learner in by_learner:
            by_learner[row.learner].append(row.value)
    rows = []
    for name, scores in by_learner.items():
        if scores:
            found = iqm(np.array(scores))
            by = f"{name}, interquartile mean of {len(scores)} seeds"
            rows.append([task_id, FLOOR, "score", found.value, found.low, found.high, by])
    return rows


def bounds(task_id: str) -> list[list[Any]]:
    """The rows of a task."""
    task, rows = suite.load().task(task_id), learnt(task_id)
    blind = RULE if rows else FLOOR  # of plans that are blind to what is tested, but not to the scenario
    if task.preferences is not None and task_id in CHANGES_OF:
        first = CHANGES_OF[task_id]
        drives = {blind: (first, "keeps the first preference"), CEILING: (task_id, "planned again from the change on")}
        for kind, (of, by) in drives.items():
            found = of_mean(changed(task_id, of).mean(axis=1, keepdims=True), lambda means: means[..., 0])
            rows.append([task_id, kind, "score", found.value, found.low, found.high, by])
        return rows
    if task.preferences is not None:
        by, mean = "planned for the mean of the preferences", planned(task_id, task.preferences.count)
        rows += scored(task_id, blind, by, mean, planned_scenarios(task_id))
        return rows + scored(task_id, CEILING, "planned for each", ForPreferences(task_id), planned_scenarios(task_id))
    rules = [
        (
            each.kind,
            each.family,
            search(setting_of(task), each.family, each.objective, ROUNDS_BY_TASK.get(task_id, ROUNDS)),
        )
        for each in searches(task_id)
    ]
    if task_id in KNOWN:
        rules.append((RULE, KNOWN[task_id][0], np.array(KNOWN[task_id][1])))
    for kind, family, rule in rules:
        rows += scored(task_id, kind, family.name(rule), family.policy(rule, task.config().action_type))
    if not rules:
        rows += scored(task_id, FLOOR, "stands still", Playback([np.zeros(0, dtype=np.int64)], "discrete"))
    if task.ceiling.kind == "planned":
        found = of_mean(worth_of_plans(task_id), lambda means: means[..., 0])
        rows.append([task_id, CEILING, "score", found.value, found.low, found.high, "planned"])
    return rows


def shipped(task_id: str) -> int:
    """In how many scenarios a task has planned drives."""
    return planned_scenarios(task_id) if (DATA / f"plans_{task_id.lower()}.json").is_file() else 0


def plan(task_id: str, options: argparse.Namespace) -> None:
    """Search for the drives of a task, from those that it has, and write them."""
    task = suite.load().task(task_id)
    planner = ScenarioPlanner(task, options.generations, options.population, options.horizon)
    seeds = SPLITS["test"][: options.scenarios]
    known = [planned_actions(task_id, i) if i < shipped(task_id) else [] for i in range(options.scenarios)]
    if task.preferences is not None and task_id not in CHANGES_OF:
        drives, left_out = plan_preferences(task, planner, seeds, known)
        print(f"{task_id}: preferences: count: {len(drives[0]) - 1}, left_out: {left_out}", flush=True)
    else:
        progress = track(seeds, "planning", console=Console(stderr=True))
        of = CHANGES_OF.get(task_id)
        drives = plan_changes(task, planner, progress, of) if of else plan_utility(task, planner, progress, known)
    write_plans(task_id, drives)


def compute(options: argparse.Namespace) -> int:
    """Do what is asked for, for every task."""
    cli.check_at_least(options, 1, "scenarios", "generations", "population", "horizon")
    if options.what == "plan":
        for task_id in options.tasks:
            plan(task_id, options)
        return 0
    cli.check_file("--output", options.output)
    for task_id in options.tasks:
        rows = [[f"{cell:.4g}" if isinstance(cell, float) else cell for cell in row] for row in bounds(task_id)]
        for row in rows:
            print(*row, sep=", ", flush=True)
        others: list[list[Any]] = []
        if options.output.is_file():
            with options.output.open(encoding="utf-8", newline="") as stream:
                others = [row for row in list(csv.reader(stream))[1:] if row[0] != task_id]
        atomic_write(options.output, csv_bytes([HEAD, *sorted(others + rows, key=lambda row: row[0])]))
    return 0


OPTIONS = (
    cli.option("what", None, "", choices=("plan", "bounds")),
    cli.option("tasks", "TASK", "", nargs="+", choices=suite.load().tasks),
    cli.option("--scenarios", "N", "of the test split, that are planned (default: %(default)s)", type=int, default=128),
    cli.option("--generations", "N", "of a search of plans (default: %(default)s)", type=int, default=20),
    cli.option("--population", "N", "plans of a generation (default: %(default)s)", type=int, default=1024),
    cli.option("--horizon", "S", "s of a planned drive (default: %(default)s)", type=float, default=30.0),
    cli.option("--output", "FILE", "CSV file (default: %(default)s)", type=Path, default=RESULTS),
)
main = cli.Command("", __doc__, OPTIONS, compute)

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
