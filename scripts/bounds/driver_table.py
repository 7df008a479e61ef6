"""Drivers of a task of the suite side by side: those that its bounds are of, and trained runs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.driving.unskilled import unskilled_policies
from algorithms.runs.build import load_policy
from mo_deepdrive import suite
from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.evaluation.metrics import (
    GINI_UTILITY_ESR,
    MEAN_UTILITY_ESR,
    SHARE_ARRIVED,
    SHARE_COLLIDED,
    WORST_OFF_UTILITY_ESR,
)
from mo_deepdrive.evaluation.statistics import mean
from scripts.bounds.suite_bounds import TRIED_IN_ROUNDABOUTS, roundabout_rules

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from algorithms.runs.run_directory import Run
    from mo_deepdrive.evaluation.evaluation import Evaluation
    from mo_deepdrive.suite import Task

FLOOR, RULE, LEARNER = "floor", "rule", "learner"
RANDOM, STILL = "acts at random", "stands still"


Driver = tuple[str, str, int | None, Any]  # name, kind, seed of a run, policy


def bounds(task: Task) -> list[Driver]:
    """The drivers that the bounds of a task are of.

    The floors are standing still, acting at random, holding one action and the blind drivers; of the last two kinds,
    and of the rules, there is the one that is best on the validation split.
    """
    unskilled = unskilled_policies(task.config())
    found: list[Driver] = [(name, FLOOR, None, unskilled[name]) for name in (STILL, RANDOM)]
    for prefix, start in (("", "holds "), ("blind, ", "goes ")):
        name, policy = _best({name: policy for name, policy in unskilled.items() if name.startswith(start)}, task)
        found.append((prefix + name, FLOOR, None, policy))
    name, policy = _best(roundabout_rules(), task)
    return [*found, (name, RULE, None, policy)]


def drives_in(run: Run, task: Task) -> bool:
    """Whether the run has trained in the environment of the task."""
    trained_in = run.experiment.environment
    same = trained_in.id == task.environment.id
    return same and task.model_copy(update={"environment": trained_in}).config() == task.config()


def learner(run: Run) -> tuple[str, int, Any]:
    """Kind, seed and policy of the driver that a run has trained."""
    return LEARNER, run.experiment.training.seed, load_policy(run)


def driver_rows(task_id: str, drivers: Iterable[Driver], episodes: int) -> list[dict[str, Any]]:
    """A row per driver, each of ``episodes`` episodes of the test split; see :func:`measures`."""
    task = suite.load().task(task_id)
    rows = []
    for name, kind, seed, policy in drivers:
        about = {"task": task_id, "driver": name, "kind": kind, "seed": seed, "episodes": episodes}
        rows.append({**about, **measures(drive(policy, task, episodes, "test"))})
    return rows


def drive(policy: Any, task: Task, episodes: int, split: Any) -> Evaluation:
    """Episodes of a policy in the environment of a task; of agents those of the kind of policy that the task ranks."""
    learnt = hasattr(policy, "env")
    return evaluate(
        policy,
        task.environment.id,
        split=split,
        episodes=episodes,
        utility=task.make_utility(),
        env_kwargs=task.environment.arguments,
        greedy=not learnt or task.policy == "greedy",
    )


def measures(found: Evaluation) -> dict[str, float | None]:
    """Means over the episodes and over the vehicles of what is driven, with the ends of their 95% intervals.

    "arrived" and "collided" are shares of the vehicles, "utility" is that of a vehicle, "worst_off" the least of them
    and "gini" the sum that counts the worse-off for more; then come the returns of the objectives.
    """
    team = found.team_samples()
    samples: Mapping[str, Any] = {
        "arrived": team[SHARE_ARRIVED],
        "collided": team[SHARE_COLLIDED],
        "utility": team[MEAN_UTILITY_ESR],
        "worst_off": team[WORST_OFF_UTILITY_ESR],
        "gini": team[GINI_UTILITY_ESR],
        **{name: found.returns[:, :, i].mean(axis=1) for i, name in enumerate(found.objectives)},
    }
    values: dict[str, float | None] = {}
    for name, each in samples.items():
        estimate = mean(each)
        values |= {name: estimate.value, f"{name}/low": estimate.low, f"{name}/high": estimate.high}
    return values


def _best(candidates: Mapping[str, Any], task: Task) -> tuple[str, Any]:
    """The candidate whose vehicles have the highest mean utility on the validation split."""
    worth = {
        name: measures(drive(policy, task, TRIED_IN_ROUNDABOUTS, "validation"))["utility"]
        for name, policy in candidates.items()
    }
    name = max(worth, key=lambda each: worth[each] or -np.inf)
    return name, candidates[name]
