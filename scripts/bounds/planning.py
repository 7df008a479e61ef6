"""Planned drives: the best that are found in scenarios of the test split, each of which is known.

The search is a decomposition-based evolutionary algorithm in the manner of MOEA/D (Zhang and Li 2007): every utility
keeps its best plans, and an offspring of any of them may improve any utility. Random driving rules make the first
generation, and take over from some of the offspring later.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import numpy as np

from mo_deepdrive.simulation.state import RUNNING
from mo_deepdrive.suite.plans import planned_actions
from mo_deepdrive.suite.tasks import DATA
from mo_deepdrive.support.atomic_io import atomic_write
from mo_deepdrive.world.action_sequences import encode
from scripts.bounds.plans import CRITERIA, Criterion, EvaluatedPlans, PlanEvaluator, random_calm_rules

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

    from mo_deepdrive.suite import Task

    Floats = NDArray[np.float64]
    Values = Callable[[Floats], Floats]  # of returns (n, d), in P utilities (n, P)
    Drives = list[list[NDArray[Any]]]  # actions (t,), by scenario and preference

TAKEOVER_RATE = 0.05  # share of the offspring that a rule takes over
KEPT = 96  # best plans, divided among the utilities; at least LEAST_KEPT of each
LEAST_KEPT = 2
UNDISCOUNTED = CRITERIA.index(Criterion(1.0))
DRAWN = 64  # preferences, of which those are kept that are worth knowing
GAIN = 0.1  # of utility, by which knowing such a preference is worth it


class Planned(NamedTuple):
    """The best drives for P utilities."""

    actions: list[NDArray[Any]]  # (t,) each
    returns: Floats  # (P, d)


class ScenarioPlanner:
    """Plans scenarios of a task on an open road with discrete actions; a drive arrives within ``horizon`` seconds.

    Each of ``generations`` has ``population`` plans, the first one twice as many.
    """

    def __init__(self, task: Task, generations: int = 20, population: int = 1024, horizon: float = 30.0):
        config = task.config()
        self._generations, self._population = generations, population
        self._env: Any = gymnasium.make(task.environment.id, disable_env_checker=True, **task.environment.arguments)
        shorter = {"time_limit": horizon, "charge_remaining_time": False}
        self._evaluator = PlanEvaluator(config.model_copy(update=shorter))
        self._destination, self._time = (task.objectives().index(name) for name in ("destination", "time"))
        self._decisions, self._frequency = config.max_decisions, config.decision_frequency

    def start(self, seed: int) -> NDArray[Any]:
        """The scenario (1,) of VEHICLE of a seed."""
        self._env.reset(seed=seed)
        return np.array(self._env.unwrapped.batch.state[0])

    def after(self, start: NDArray[Any], actions: NDArray[Any]) -> NDArray[Any]:
        """The state (1,) of VEHICLE to which actions (t,) lead from a start."""
        batch = self._evaluator.batch
        batch.state[0] = start
        for action in actions:
            batch.step(np.full((1, 1), action))
        return np.array(batch.state[0])

    def plan(self, start: NDArray[Any], values: Values, known: Sequence[NDArray[Any]] = (), seed: int = 0) -> Planned:
        """The best drives that are found from a state on, among them ``known`` ones."""
        rng, plan_format = np.random.default_rng(seed), self._evaluator.format
        self._evaluator.batch.state[0] = start
        first, nothing = 2 * self._population, np.zeros(0, dtype=np.int64)
        kept = self._evaluator.evaluate(plan_format.from_sequences([nothing, *known]), 0)
        kept = kept.append(self._ruled(plan_format.idle_plans(first), np.zeros(first), rng))
        kept, worth = self._select(kept, values(self._returns(kept)))
        for _ in range(self._generations):
            parents, mates = rng.integers(len(kept.plans), size=(2, self._population))
            plans = self._evaluator.offspring(kept.plans, kept.lengths, parents, mates, rng)
            takeovers = self._evaluator.takeovers(kept.lengths[parents], TAKEOVER_RATE, rng)
            offspring = self._ruled(plans, takeovers, rng)
            joined = np.concatenate([worth, values(self._returns(offspring))])
            kept, worth = self._select(kept.append(offspring), joined)
        best = kept.take(worth.argmax(axis=0))
        return Planned([plan_format.to_sequence(plan) for plan in best.plans], self._returns(best))

    def _returns(self, evaluated: EvaluatedPlans) -> Floats:
        """(n, d) undiscounted returns, charged all the time that is left where the drive does not arrive."""
        returns = evaluated.returns[UNDISCOUNTED].copy()
        left = self._decisions - int(self._evaluator.batch.state["decisions"][0, 0])
        returns[returns[:, self._destination] == 0.0, self._time] = -left / self._frequency
        return returns

    def _ruled(self, plans: NDArray[np.int16], first_decisions: Floats, rng: np.random.Generator) -> EvaluatedPlans:
        """The plans, in which random rules drive from the given decisions on."""
        rules = random_calm_rules(len(plans), rng)
        rules["first_decision"] = first_decisions
        return self._evaluator.evaluate(plans, 0, rules)

    def _select(self, evaluated: EvaluatedPlans, worth: Floats) -> tuple[EvaluatedPlans, Floats]:
        """The best plans of every utility, with their utilities; of those that are worth the same the first."""
        count = max(LEAST_KEPT, KEPT // worth.shape[1])
        rows = set()
        for column in worth.T:
            _, first = np.unique(-column, return_index=True)
            rows |= set(first[:count].tolist())
        chosen = np.array(sorted(rows))
        return evaluated.take(chosen), worth[chosen]


def plan_utility(task: Task, planner: ScenarioPlanner, seeds: Iterable[int], known: Drives) -> Drives:
    """The best drive in each scenario for the utility of a task, from ``known`` ones."""
    utility = task.make_utility()

    def values(returns: Floats) -> Floats:
        return np.asarray(utility(returns))[:, None]

    return [
        planner.plan(planner.start(seed), values, drives, seed).actions
        for seed, drives in zip(seeds, known, strict=True)
    ]


def plan_preferences(
    task: Task, planner: ScenarioPlanner, seeds: Sequence[int], known: Drives
) -> tuple[Drives, list[int]]:
    """The best drives in each scenario for every preference that is kept and, the last one, for their mean; from known.

    Beside them those of DRAWN preferences that are left out: the mean's drives are worth nearly as much under them.
    """
    assert task.preferences is not None
    drawn = task.preferences.model_copy(update={"left_out": [], "count": DRAWN}).weights(task.objectives())
    starts = [planner.start(seed) for seed in seeds]
    own = [
        planner.plan(start, lambda returns: returns @ drawn.T, drives)
        for start, drives in zip(starts, known, strict=True)
    ]
    worth = np.mean([(each.returns * drawn).sum(axis=1) for each in own], axis=0)
    kept, worth_knowing = np.arange(DRAWN), np.ones(DRAWN, dtype=np.bool_)
    while True:
        kept = kept[worth_knowing[kept]]
        mean = drawn[kept].mean(axis=0)
        blind = [
            planner.plan(start, lambda returns, mean=mean: returns @ mean[:, None], each.actions)  # type: ignore[misc]
            for start, each in zip(starts, own, strict=True)
        ]
        worth_knowing = worth - np.mean([drawn @ each.returns[0] for each in blind], axis=0) >= GAIN
        if worth_knowing[kept].all() or not worth_knowing[kept].any():
            break
    drives = [[*(each.actions[k] for k in kept), *of_mean.actions] for each, of_mean in zip(own, blind, strict=True)]
    return drives, sorted(set(range(int(kept[-1]))) - set(kept.tolist()))


def plan_changes(task: Task, planner: ScenarioPlanner, seeds: Iterable[int], of: str) -> Drives:
    """The best drive in each scenario for every preference that gives way to the next one, which it does not foresee.

    Until the change it is the one that was planned for the task ``of``, which has the same preferences.
    """
    assert task.preferences is not None
    weights = task.hidden_weights()
    changes = np.rint(task.preferences.change_times() * task.config().decision_frequency).astype(int)
    drives: Drives = []
    for i, seed in enumerate(seeds):
        start, changed = planner.start(seed), []
        for p, change in enumerate(changes):
            actions = planned_actions(of, i)[p]
            before = np.concatenate([actions[:change], np.zeros(max(0, change - len(actions)), dtype=np.int64)])
            state, after = planner.after(start, before), weights[(p + 1) % len(weights)]
            if state["end"][0] == RUNNING:
                rest = planner.plan(state, lambda returns, w=after: returns @ w[:, None], [actions[change:]])  # type: ignore[misc]
                actions = np.concatenate([before, *rest.actions])
            changed.append(actions)
        drives.append(changed)
    return drives


def write_plans(task_id: str, drives: Drives) -> None:
    """Write the drives of a task where they are shipped: JSON, a scenario a line."""
    lines = ",\n".join(json.dumps([encode(actions) for actions in scenario]) for scenario in drives)
    file = Path(str(DATA / f"plans_{task_id.lower()}.json"))
    atomic_write(file, f'{{"action_type": "discrete", "actions": [\n{lines}\n]}}\n'.encode())
