"""Agents that train for a moment, and whether a resumed one is what it would have been without the interruption."""

from __future__ import annotations

from typing import Any

from algorithms.runs.build import build
from algorithms.runs.config import make_experiment
from tests.helpers.agents import INTERSECTION

STEPS = 400


def pair_experiment(algorithm: str = "ppo", **training: Any) -> Any:
    """Two vehicles that learn at the intersection, with these settings of ``training``."""
    return make_experiment(
        {
            "environment": {"id": INTERSECTION, "arguments": {"time_limit": 6.0}},
            "utility": {"name": "intersection_linear"},
            "algorithm": {"name": algorithm, "steps": 8, "hidden": [16]},
            "training": {"total_timesteps": STEPS, "num_envs": 8, **training},
        }
    )


def trained(experiment: Any) -> Any:
    """The agent of an experiment after its training."""
    agent = build(experiment)
    agent.train(STEPS)
    return agent
