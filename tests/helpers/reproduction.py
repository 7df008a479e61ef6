"""Plans and made-up results of a reproduction."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import polars as pl

from algorithms.studies.paper import PaperResults, load_paper
from algorithms.studies.settings import Study
from mo_deepdrive.suite import Row
from tests.helpers.paths import REPOSITORY

PUBLISHED = REPOSITORY / "docs" / "results"
SEEDS = 5
TINY = """
metric: stochastic/utility_esr
columns: [success, end/collision, return/distance, cardinality]
seeds: [3, 4]
overrides: {evaluation.final_episodes: 4, evaluation.episodes: 4, logging.save_figures: false,
  training.num_envs: 4, environment.arguments.time_limit: 2}
help: {algorithm.hidden: [8], algorithm.steps: 10, algorithm.warmup_episodes: 4, algorithm.gradient_steps: 2}
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
  one_waypoint_front/best:
    title: "OneWaypoint, unknown utility: best effort"
    metric: front/hypervolume
    steps: 400
    learners: {pcn: {label: PCN, config: configs/one_waypoint/pcn.yaml}}
"""


@cache
def paper() -> Study:
    return load_paper("studies/paper")


def make_results(
    task: str,
    scores: dict[str, dict[str, list[float]]],
    protocol: str = "best",
    policy: str = "stochastic",
    risen: float = 0.5,
) -> PaperResults:
    """Results with one score per learner, metric and seed.

    The learning curves rise linearly to the scores until ``risen``, a part of the training, and are flat from there on.
    """
    rows: list[Row] = []
    curves: list[dict[str, Any]] = []
    key = f"{task}/{protocol}"
    for learner, metrics in scores.items():
        for i in range(len(next(iter(metrics.values())))):
            values = {name: float(values[i]) for name, values in metrics.items()}
            about: dict[str, Any] = {"cpu_seconds": 2.5, "steps": 1000}
            rows += [Row(key, learner, 20 + i, policy, name, value, **about) for name, value in values.items()]
            for step in range(0, 1001, 100):
                part = min(1.0, step / (1000 * risen))
                reached = {f"{policy}/{name}": value * part for name, value in values.items()}
                curves.append({"task": key, "learner": learner, "seed": 20 + i, "step": step, **reached})
    return PaperResults(paper(), rows, pl.DataFrame(curves, infer_schema_length=None))


def together(*parts: PaperResults) -> PaperResults:
    rows = [row for part in parts for row in part.rows]
    return PaperResults(paper(), rows, pl.concat([part.curves for part in parts], how="diagonal"))


def evenly_spread(value: float, spread: float = 0.01, count: int = SEEDS) -> list[float]:
    """Evenly spaced values from ``value`` - ``spread`` to ``value`` + ``spread``."""
    return (value + spread * np.linspace(-1.0, 1.0, count)).tolist()


SOLVED = {"utility_esr": evenly_spread(10.0), "success": evenly_spread(0.99, 0.001)}
