"""Small trainers of several seeds, of every algorithm in some of its forms."""

from __future__ import annotations

from typing import Any

import torch

from algorithms.device.trainer import SeedTrainer
from algorithms.experiments.config import make_experiment
from algorithms.experiments.side_by_side import build_trainee
from tests.helpers.agents import CONTINUOUS, INTERSECTION, ONE_WAYPOINT

# Algorithm, environment, its arguments, and what differs from the defaults.
LEARNERS: dict[str, tuple[str, str, dict[str, Any], dict[str, Any]]] = {
    "a2c": ("a2c", ONE_WAYPOINT, {}, {}),
    "ppo, continuous": ("ppo", ONE_WAYPOINT, CONTINUOUS, {"state_dependent_std": True}),
    "ppo, two vehicles, central": ("ppo", INTERSECTION, {}, {"centralised_critic": True}),
    "mo_a2c, as printed": ("mo_a2c", ONE_WAYPOINT, {}, {"advantage": "as_printed"}),
    "mo_ppo": ("mo_ppo", ONE_WAYPOINT, {}, {"minibatches": 3, "cost_growth": 0.5}),
    "mo_ppo, gradient": ("mo_ppo", ONE_WAYPOINT, CONTINUOUS, {"advantage": "utility_gradient"}),
    "mo_ppo, expected utility": ("mo_ppo", INTERSECTION, {}, {"advantage": "expected_utility"}),
    "mappo": ("mappo", INTERSECTION, {}, {}),
    "conditioned": ("conditioned_mo_ppo", ONE_WAYPOINT, {}, {}),
    "conditioned, families": (
        "conditioned_mo_ppo",
        ONE_WAYPOINT,
        CONTINUOUS,
        {
            "families": {"linear": 1, "chebyshev": 1, "comfort_budget": 1},
            "budgets": {"jerk": 50},
            "vector_critic": True,
        },
    ),
    "conditioned, two vehicles": ("conditioned_mo_ppo", INTERSECTION, {}, {}),
}
UTILITIES = {ONE_WAYPOINT: "one_waypoint_linear", INTERSECTION: "intersection_linear"}
TOTAL = 320


def trainer(name: str, seeds: list[int], device: str = "cpu", *, compiled: bool = False) -> SeedTrainer:
    """Of small networks and short episodes."""
    algorithm, env_id, arguments, hyperparameters = LEARNERS[name]
    values: dict[str, Any] = {
        "environment": {"id": env_id, "arguments": {"time_limit": 1.5, **arguments}},
        "algorithm": {"name": algorithm, "hidden": [16], "steps": 8, "learning_rate": 1e-2, **hyperparameters},
        "training": {
            "total_timesteps": TOTAL,
            "num_envs": 8,
            "seeds": seeds,
            "device": device,
            "compiled": compiled or None,
        },
    }
    if algorithm != "conditioned_mo_ppo":
        values["utility"] = {"name": UTILITIES[env_id]}
    found = build_trainee(make_experiment(values).of_seeds())
    assert isinstance(found, SeedTrainer)
    return found


def trained(trainee: SeedTrainer, total: int = TOTAL, **options: Any) -> list[list[dict[str, float]]]:
    """What is logged of every seed, without times."""
    rows: list[list[dict[str, float]]] = [[] for _ in trainee.agents]

    def note(number: int) -> Any:
        return lambda _, row: rows[number].append({key: row[key] for key in row if not key.startswith("time/")})

    settings = {"eval_interval": total, "eval_episodes": 1, "eval_seed": 0, "eval_gamma": 1.0, "log_interval": 2}
    trainee.train(total, None, log=[note(k) for k in range(len(rows))], **{**settings, **options})
    return rows


def weights(trainee: SeedTrainer, seed: int) -> torch.Tensor:
    """All parameters of a seed."""
    return torch.cat([learner.networks.vector[seed] for learner in trainee.learners])


def branching(returns: Any) -> Any:
    """A utility that decides by the values of its returns how it is calculated."""
    return returns.sum(-1) if (returns >= 0.0).all() else returns[..., 0]
