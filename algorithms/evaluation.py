"""Evaluation apart from learning: raw environments, seeds of its own, a discount of its own."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from algorithms.worlds import Worlds
from mo_deepdrive.utilities import Utility

if TYPE_CHECKING:
    from algorithms.base import ActorCritic


@dataclass
class Evaluation:
    """Episodes of one policy, E of them, for V vehicles.

    Attributes:
        objectives: names of the d components.
        utilities: one per vehicle.
        returns: (E, V, d) undiscounted vector returns.
        discounted: (E, V, d) discounted with the evaluation's gamma.
        lengths: (E, V) decisions.
        succeeded: (E, V) whether the goal was reached.
        ends: (E, V) why the episode ended; None where the environment does not say.
        largest: (E, V, d) largest magnitude of each objective in one decision.
    """

    objectives: tuple[str, ...]
    utilities: tuple[Utility, ...]
    returns: NDArray[np.float64]
    discounted: NDArray[np.float64]
    lengths: NDArray[np.int64]
    succeeded: NDArray[np.bool_]
    ends: NDArray[Any]
    largest: NDArray[np.float64]

    def episode_utilities(self, v: int = 0) -> NDArray[np.float64]:
        """(E,) utility of every undiscounted return of vehicle ``v``; its mean is the ESR value."""
        return np.asarray(self.utilities[v](self.returns[:, v]))

    def end_rates(self, v: int = 0) -> dict[str, float]:
        """Share of the episodes of vehicle ``v`` per reason of their end."""
        counts = Counter(str(end) for end in self.ends[:, v] if end is not None)
        return {end: count / len(self.ends) for end, count in sorted(counts.items())}

    def metrics(self) -> dict[str, float]:
        """Everything as named scalars; with several vehicles prefixed by ``vehicle_0/`` and so on.

        With several vehicles ``success`` is the share of episodes in which all arrived. Mean and largest per-decision
        magnitudes are given for the costs that are rates: g-force and jerk.
        """
        metrics: dict[str, float] = {}
        vehicles = self.returns.shape[1]
        if vehicles > 1:
            metrics["success"] = float(self.succeeded.all(axis=1).mean())
        for v in range(vehicles):
            prefix = f"vehicle_{v}/" if vehicles > 1 else ""
            utility = self.utilities[v]
            metrics[prefix + "utility_esr"] = float(self.episode_utilities(v).mean())
            metrics[prefix + "utility_ser"] = float(utility(self.returns[:, v].mean(axis=0)))
            metrics[prefix + "discounted_utility_esr"] = float(np.mean(utility(self.discounted[:, v])))
            metrics[prefix + "discounted_utility_ser"] = float(utility(self.discounted[:, v].mean(axis=0)))
            metrics[prefix + "success"] = float(self.succeeded[:, v].mean())
            metrics[prefix + "length"] = float(self.lengths[:, v].mean())
            for end, rate in self.end_rates(v).items():
                metrics[f"{prefix}end/{end}"] = rate
            for i, objective in enumerate(self.objectives):
                metrics[f"{prefix}return/{objective}"] = float(self.returns[:, v, i].mean())
                metrics[f"{prefix}discounted_return/{objective}"] = float(self.discounted[:, v, i].mean())
                if objective in ("g_force", "jerk"):
                    per_decision = np.abs(self.returns[:, v, i]) / np.maximum(self.lengths[:, v], 1)
                    metrics[f"{prefix}mean_{objective}"] = float(per_decision.mean())
                    metrics[f"{prefix}max_{objective}"] = float(self.largest[:, v, i].max())
        return metrics


def evaluate(
    agent: ActorCritic,
    env: VectorEnv,
    *,
    episodes: int = 100,
    seed: int = 1_000_000,
    greedy: bool = True,
    gamma: float = 0.99,
) -> Evaluation:
    """Run ``episodes`` episodes of the agent's policy.

    The worlds of ``env`` run the first episode after a reset, which gives every scenario the same weight whatever the
    episodes' lengths; more episodes than worlds take several resets. Episode i is seeded with ``seed + i``.

    Args:
        agent: the policy.
        env: a raw environment, from `algorithms.worlds.make_env`; not the one that trains.
        episodes: E.
        seed: of the first episode.
        greedy: argmax or mean action, instead of samples.
        gamma: discount of the discounted returns; the agent's own discount is used for what it observes.
    """
    worlds = Worlds(env)
    generator = None if greedy else torch.Generator(agent.device).manual_seed(seed)
    batches = []
    for first in range(0, episodes, worlds.num_envs):
        count = min(worlds.num_envs, episodes - first)
        batches.append([array[:count] for array in _first_episodes(agent, worlds, seed + first, gamma, generator)])
    columns = [np.concatenate(column) for column in zip(*batches, strict=True)]
    return Evaluation(worlds.objectives, tuple(agent.utilities), *columns)


def _first_episodes(
    agent: ActorCritic, worlds: Worlds, seed: int, gamma: float, generator: torch.Generator | None
) -> tuple[NDArray[Any], ...]:
    """Every world's first episode after a reset: the fields of Evaluation from ``returns`` on."""
    n, v, d = worlds.num_envs, worlds.vehicles, len(worlds.objectives)
    returns = np.zeros((n, v, d))
    discounted = np.zeros((n, v, d))
    largest = np.zeros((n, v, d))
    lengths = np.zeros((n, v), dtype=np.int64)
    succeeded = np.zeros((n, v), dtype=np.bool_)
    ends = np.full((n, v), None, dtype=object)
    running = np.ones((n, v), dtype=np.bool_)
    unfinished = np.ones(n, dtype=np.bool_)
    accrued = np.zeros((n, v, d), dtype=np.float32)
    discounts = np.ones((n, v), dtype=np.float32)
    factor = 1.0
    observations = worlds.reset(seed)
    while unfinished.any():
        step = worlds.step(agent.act(observations, accrued, discounts, generator))
        counted = running & step.acted
        rewards = np.where(counted[..., None], step.rewards, 0.0)
        returns += rewards
        discounted += factor * rewards
        factor *= gamma
        accrued += discounts[..., None] * step.rewards
        discounts *= agent.config.gamma
        largest = np.maximum(largest, np.abs(rewards))
        lengths += counted
        succeeded |= counted & step.succeeded
        running &= ~(step.terminated | step.truncated)
        over = unfinished & ~running.any(axis=1)
        if over.any():
            if step.ends is not None:
                ends[over] = step.ends.reshape(n, v)[over]
            unfinished &= ~over
        observations = step.observations
    return returns, discounted, lengths, succeeded, ends, largest
