"""Plans for the suite: the best drives that are found in scenarios of the test split, each of which is known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

import mo_deepdrive
from mo_deepdrive.fronts.reference_fronts import shipped
from mo_deepdrive.suite.plans import planned_actions
from mo_deepdrive.support.atomic_io import atomic_write
from mo_deepdrive.world.action_sequences import decode, encode
from scripts.bounds.best_first_search import solve_scenario
from scripts.bounds.plan_evaluation import PlanEvaluator
from scripts.bounds.utility_search import UtilitySearch, as_continuous

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from mo_deepdrive.suite import Task

BEAM = 4096  # states that the best-first search simulates at a time
HORIZON = 30.0  # s; a planned drive arrives by then
SPARE = 32  # preferences that are drawn beyond those that are needed
NEARLY = 0.05  # a preference under which standing still is this close to the best is left out


def plan_file(task_id: str) -> Path:
    """Where the plans of a task are shipped."""
    return Path(mo_deepdrive.__file__).parent / "data" / f"plans_{task_id.lower()}.json"


class ScenarioPlanner:
    """Plans the scenarios of a task on an open road.

    Args:
        task: with a utility or preferences.
        generations: of every search.
        horizon: seconds by which a drive arrives.
    """

    def __init__(self, task: Task, generations: int, horizon: float):
        config = task.config()
        self.task = task
        self.generations = generations
        self.env: Any = gymnasium.make(task.environment.id, disable_env_checker=True, **task.environment.arguments)
        self.evaluator = PlanEvaluator(config.scenario, config.action_type, horizon)
        self.discrete = PlanEvaluator(config.scenario, "discrete", horizon)
        self._values = self._value_function(task)
        self._time_limit = config.time_limit

    def _value_function(self, task: Task) -> Any:
        if tuple(task.objectives()) != (*self.evaluator.batch.objectives, "time"):
            raise ValueError(f"the objectives of {task.title!r} must be those of its scenario, and time")
        if task.preferences is not None:
            weights = task.hidden_weights()
            return lambda returns: returns @ weights.T
        utility = task.make_utility()
        return lambda returns: np.asarray(utility(returns))[:, None]

    def plan(self, seed: int, known: Sequence[NDArray[Any]] = ()) -> tuple[list[NDArray[Any]], NDArray[np.float64]]:
        """The best drives found in the scenario of ``seed``, one per utility, and their utilities.

        Args:
            seed: by which the environment is reset.
            known: drives of discrete actions from which the search starts, in place of one that it looks for.
        """
        self.env.reset(seed=seed)
        start = self.env.unwrapped.batch.state[0].copy()
        search = UtilitySearch(self.evaluator, self._values, self._time_limit, seed)
        best, values = search.best(start, self._first_drives(start, known), self.generations)
        return [self.evaluator.format.to_sequence(plan) for plan in best.plans], values

    def _first_drives(self, start: NDArray[Any], known: Sequence[NDArray[Any]]) -> list[NDArray[Any]]:
        """Drives from which the search starts, besides those of rules: past the bicycle, if there is one."""
        found = [actions for actions in known if len(actions)]
        if self.task.config().fixed_destination:
            name, action_type = self.evaluator.batch.scenario.name, self.discrete.batch.config.action_type
            found += [decode(each.actions, action_type) for each in shipped(name, action_type)]
        if not found and self.evaluator.batch.scenario.obstacles:
            actions = solve_scenario(start, BEAM)
            found = [np.array(actions, dtype=np.int64)] if actions else []
        if self.evaluator.format.continuous:
            return [as_continuous(self.discrete, start, actions) for actions in found]
        return found


def with_spare_preferences(task: Task) -> Task:
    """The task with all preferences that are drawn, and more of them, before some are left out."""
    if task.preferences is None:
        return task
    spare = {"count": task.preferences.count + SPARE, "left_out": []}
    return task.model_copy(update={"preferences": task.preferences.model_copy(update=spare)})


def worth_driving(task: Task, best: NDArray[np.float64]) -> tuple[NDArray[np.int64], list[int]]:
    """The preferences of :func:`with_spare_preferences` that count, and those before them that are left out.

    Args:
        task: the task as it is in the suite.
        best: (P,) what the best drives are worth, in the mean over scenarios.
    """
    spare = with_spare_preferences(task)
    assert spare.preferences is not None
    assert task.preferences is not None
    still = spare.hidden_weights()[:, spare.objectives().index("time")] * -spare.config().time_limit
    kept = np.flatnonzero(still < best - NEARLY)[: task.preferences.count]
    return kept, sorted(set(range(int(kept[-1]))) - set(kept.tolist()))


def plan_task(
    task: Task, seeds: Iterable[int], generations: int, horizon: float, known: str | None = None
) -> tuple[list[list[str]], NDArray[np.float64]]:
    """The texts of the best drives by scenario and utility, and their utilities (scenarios, P).

    Args:
        task: on an open road.
        seeds: of the scenarios, the first ones of the test split.
        generations: of every search.
        horizon: seconds by which a drive arrives.
        known: the id of a task with discrete actions and the same scenarios, from whose plans the search starts.
    """
    planner = ScenarioPlanner(task, generations, horizon)
    drives, values = [], []
    for i, seed in enumerate(seeds):
        found, worth = planner.plan(seed, planned_actions(known, i) if known else ())
        drives.append([encode(actions) for actions in found])
        values.append(worth)
    return drives, np.array(values)


def write_plans(file: Path, task: Task, texts: list[list[str]]) -> None:
    """Write the plans of a task: JSON, a scenario a line."""
    head = json.dumps({"action_type": task.config().action_type})[:-1]
    lines = ",\n".join(json.dumps(each) for each in texts)
    atomic_write(file, f'{head}, "actions": [\n{lines}\n]}}\n'.encode())
