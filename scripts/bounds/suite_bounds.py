"""Floors and ceilings of the suite: scores of policies that need no skill, of planned drives and of rules.

Planned drives are the best that are found in scenarios of the test split, each of which is known.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import numpy as np

from algorithms.driving.roundabout_rules import ROUNDABOUTS
from algorithms.driving.unskilled import unskilled_policies
from mo_deepdrive import suite
from mo_deepdrive.evaluation.drives import Playback
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.fronts.reference_fronts import DATA, shipped
from mo_deepdrive.simulation.actions import decode_discrete
from mo_deepdrive.simulation.state import MAX_ACCELERATION, STEER_RANGE
from mo_deepdrive.suite.plans import planned, planned_actions, planned_scenarios
from mo_deepdrive.support.atomic_io import atomic_write
from mo_deepdrive.utilities import RISK_AVERSE
from mo_deepdrive.world.action_sequences import decode, encode
from mo_deepdrive.world.scenarios import SCENARIOS
from scripts.bounds.best_first_search import solve_scenario
from scripts.bounds.plans import CRITERIA, Criterion, EvaluatedPlans, PlanEvaluator, random_calm_rules
from scripts.bounds.rule_search import (
    BLIND,
    ROUNDS,
    SEEING,
    Family,
    Objective,
    Setting,
    certainty_equivalent,
    mean_over_vehicles,
    mean_utility,
    search,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

    from mo_deepdrive.suite import Task

# ---------------------------------------------------------------------------------------------------- search of plans

FIRST = 2048  # rules of the first generation
POPULATION = 1024  # plans of each later one
TAKEOVER_RATE = 0.05  # share of the offspring that a rule takes over
KEPT = 96  # best plans, divided among the utilities; at least LEAST_KEPT of each
LEAST_KEPT = 2
BLIND_POPULATION, BLIND_KEPT, BLIND_GENERATIONS = 256, 48, 25
UNDISCOUNTED = CRITERIA.index(Criterion(1.0, timed=True))


class UtilitySearch:
    """Searches for the best plan of a scenario under each of P utilities.

    A decomposition-based evolutionary algorithm in the manner of MOEA/D (Zhang and Li 2007): every utility keeps its
    best plans, and an offspring of any of them may improve any utility. Random driving rules make the first generation,
    and take over from some of the offspring later.

    The start of the evaluator is overwritten. The values map returns (n, d) to utilities (n, P); the returns are
    undiscounted, in the order of the evaluator's objectives with the time after them, of which ``unfinished`` seconds
    are charged unless the drive arrives.
    """

    def __init__(
        self,
        evaluator: PlanEvaluator,
        values: Callable[[NDArray[np.float64]], NDArray[np.float64]],
        unfinished: float,
        seed: int,
    ):
        self.evaluator = evaluator
        self._values = values
        self._unfinished = unfinished
        self._rng = np.random.default_rng(seed)
        self._destination = evaluator.batch.objectives.index("destination")

    def best(
        self, start: NDArray[Any], sequences: Sequence[NDArray[Any]], generations: int
    ) -> tuple[EvaluatedPlans, NDArray[np.float64]]:
        """The best plan for each utility and its value (P,), from ``start`` (1,) of VEHICLE and known sequences."""
        self.evaluator.batch.state[0] = start
        plan_format = self.evaluator.format
        idle = plan_format.to_sequence(plan_format.idle_plans(1)[0])
        kept = self.evaluator.evaluate(plan_format.from_sequences([idle, *sequences]), 0)
        kept = kept.append(self._ruled(plan_format.idle_plans(FIRST), np.zeros(FIRST)))
        kept, values = self._select(kept, self.values(kept))
        for _ in range(generations):
            parents, mates = self._rng.integers(len(kept.plans), size=(2, POPULATION))
            plans = self.evaluator.offspring(kept.plans, kept.lengths, parents, mates, self._rng)
            offspring = self._ruled(plans, self.evaluator.takeovers(kept.lengths[parents], TAKEOVER_RATE, self._rng))
            kept, values = self._select(kept.append(offspring), np.concatenate([values, self.values(offspring)]))
        best = values.argmax(axis=0)
        return kept.take(best), values.max(axis=0)

    def values(self, evaluated: EvaluatedPlans) -> NDArray[np.float64]:
        """The utilities (n, P) of plans."""
        returns = evaluated.returns[UNDISCOUNTED].copy()
        arrived = returns[:, self._destination] > 0.0
        returns[~arrived, -1] = -self._unfinished
        return self._values(returns)

    def _ruled(self, plans: NDArray[np.int16], first_decisions: NDArray[Any]) -> EvaluatedPlans:
        """The plans, in which random rules drive from the given decisions on."""
        rules = random_calm_rules(len(plans), self._rng)
        rules["first_decision"] = first_decisions
        return self.evaluator.evaluate(plans, 0, rules)

    def _select(
        self, evaluated: EvaluatedPlans, values: NDArray[np.float64]
    ) -> tuple[EvaluatedPlans, NDArray[np.float64]]:
        """The best plans of every utility, with their utilities; of those that are worth the same the first."""
        count = max(LEAST_KEPT, KEPT // values.shape[1])
        rows = set()
        for column in values.T:
            _, first = np.unique(-column, return_index=True)
            rows |= set(first[:count].tolist())
        chosen = np.array(sorted(rows))
        return evaluated.take(chosen), values[chosen]


def as_continuous(evaluator: PlanEvaluator, start: NDArray[Any], actions: NDArray[Any]) -> NDArray[np.float64]:
    """The continuous actions (t, 3) with the controls of discrete ones (t,), from ``start`` (1,) of VEHICLE on."""
    batch = evaluator.batch
    batch.state[0] = start
    controls, found = np.zeros((1, 1, 3)), []
    for action in actions:
        decode_discrete(batch.state, 0, 0, action, batch.table, controls)
        steer, throttle, brake = controls[0, 0]
        found.append((steer / STEER_RANGE, throttle / MAX_ACCELERATION, 2.0 * brake / MAX_ACCELERATION - 1.0))
        batch.step(np.full((1, 1), action))
    return np.clip(np.array(found), -1.0, 1.0)


def blind_plan(
    evaluator: PlanEvaluator,
    values: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    unfinished: float,
    starts: Sequence[NDArray[Any]],
    held: Sequence[NDArray[Any]],
) -> tuple[NDArray[Any], float]:
    """The actions that are worth most in the mean over scenarios, searched from ``held``, and what they are worth."""
    search = UtilitySearch(evaluator, values, unfinished, 0)
    plan_format, rng = evaluator.format, np.random.default_rng(0)
    plans = plan_format.from_sequences(held)
    kept, worth = plans[:0], np.zeros(0)
    for generation in range(BLIND_GENERATIONS + 1):
        if generation:
            parents, mates = rng.integers(len(kept), size=(2, BLIND_POPULATION))
            lengths = np.full(len(kept), plan_format.decisions)
            plans = evaluator.offspring(kept, lengths, parents, mates, rng)
        total = np.zeros(len(plans))
        for start in starts:
            evaluator.batch.state[0] = start
            total += search.values(evaluator.evaluate(plans.copy(), 0))
        kept, worth = np.concatenate([kept, plans]), np.concatenate([worth, total / len(starts)])
        _, rows = np.unique(-worth, return_index=True)
        kept, worth = kept[rows[:BLIND_KEPT]], worth[rows[:BLIND_KEPT]]
    return plan_format.to_sequence(kept[0]), float(worth[0])


# ------------------------------------------------------------------------------------------------------ planned drives

BEAM = 4096  # states that the best-first search simulates at a time
HORIZON = 30.0  # s; a planned drive arrives by then
SPARE = 32  # preferences that are drawn beyond those that are needed
NEARLY = 0.05  # a preference under which standing still is this close to the best is left out


class ScenarioPlanner:
    """Plans the scenarios of a task on an open road; a drive arrives within ``horizon`` seconds."""

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
        """The best drives found in a scenario, one per utility, and their utilities; from ``known`` discrete drives."""
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
    """The preferences that count where the best drives are worth ``best`` (P,), and those before that are left out."""
    spare = with_spare_preferences(task)
    assert spare.preferences is not None
    assert task.preferences is not None
    still = spare.hidden_weights()[:, spare.objectives().index("time")] * -spare.config().time_limit
    kept = np.flatnonzero(still < best - NEARLY)[: task.preferences.count]
    return kept, sorted(set(range(int(kept[-1]))) - set(kept.tolist()))


def plan_task(
    task: Task, seeds: Iterable[int], generations: int, horizon: float, known: str | None = None
) -> tuple[list[list[str]], NDArray[np.float64]]:
    """The texts of the best drives and their utilities (scenarios, P), from plans of the ``known`` discrete task."""
    planner = ScenarioPlanner(task, generations, horizon)
    drives, values = [], []
    for i, seed in enumerate(seeds):
        found, worth = planner.plan(seed, planned_actions(known, i) if known else ())
        drives.append([encode(actions) for actions in found])
        values.append(worth)
    return drives, np.array(values)


def write_plans(task_id: str, task: Task, texts: list[list[str]]) -> None:
    """Write the plans of a task where they are shipped: JSON, a scenario a line."""
    head = json.dumps({"action_type": task.config().action_type})[:-1]
    lines = ",\n".join(json.dumps(each) for each in texts)
    file = Path(str(DATA / f"plans_{task_id.lower()}.json"))
    atomic_write(file, f'{head}, "actions": [\n{lines}\n]}}\n'.encode())


# ------------------------------------------------------------------------------------------------- floors and ceilings

TRIED = 24  # episodes of the validation split by which policies without skill are compared
DRAWN = 32  # rules of a front
# Of a search: where a rare collision decides, with partners (episodes are of each of them), and where eight drive.
ROUNDS_FOR_RISK = ((128, 32), (32, 256), (8, 1024))
ROUNDS_WITH_PARTNERS = ((256, 2), (64, 6), (16, 24))
ROUNDS_IN_ROUNDABOUTS = ((128, 8), (32, 32), (8, 128))
BLIND_SCENARIOS = 16  # of the validation split, in which the best open-loop policy is searched


class Found(NamedTuple):
    """A bound: a score, and what earned it."""

    value: float
    by: str


def score_of(policy: Any, task_id: str, **options: Any) -> float:
    """The score of a policy on a task, without perturbations."""
    rows = suite.score(policy, task_id, perturbed=False, **options)
    return next(row.value for row in rows if row.column == "score" and row.value is not None)


def best_of(candidates: dict[str, Any], task_id: str) -> Found:
    """The candidate that is best on the validation split, with its score on the test split."""
    start = SPLITS["validation"].start
    name = max(candidates, key=lambda name: score_of(candidates[name], task_id, episodes=TRIED, first_episode=start))
    return Found(score_of(candidates[name], task_id), name)


def searched(family: Family, task: Task) -> tuple[str, Any]:
    """The best rule of a family for a task on the validation split: its name, and its policy of all vehicles."""
    utility, config = task.make_utility(), task.config()
    objective: Objective = mean_over_vehicles(utility)
    rounds = ROUNDS_IN_ROUNDABOUTS if config.scenario in ROUNDABOUTS else ROUNDS
    if task.score == "certainty_equivalent":
        risk = RISK_AVERSE[task.utility.name]  # type: ignore[union-attr]
        objective, rounds = certainty_equivalent(utility, risk), ROUNDS_FOR_RISK
    partners: tuple[str, ...] = ()
    if task.partners is not None:
        objective, rounds, partners = mean_utility(utility), ROUNDS_WITH_PARTNERS, tuple(task.partners.names)
    rule = search(Setting(task.environment.id, task.environment.arguments, partners), family, objective, rounds)
    return family.name(rule), family.policy(rule, config.action_type)


def searched_bound(family: Family, task_id: str) -> Found:
    """The best rule of a family, with its score on the test split."""
    name, policy = searched(family, suite.load().task(task_id))
    return Found(score_of(policy, task_id), name)


def floor(task_id: str) -> Found:
    """The floor of a task: the best policy that needs no skill; of unknown utilities, all of them as a front."""
    task = suite.load().task(task_id)
    candidates, blind = dict(unskilled_policies(task.config())), BLIND.get(task.config().scenario)
    if task.utility is None:
        candidates |= blind.drawn(DRAWN, task.config().action_type) if blind else {}
        policies = f"{len(candidates)} policies without skill"
        by = f"the front of {policies}" if task.preferences is None else f"the best of {policies}, for each preference"
        return Found(score_of(list(candidates.values()), task_id), by)
    scenario = SCENARIOS[task.config().scenario]
    if not scenario.lanes and not scenario.roads and not task.config().fixed_destination:
        candidates["the best open-loop policy"] = _blind(task)
    still = next(iter(candidates))  # which may be the best of the test split, if not of the other one
    found = [best_of(candidates, task_id), Found(score_of(candidates[still], task_id), still)]
    found += [searched_bound(blind, task_id)] if blind else []
    return max(found, key=lambda each: each.value)


def _blind(task: Task) -> Playback:
    """The best policy that sees the time alone; where every episode is the same it would be a plan."""
    config = task.config()
    env: Any = gymnasium.make(task.environment.id, disable_env_checker=True, **task.environment.arguments)
    starts = []
    for seed in SPLITS["validation"][:BLIND_SCENARIOS]:
        env.reset(seed=seed)
        starts.append(env.unwrapped.batch.state[0].copy())
    evaluator = PlanEvaluator(config.scenario, config.action_type, HORIZON)
    decisions = evaluator.format.decisions
    actions: list[Any] = list(range(len(evaluator.format.table)))
    if evaluator.format.continuous:
        actions = [np.array([s, a, -1.0]) for s in (-0.3, -0.1, 0.0, 0.1, 0.3) for a in (0.2, 0.5, 1.0)]
    held = [np.repeat(np.asarray(action)[None], decisions, axis=0) for action in actions]
    best, _ = blind_plan(evaluator, task.make_utility(), config.time_limit, starts, held)
    return Playback([best], config.action_type)


class PlannedForPreferences:
    """The planned drives of a task, told the preference as a learner is."""

    def __init__(self, task_id: str):
        task = suite.load().task(task_id)
        assert task.preferences is not None
        self._task_id = task_id
        self._weights = task.preferences.weights(task.objectives())

    def for_preference(self, weights: Any) -> Playback:
        """The drives that were planned for the nearest of the task's preferences."""
        nearest = int(np.abs(self._weights - weights).sum(axis=1).argmin())
        return planned(self._task_id, nearest)


def ceiling(task_id: str) -> Found:
    """The ceiling of a task."""
    task = suite.load().task(task_id)
    config = task.config()
    if task_id.startswith("K6"):
        calm = score_of(planned("K6-ESR"), "K6-ESR", episodes=1)
        x = 1.0 - calm
        if task_id == "K6-ESR":
            return Found(calm, f"1 - x, where x = {x:.4f} = J / 60 of the calmest drive that is known to arrive")
        return Found(1.0 / (1.0 + x), f"1 / (1 + x), x = {x:.4f}: the calmest drive with this probability, else none")
    if task_id == "U1":
        sequences = [decode(each.actions, config.action_type) for each in shipped(config.scenario, config.action_type)]
        front: list[Any] = [Playback([sequence], config.action_type) for sequence in sequences]
        return Found(score_of(front, task_id, episodes=1), f"the {len(front)} drives of the best-known front")
    if config.scenario in BLIND:
        family = SEEING[config.scenario]
        if task.preferences is None:
            return searched_bound(family, task_id)
        drawn = [each.drawn(DRAWN, config.action_type) for each in (BLIND[config.scenario], family)]
        front = [policy for policies in (unskilled_policies(config), *drawn) for policy in policies.values()]
        return Found(score_of(front, task_id), f"the best of {len(front)} rules for each preference")
    scenarios = planned_scenarios(task_id)
    policy = planned(task_id) if task.preferences is None else PlannedForPreferences(task_id)
    by = f"drives that were planned in the first {scenarios} scenarios of the test split"
    return Found(score_of(policy, task_id, episodes=scenarios), by)
