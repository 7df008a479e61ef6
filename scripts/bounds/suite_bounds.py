"""Floors and ceilings of the suite: scores of policies that need no skill, of planned drives and of rules."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from algorithms.driving.intersection_rules import make_rule
from algorithms.driving.left_turn_rules import GapDriver, GapRule
from algorithms.driving.roundabout_rules import ROUNDABOUTS, RoundaboutDriver, RoundaboutRule
from algorithms.driving.unskilled import unskilled_policies
from mo_deepdrive import suite
from mo_deepdrive.evaluation.drives import Playback
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.fronts.reference_fronts import shipped
from mo_deepdrive.suite.plans import planned, planned_scenarios
from mo_deepdrive.world.action_sequences import decode
from mo_deepdrive.world.scenarios import SCENARIOS
from scripts.bounds.plan_evaluation import PlanEvaluator
from scripts.bounds.suite_plans import HORIZON
from scripts.bounds.utility_search import blind_plan

if TYPE_CHECKING:
    from mo_deepdrive.suite import Task

TRIED = 24  # episodes of the validation split by which candidates are compared
TRIED_WITH_PARTNERS = 16  # of each partner
TRIED_FOR_RISK = 600  # where a rare collision decides
TRIED_IN_ROUNDABOUTS = 100
BLIND_SCENARIOS = 16  # of the validation split, in which the best open-loop policy is searched
GAPS = (4.25, 4.5, 4.75, 5.0)  # s, of rules for the left turn
SPEEDS = ((2.8, 6.0, 8.0), (3.5, 6.5, 9.0), (2.0, 5.0, 6.0))  # m/s, of the approach, in the crossing and after it
FRONT_GAPS = (2.0, 3.0, 4.0, 4.5, 5.0, 6.0, 8.0)  # s, of the front of rules
ENTRY_GAPS = (2.5, 3.0, 3.5, 4.5)  # s, of rules for the roundabout
ROUNDABOUT_SPEEDS = ((4.2, 4.0, 4.5), (4.2, 4.3, 5.5), (3.5, 3.7, 4.2))  # m/s, before, inside, after
MEETING_GAPS = (4, 5, 6, 7, 8, 10)  # s, of rules for the intersection


@dataclass(frozen=True)
class Found:
    """A bound.

    Attributes:
        value: the score.
        by: what earned it.
    """

    value: float
    by: str


def score_of(policy: Any, task_id: str, **options: Any) -> float:
    """The score of a policy on a task, without perturbations."""
    rows = suite.score(policy, task_id, perturbed=False, **options)
    return next(row.value for row in rows if row.column == "score" and row.value is not None)


def best_of(candidates: dict[str, Any], task_id: str) -> Found:
    """The candidate that is best on the validation split, with its score on the test split."""
    task = suite.load().task(task_id)
    tried = TRIED_WITH_PARTNERS if task.partners else TRIED
    tried = TRIED_FOR_RISK if task.score == "certainty_equivalent" else tried
    tried = TRIED_IN_ROUNDABOUTS if task.config().scenario in ROUNDABOUTS else tried
    start = SPLITS["validation"].start
    worth = {
        name: score_of(policy, task_id, episodes=tried, first_episode=start) for name, policy in candidates.items()
    }
    name = max(worth, key=lambda each: worth[each])
    return Found(score_of(candidates[name], task_id), name)


def floor(task_id: str) -> Found:
    """The floor of a task: the best policy that needs no skill; of unknown utilities, all of them as a front."""
    task = suite.load().task(task_id)
    candidates = dict(unskilled_policies(task.config()))
    if task.utility is None:
        by = f"the best of {len(candidates)} policies without skill, for each preference"
        by = f"the front of {len(candidates)} policies without skill" if task.preferences is None else by
        return Found(score_of(list(candidates.values()), task_id), by)
    scenario = SCENARIOS[task.config().scenario]
    if not scenario.lanes and not scenario.roads and not task.config().fixed_destination:
        candidates["the best open-loop policy"] = _blind(task)
    still = next(iter(candidates))  # which may be the best of the test split, if not of the other one
    found = best_of(candidates, task_id)
    return max(found, Found(score_of(candidates[still], task_id), still), key=lambda each: each.value)


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
        front = [Playback([sequence], config.action_type) for sequence in sequences]
        return Found(score_of(front, task_id, episodes=1), f"the {len(front)} drives of the best-known front")
    if task.partners is not None:
        return best_of(
            {f"the rule that waits for a gap of {gap} s": meeting_rule(gap) for gap in MEETING_GAPS}, task_id
        )
    if config.scenario == "left_turn":
        if task.preferences is not None:
            rules: list[Any] = [*unskilled_policies(config).values(), *left_turn_rules(FRONT_GAPS).values()]
            return Found(score_of(rules, task_id), f"the best of {len(rules)} rules for each preference")
        return best_of(left_turn_rules(GAPS), task_id)
    if config.scenario in ROUNDABOUTS:
        return best_of(roundabout_rules(), task_id)
    scenarios = planned_scenarios(task_id)
    policy = planned(task_id) if task.preferences is None else PlannedForPreferences(task_id)
    by = f"drives that were planned in the first {scenarios} scenarios of the test split"
    return Found(score_of(policy, task_id, episodes=scenarios), by)


def left_turn_rules(gaps: Any) -> dict[str, GapDriver]:
    """Rules for the left turn by name: every gap with every set of speeds."""
    found = {}
    for gap in gaps:
        for approach, turn, leave in SPEEDS:
            rule = GapRule(gap=gap, approach_speed=approach, turn_speed=turn, exit_speed=leave)
            name = f"the rule that waits for a gap of {gap:g} s and drives at {approach:g}, {turn:g} and {leave:g} m/s"
            found[name] = GapDriver(rule)
    return found


def roundabout_rules() -> dict[str, RoundaboutDriver]:
    """Rules for the roundabout by name: every gap with every set of speeds."""
    found = {}
    for gap in ENTRY_GAPS:
        for approach, inside, leave in ROUNDABOUT_SPEEDS:
            rule = RoundaboutRule(gap=gap, approach_speed=approach, inside_speed=inside, exit_speed=leave)
            speeds = f"{approach:g}, {inside:g} and {leave:g} m/s"
            found[f"the rule that enters with a gap of {gap:g} s and drives at {speeds}"] = RoundaboutDriver(rule)
    return found


def meeting_rule(gap: float) -> Any:
    """The rule of vehicle 0 at the intersection that waits for a gap, as a function of all vehicles' observations."""
    driver = make_rule(f"rule:gap_{gap:g}", "discrete")

    def policy(observations: Any, *_: Any) -> Any:
        return np.stack([driver(observations[:, 0])] * observations.shape[1], axis=1)

    return policy
