"""Small runs of every algorithm for tests of exported policies, and comparisons of policies."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from algorithms import ALGORITHMS, zoo
from algorithms.actor_critic import ActorCritic
from algorithms.agent import FrontAgent
from algorithms.runs.build import build, make_environment
from algorithms.runs.config import Experiment, make_experiment
from algorithms.runs.report import evaluate_front
from algorithms.runs.run_directory import Run
from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.evaluation.policy import AccruedReward
from tests.helpers.agents import INTERSECTION, ONE_WAYPOINT, SEA, exaggerate

SHIPPED = Path(zoo.__file__).resolve().parent
KILOBYTE = 1000
LINEAR = {ONE_WAYPOINT: "one_waypoint_linear", INTERSECTION: "intersection_linear"}
SMALL_PCN = {
    "learning_rate": 1e-2,
    "hidden": [32, 32],
    "persistence": 0.95,
    "horizon_reduction": 0,
    "horizon_scale": 20.0,
}


def experiment_of(name: str, env_id: str, arguments: dict[str, Any], **hyperparameters: Any) -> Experiment:
    values: dict[str, Any] = {
        "environment": {"id": env_id, "arguments": arguments},
        "algorithm": {"name": name, **hyperparameters},
        "training": {"total_timesteps": 256 if ALGORITHMS[name].known_utility else 3000, "num_envs": 4, "seed": 3},
        "evaluation": {"episodes": 1, "final_episodes": 1},
    }
    if env_id == SEA:
        values["utility"] = {"name": "linear", "arguments": {"weights": [1.0, 0.1]}}
    elif ALGORITHMS[name].known_utility:
        values["utility"] = {"name": LINEAR[env_id]}
    return make_experiment(values)


ONE = functools.partial(experiment_of, env_id=ONE_WAYPOINT, steps=8, hidden=[16])
TWO = functools.partial(experiment_of, env_id=INTERSECTION, steps=8, hidden=[16], arguments={"time_limit": 3})
FRONT = functools.partial(experiment_of, "pcn", ONE_WAYPOINT, **SMALL_PCN)
ACTOR_CRITICS: dict[str, Callable[[], Experiment]] = {
    "a2c": lambda: ONE("a2c", arguments={"time_limit": 3}),
    "mo_a2c": lambda: ONE("mo_a2c", arguments={"time_limit": 3}),
    "mo_a2c, continuous": lambda: ONE("mo_a2c", arguments={"time_limit": 3, "action_type": "continuous"}),
    "mo_a2c, another environment": lambda: experiment_of("mo_a2c", SEA, {}, steps=8, hidden=[16]),
    "mo_ppo": lambda: ONE("mo_ppo", arguments={"time_limit": 3}),
    "a2c, two vehicles": lambda: TWO("a2c"),
    "mo_ppo, two vehicles": lambda: TWO("mo_ppo"),
    "mo_ppo, centralised critic": lambda: TWO("mo_ppo", centralised_critic=True),
}
CONDITIONED = "conditioned_mo_ppo"
FRONTS: dict[str, Callable[[], Experiment]] = {
    "pcn": lambda: FRONT({"time_limit": 3, "fixed_destination": True}),
    "pcn, continuous": lambda: FRONT({"time_limit": 3, "fixed_destination": True, "action_type": "continuous"}),
    # Costs grow in, or it would learn to stand still under every preference.
    CONDITIONED: lambda: ONE(
        CONDITIONED, arguments={"time_limit": 3}, learning_rate=1e-2, cost_growth=1.0, max_policies=20
    ),
}
EVERY_ACTOR_CRITIC = pytest.mark.parametrize("kind", ACTOR_CRITICS)
EVERY_FRONT = pytest.mark.parametrize("kind", FRONTS)
EVERY_KIND = pytest.mark.parametrize("kind", [*ACTOR_CRITICS, *FRONTS])

Trained = Callable[[str], Run]


def train(experiment: Experiment, path: Path) -> Run:
    """A run with what exporting needs; policies of our actor-critics are made far from uniform."""
    run = Run.create(experiment, path)
    run.unlock()
    agent = build(experiment)
    agent.train(experiment.training.total_timesteps)
    if isinstance(agent, ActorCritic) and agent.env.native:
        exaggerate(agent)
    agent.save(run.checkpoint)
    if isinstance(agent, FrontAgent):
        evaluate_front(agent, experiment, episodes=1, seed=0).write(path, {"step": agent.step})
    return run


def contents(folder: Path) -> dict[str, bytes]:
    """The contents of all files below a folder, including hidden ones."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def whole_agent(run: Run) -> Any:
    agent = build(run.experiment)
    agent.load(run.checkpoint)
    return agent


def policy_of(path: Path) -> Any:
    """An agent for one environment with the policy in a folder."""
    run = Run.open(path)
    agent = build(run.experiment, num_envs=1)
    agent.load(run.checkpoint, policy_only=True)
    return agent


def actions_of(policy: Any, generator: torch.Generator | None) -> np.ndarray:
    """The actions of a policy in 40 random states."""
    env, rng = policy.env, np.random.default_rng(1)
    n, d = 40, len(env.objectives)
    accrued_reward = AccruedReward.begin(n, env.vehicles, d)
    accrued_reward.value[:] = rng.normal(size=accrued_reward.value.shape) * env.objective_scales
    accrued_reward.discounts[:] = rng.uniform(0.5, 1.0, accrued_reward.discounts.shape)
    observations = rng.normal(size=(n, env.vehicles, env.observation_size)) * env.observation_scales
    return policy.act(observations.astype(np.float32), accrued_reward, generator)


def assert_same_episodes(first: Any, second: Any, experiment: Experiment) -> None:
    """Two policies give the same episodes and actions, bit for bit, with greedy and with sampled actions."""
    for greedy in (True, False):
        found = [
            evaluate(policy, make_environment(experiment.environment, 3), episodes=4, seed=7, greedy=greedy, gamma=0.9)
            for policy in (first, second)
        ]
        for name in ("returns", "discounted", "lengths", "succeeded", "ends"):
            np.testing.assert_array_equal(getattr(found[0], name), getattr(found[1], name), err_msg=name)
        actions = [
            actions_of(policy, None if greedy else torch.Generator().manual_seed(2)) for policy in (first, second)
        ]
        assert actions[0].tobytes() == actions[1].tobytes()
        assert greedy or len(np.unique(actions[0])) > 1
