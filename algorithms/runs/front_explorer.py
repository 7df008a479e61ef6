"""The explorer's page of trained runs and of best-known fronts."""

from __future__ import annotations

import shlex
from contextlib import closing
from typing import TYPE_CHECKING, Any

import moocore
import numpy as np

from algorithms.reporting.explorer.explorable_front import DiscountedReturns, ExplorableFront
from algorithms.reporting.explorer.page import EXPLORER_FILE, write_page
from algorithms.runs.cli import CHOICE_EPISODES, CHOICE_SPLIT
from algorithms.runs.config import find_environment
from algorithms.runs.console import print_line
from algorithms.runs.policy_evaluation import evaluate_front_policies
from algorithms.runs.run_directory import imported_paths
from mo_deepdrive.evaluation.drives import PlanDriver, is_drivable, record_scenes
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.front import Front, best_known_front
from mo_deepdrive.evaluation.metrics import without_vehicle
from mo_deepdrive.evaluation.policy import PolicyDriver
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.fronts import reference_fronts
from mo_deepdrive.utilities import COMFORT_BUDGETS, NONLINEAR, ComfortBudget
from mo_deepdrive.world.action_sequences import decode, discounted_sum, idle, replay
from mo_deepdrive.world.objectives import signs
from mo_deepdrive.world.scenarios import SCENARIOS

if TYPE_CHECKING:
    from rich.console import Console

    from algorithms.agent import FrontAgent
    from algorithms.runs.config import Experiment
    from algorithms.runs.run_directory import Run
    from mo_deepdrive.evaluation.drives import Scene

SCENARIOS_SHOWN = 3  # of a front whose episodes differ
BEST_KNOWN = "best-known/"  # before the name of a best-known front


def choose_command(
    run: Run, name: str, *, episodes: int = CHOICE_EPISODES, split: str = CHOICE_SPLIT, seed: int | None = None
) -> str:
    """The command that evaluates a choice on the same episodes, with ``{preference}`` for the preference.

    Args:
        run: a finished run.
        name: how the user calls it.
        episodes: of each policy.
        split: of the scenario seeds.
        seed: of the first episode, instead of a split.
    """
    words = ["mo-deepdrive choose", shlex.quote(name), "{preference}"]
    if imported_paths(run.experiment.to_dict()):
        words.append("--trust")
    if episodes != CHOICE_EPISODES:
        words.append(f"--episodes {episodes}")
    if seed is not None:
        words.append(f"--seed {seed}")
    elif split != CHOICE_SPLIT:
        words.append(f"--split {split}")
    return " ".join(words)


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

    Raises:
        ValueError: if the front has no policy.
    """
    if not len(front):
        raise ValueError(f"the front of {title!r} has no policy")
    evaluations = evaluate_front_policies(agent, front, experiment, episodes=episodes, seed=seed)
    returns = np.stack([each.joint_returns for each in evaluations])
    env_id, arguments = experiment.environment.id, experiment.environment.arguments
    gamma = experiment.evaluation.gamma
    discounted = np.stack([each.joint_discounted for each in evaluations])
    with closing(make_env(env_id, 1, arguments)) as env:
        cost_signs = _signs(env, front.objectives)
        best_known, best_discounted = best_known_front(env, 1.0), best_known_front(env, gamma)
    name, budget = _budget(find_environment(env_id).kwargs.get("scenario"), front.objectives)
    arrived = np.array([each.joint_succeeded.mean() for each in evaluations])
    driven = returns.shape[1]
    how = f"{driven} episodes of each policy" if driven > 1 else "every episode is the same, so one is driven"
    return ExplorableFront(
        title=title,
        objectives=front.objectives,
        returns=returns,
        scales=agent.front_scales,
        signs=cost_signs,
        success=np.where(np.isfinite(front.success), arrived, np.nan),
        lengths=np.array([each.joint_lengths.mean() for each in evaluations]),
        command=command,
        note=f"{how[0].upper()}{how[1:]}, from seed {seed} on.",
        best_known=best_known,
        discounted=DiscountedReturns(gamma, discounted, best_discounted) if gamma < 1.0 else None,
        scenes=tuple(_scenes(agent, front, experiment, range(seed, seed + min(driven, SCENARIOS_SHOWN)))),
        budget_name=name,
        budget=budget,
    )


def _scenes(agent: FrontAgent, front: Front, experiment: Experiment, seeds: range) -> list[Scene]:
    """A drive of every policy in the scenario of every seed; nothing where drives cannot be recorded."""
    env = experiment.environment
    if not is_drivable(env.id):
        return []
    conditions = np.tile(np.asarray(front.conditions, dtype=np.float32), (len(seeds), 1))
    driver = PolicyDriver(agent.policies(conditions), num_envs=len(conditions))
    return record_scenes(driver, env.id, env.arguments, seeds=seeds, drives=len(front))


def write_explorer(run: Run, agent: FrontAgent, console: Console) -> None:
    """Write the explorer of a run's front into its directory and print the file.

    Args:
        run: with the front of its final evaluation.
        agent: has learnt it.
        console: where to print.

    Raises:
        ValueError: if the front has no policy.
        OSError: if the file cannot be written.
    """
    path = run.path / EXPLORER_FILE
    name = str(run.path)
    front = explorable(
        agent,
        Front.read(run.path),
        run.experiment,
        episodes=CHOICE_EPISODES,
        seed=SPLITS[CHOICE_SPLIT].start,
        title=name,
        command=choose_command(run, name),
    )
    write_page([front], path, f"Explorer of fronts: {name}")
    print_line(console, f"explorer: {path}: open it in a browser")


def explorable_best_known(name: str) -> ExplorableFront:
    """A best-known front, undiscounted and with the time among its objectives, with the drives of its actions.

    Args:
        name: SCENARIO_ACTIONS, such as "one_waypoint_discrete".

    Raises:
        ValueError: if no such front is shipped.
    """
    scenario_name, _, action_type = name.rpartition("_")
    policies = reference_fronts.shipped(scenario_name, action_type)
    config = reference_fronts.front_config(scenario_name, action_type)
    scenario = SCENARIOS[scenario_name]
    objectives = (*scenario.objectives, reference_fronts.TIME)
    plans = [decode(policy.actions, action_type) for policy in policies]
    rewards = replay(config.model_copy(update={"objectives": objectives}), plans)
    returns = discounted_sum(rewards, 1.0)
    kept = np.flatnonzero(moocore.is_nondominated(returns, maximise=True))
    kept = kept[np.argsort(returns[kept, 0], kind="stable")]
    arguments = {
        "action_type": action_type,
        "fixed_destination": config.fixed_destination,
        "fixed_obstacle": config.fixed_obstacle,
        "objectives": list(objectives),
    }
    driver = PlanDriver([plans[k] for k in kept], idle(action_type))
    (scene,) = record_scenes(driver, scenario.id, arguments, seeds=[0], drives=len(kept))
    budget_name, budget = _budget(scenario_name, objectives)
    with closing(make_env(scenario.id, 1, arguments)) as env:
        scales = EnvAdapter(env).objective_scales.astype(np.float64)
    return ExplorableFront(
        title=f"best known: {scenario.title}, {action_type} actions",
        objectives=objectives,
        returns=returns[kept][:, None],
        scales=scales,
        signs=signs(objectives),
        success=np.array([float(drive.ends == ("arrived",)) for drive in scene.drives]),
        lengths=np.array([len(drive.readings) - 1.0 for drive in scene.drives]),
        command=f"mo_deepdrive.fronts.reference_fronts.shipped({scenario_name!r}, {action_type!r})[{{policy}}]",
        numbers=tuple(kept.tolist()),
        note="Returns of the stored action sequences; policies are not learnt, and nothing chooses them.",
        discounted=DiscountedReturns(
            reference_fronts.GAMMA, discounted_sum(rewards, reference_fronts.GAMMA)[kept][:, None]
        ),
        scenes=(scene,),
        budget_name=budget_name,
        budget=budget,
    )


def _signs(env: Any, objectives: tuple[str, ...]) -> Any:
    """The signs of the returns, for environments of this package; ones for others."""
    adapter = EnvAdapter(env)
    if not adapter.native or adapter.cost_sign != "maximise":
        return np.ones(len(objectives))
    return signs(tuple(map(without_vehicle, objectives)))


def _budget(scenario: str | None, objectives: tuple[str, ...]) -> tuple[str, ComfortBudget | None]:
    """The utility with a comfort budget of a scenario and its numbers, if these objectives are enough for it."""
    name = f"{scenario}_comfort_budget"
    if name not in COMFORT_BUDGETS or not {*NONLINEAR[name][0]} <= {*objectives}:
        return "", None
    return name, COMFORT_BUDGETS[name]
