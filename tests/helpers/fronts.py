"""Fronts that are made up."""

from __future__ import annotations

from typing import Any

import numpy as np

from mo_deepdrive.evaluation.front import Front

OBJECTIVES = ("distance", "destination", "g_force", "jerk", "collision", "lane_violation")


def front_of(
    returns: Any, objectives: tuple[str, ...] | None = None, succeeded: Any = None, episodes: int = 3
) -> Front:
    """A front of the mean ``returns`` (K, d); the episodes differ by a tenth."""
    mean = np.asarray(returns, dtype=np.float64)
    k, d = mean.shape
    every = mean[:, None] * np.linspace(0.9, 1.1, episodes)[:, None] if episodes > 1 else mean[:, None]
    reached = None if succeeded is None else np.repeat(np.asarray(succeeded, dtype=bool)[:, None], episodes, axis=1)
    return Front.of_episodes(
        objectives or OBJECTIVES[:d], every, 0.5 * every, np.full((k, episodes), 10.0), reached, gamma=0.99, seed=0
    )


def driving(k: int, d: int, seed: int = 0) -> Front:
    """``k`` policies that trade distance for comfort and smoothness, and their first ``d`` objectives."""
    rng = np.random.default_rng(seed)
    share = np.linspace(0.0, 1.0, k) if k > 1 else np.ones(1)
    columns = [15.3 * share, share > 0.6, -30 * share, -1500 * share * rng.random(k), -1.0 * (rng.random(k) > 0.8)]
    columns.append(-3 * rng.random(k))
    return front_of(np.stack(columns[:d], axis=1), succeeded=share > 0.6)
