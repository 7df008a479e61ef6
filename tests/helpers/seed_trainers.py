"""Small agents of several seeds side by side, of every algorithm in some of its forms."""

from __future__ import annotations

from typing import Any

import torch

from algorithms.runs.build import build
from algorithms.runs.config import Experiment, make_experiment
from tests.helpers.agents import CONTINUOUS, INTERSECTION, ONE_WAYPOINT, ROUNDABOUT, SEA

# Algorithm, environment, its arguments, and what differs from the defaults.
LEARNERS: dict[str, tuple[str, str, dict[str, Any], dict[str, Any]]] = {
    "a2c": ("a2c", ONE_WAYPOINT, {}, {}),
    "ppo, continuous": ("ppo", ONE_WAYPOINT, CONTINUOUS, {"state_dependent_std": True}),
    "ppo, two vehicles": ("ppo", INTERSECTION, {}, {}),
    "ppo, two vehicles, central": ("ppo", INTERSECTION, {}, {"centralised_critic": True}),
    "mo_a2c, as printed": ("mo_a2c", ONE_WAYPOINT, {}, {"advantage": "as_printed"}),
    "mo_ppo": ("mo_ppo", ONE_WAYPOINT, {}, {"minibatches": 3, "cost_growth": 0.5}),
    "mo_ppo, gradient": ("mo_ppo", ONE_WAYPOINT, CONTINUOUS, {"advantage": "utility_gradient"}),
    "mo_ppo, expected utility": ("mo_ppo", INTERSECTION, {}, {"advantage": "expected_utility"}),
    "rulebook_ppo": ("rulebook_ppo", INTERSECTION, {}, {"rulebook": [{"objective": "jerk", "at_most": 1.0}]}),
    "mocac": ("mocac", ONE_WAYPOINT, {}, {"particles": 4}),
    "mocac, grid, two vehicles": ("mocac", INTERSECTION, {}, {"critic": "categorical", "atoms": 2}),
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
UTILITIES = {
    ONE_WAYPOINT: "one_waypoint_linear",
    INTERSECTION: "intersection_linear",
    ROUNDABOUT: "roundabout_linear",
}
TOTAL = 320


def short_experiment(
    algorithm: str, env_id: str, arguments: dict[str, Any], hyperparameters: dict[str, Any], **training: Any
) -> Experiment:
    """Small networks and short episodes."""
    steps = {} if algorithm == "pcn" else {"steps": 8}
    values: dict[str, Any] = {
        "environment": {"id": env_id, "arguments": {} if env_id == SEA else {"time_limit": 1.5, **arguments}},
        "algorithm": {"name": algorithm, "hidden": [16], "learning_rate": 1e-2, **steps, **hyperparameters},
        "training": {"total_timesteps": TOTAL, "num_envs": 8, "compiled": False, **training},
    }
    if algorithm not in ("conditioned_mo_ppo", "pcn"):
        values["utility"] = {"name": UTILITIES[env_id]}
    return make_experiment(values)


def trainer(name: str, seeds: list[int], device: str = "cpu", **training: Any) -> Any:
    """An agent of several seeds."""
    return build(short_experiment(*LEARNERS[name], **training), seeds=seeds, device=device)


def trained(agent: Any, total: int = TOTAL, **options: Any) -> list[list[dict[str, float]]]:
    """What is logged of every seed, without times."""
    rows: list[list[dict[str, float]]] = [[] for _ in agent.seeds]

    def note(number: int) -> Any:
        return lambda _, row: rows[number].append({key: row[key] for key in row if not key.startswith("time/")})

    agent.train(total, log=[note(k) for k in range(len(rows))], **{"log_interval": 2, **options})
    return rows


def weights(agent: Any, seed: int) -> torch.Tensor:
    """All parameters of the seed with this index."""
    return torch.cat([learner.vector[seed, : sum(learner._sizes)] for learner in agent.learners])
