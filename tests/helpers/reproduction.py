"""Plans and made-up results of a reproduction."""

from __future__ import annotations

import numpy as np

from algorithms.studies.paper_claims import CLAIMS, Claim
from algorithms.studies.paper_results import ReproductionResults
from tests.helpers.paths import REPOSITORY

PLAN = REPOSITORY / "configs" / "studies" / "paper.yaml"
PUBLISHED = REPOSITORY / "docs" / "results"
SEEDS = 5
TINY = """
metric: stochastic/utility_esr
seeds: [3, 4]
overrides: {evaluation.final_episodes: 4, evaluation.episodes: 4, logging.save_figures: false, algorithm.hidden: [8],
  training.num_envs: 4, algorithm.steps: 10, environment.arguments.time_limit: 2}
tasks:
  one_waypoint_linear/best:
    title: "OneWaypoint, linear utility: best effort"
    steps: 800
    learners:
      a2c: {label: A2C, config: configs/one_waypoint/a2c_linear.yaml}
      mo_a2c: {label: MO-A2C, config: configs/one_waypoint/mo_a2c_linear.yaml}
  one_waypoint_linear/ablation:
    title: "OneWaypoint, linear utility: one change"
    seeds: [3]
    steps: 400
    learners:
      all: {label: nothing changed, config: configs/one_waypoint/mo_a2c_linear.yaml}
      gamma: {label: no discount, config: configs/one_waypoint/mo_a2c_linear.yaml, overrides: {algorithm.gamma: 1.0}}
"""


def get_claim(number: int) -> Claim:
    """The claim with a number."""
    return next(claim for claim in CLAIMS if claim.number == number)


def make_results(
    task: str,
    scores: dict[str, dict[str, list[float]]],
    protocol: str = "best",
    policy: str = "stochastic",
    risen: float = 0.5,
    first_episode: int = 3_000_000,
) -> ReproductionResults:
    """Results with one score per variant, metric and seed.

    The learning curves rise linearly to the scores until ``risen``, a part of the training, and are flat from there on.
    """
    rows, curves = [], []
    for variant, metrics in scores.items():
        for i in range(len(next(iter(metrics.values())))):
            keys = {
                "task": task,
                "protocol": protocol,
                "variant": variant,
                "label": variant,
                "seed": 20 + i,
                "steps": 1000,
            }
            values = {name: float(each[i]) for name, each in metrics.items()}
            measured = {"seconds": 2.5, "episodes": 1000, "first_episode": first_episode}
            rows.append({**keys, **measured, "policy": policy, **values})
            for step in range(0, 1001, 100):
                part = min(1.0, step / (1000 * risen))
                curves.append({**keys, "step": step, **{f"{policy}/{k}": v * part for k, v in values.items()}})
    return ReproductionResults(rows, curves)


def evenly_spread(value: float, spread: float = 0.01, count: int = SEEDS) -> list[float]:
    """Evenly spaced values from ``value`` - ``spread`` to ``value`` + ``spread``."""
    return (value + spread * np.linspace(-1.0, 1.0, count)).tolist()


SOLVED = {"utility_esr": evenly_spread(10.0), "success": evenly_spread(0.99, 0.001)}
