"""The explorer's page of trained runs and of best-known fronts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import moocore
import numpy as np

from algorithms.common.env_adapter import EnvAdapter, make_env
from algorithms.evaluation.drives import PlanDriver, PoliciesDriver, is_drivable, record_scenes
from algorithms.evaluation.front import Front, best_known_front
from algorithms.experiments.config import find_environment
from algorithms.experiments.policy_evaluation import evaluate_front_policies
from algorithms.reporting.explorer.explorable_front import ExplorableFront
from mo_deepdrive import reference_fronts
from mo_deepdrive.action_sequences import decode, discounted_sum, idle, replay
from mo_deepdrive.objectives import signs
from mo_deepdrive.scenarios import SCENARIOS
from mo_deepdrive.utilities import COMFORT_BUDGETS, NONLINEAR, ComfortBudget

if TYPE_CHECKING:
    from algorithms.agent import FrontAgent
    from algorithms.experiments.config import Experiment

SCENARIOS_SHOWN = 3  # of a front whose episodes differ
BEST_KNOWN = "best-known/"  # before the name of a best-known front


def explorable(
    agent: FrontAgent,
    front: Front,
    experiment: Experiment,
    *,
    episodes: int,
    seed: int,
    title: str,
    command: str,
) -> ExplorableFront:
    """The front of a trained agent with new episodes of all its policies, as ``mo-deepdrive choose`` drives them.

    Args:
        agent: has learnt the front.
        front: its policies.
        experiment: its environment.
        episodes: of each policy; one is driven where all are the same.
        seed: of the first episode, and of the first scenario that is shown.
        title: of the front.
        command: as of :class:`ExplorableFront`.
    """
    evaluations = evaluate_front_policies(agent, front, experiment, episodes=episodes, seed=seed)
    returns = np.stack([each.returns[:, 0] for each in evaluations])
    env_id, arguments = experiment.environment.id, experiment.environment.arguments
    env = make_env(env_id, 1, arguments)
    try:
        cost_signs = _signs(env, front.objectives)
        best_known = best_known_front(env, 1.0)
    finally:
        env.close()
    driven, scenes = returns.shape[1], []
    if is_drivable(env_id):
        seeds = range(seed, seed + min(driven, SCENARIOS_SHOWN))
        conditions = np.tile(np.asarray(front.conditions, dtype=np.float32), (len(seeds), 1))
        driver = PoliciesDriver(agent.policies(conditions), len(conditions))
        scenes = record_scenes(driver, env_id, arguments, seeds=seeds, drives=len(front))
    name, budget = _budget(find_environment(env_id).kwargs.get("scenario"), front.objectives)
    arrived = np.array([each.succeeded[:, 0].mean() for each in evaluations])
    how = f"{driven} episodes of each policy" if driven > 1 else "every episode is the same, so one is driven"
    return ExplorableFront(
        title=title,
        objectives=front.objectives,
        returns=returns,
        scales=np.asarray(agent.scales, dtype=np.float64),
        signs=cost_signs,
        success=np.where(np.isfinite(front.success), arrived, np.nan),
        lengths=np.array([each.lengths[:, 0].mean() for each in evaluations]),
        command=command,
        note=f"Undiscounted returns, {how}, from seed {seed} on.",
        best_known=best_known,
        scenes=tuple(scenes),
        budget_name=name,
        budget=budget,
    )


def explorable_best_known(name: str) -> ExplorableFront:
    """A best-known front with the drives of its action sequences.

    Args:
        name: SCENARIO_ACTIONS, such as "one_waypoint_discrete".

    Raises:
        ValueError: if no such front is shipped.
    """
    scenario_name, _, action_type = name.rpartition("_")
    policies = reference_fronts.shipped(scenario_name, action_type)
    config = reference_fronts.front_config(scenario_name, action_type)
    plans = [decode(policy.actions, action_type) for policy in policies]
    rewards = replay(config, plans)
    returns = discounted_sum(rewards, 1.0)
    kept = np.flatnonzero(moocore.is_nondominated(returns, maximise=True))
    kept = kept[np.argsort(returns[kept, 0], kind="stable")]
    scenario = SCENARIOS[scenario_name]
    arguments = {
        "action_type": action_type,
        "fixed_destination": config.fixed_destination,
        "fixed_obstacle": config.fixed_obstacle,
    }
    driver = PlanDriver([plans[k] for k in kept], idle(action_type))
    (scene,) = record_scenes(driver, scenario.id, arguments, seeds=[0], drives=len(kept))
    budget_name, budget = _budget(scenario_name, scenario.objectives)
    env = make_env(scenario.id, 1, arguments)
    scales = EnvAdapter(env).objective_scales.astype(np.float64)
    env.close()
    return ExplorableFront(
        title=f"best known: {scenario.title}, {action_type} actions",
        objectives=scenario.objectives,
        returns=returns[kept][:, None],
        scales=scales,
        signs=signs(scenario.objectives),
        success=np.array([float(drive.end == "arrived") for drive in scene.drives]),
        lengths=np.array([len(drive.readings) - 1.0 for drive in scene.drives]),
        command=f"mo_deepdrive.reference_fronts.shipped({scenario_name!r}, {action_type!r})[{{policy}}]",
        numbers=tuple(kept.tolist()),
        note="Undiscounted returns of the stored action sequences; policies are not learnt, and nothing chooses them.",
        scenes=(scene,),
        budget_name=budget_name,
        budget=budget,
    )


def _signs(env: Any, objectives: tuple[str, ...]) -> Any:
    """The signs of the returns, for environments of this package; ones for others."""
    adapter = EnvAdapter(env)
    return signs(objectives) if adapter.native and adapter.cost_sign == "maximise" else np.ones(len(objectives))


def _budget(scenario: str | None, objectives: tuple[str, ...]) -> tuple[str, ComfortBudget | None]:
    """The utility with a comfort budget of a scenario and its numbers, if it is for these objectives."""
    name = f"{scenario}_comfort_budget"
    if name not in COMFORT_BUDGETS or sorted(NONLINEAR[name][0]) != sorted(objectives):
        return "", None
    return name, COMFORT_BUDGETS[name]
