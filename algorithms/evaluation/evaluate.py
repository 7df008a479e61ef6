"""Evaluation apart from learning: raw environments, seeds of its own, a discount of its own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from algorithms.common.accrued_reward import AccruedReward
from algorithms.common.env_adapter import EnvAdapter
from mo_deepdrive.utilities import Utility


class Policy(Protocol):
    """What can be evaluated: an agent, a policy of a front, or another library's behind an adapter.

    Attributes:
        env: what it was made for.
        utilities: one per vehicle; empty where none is known.
        gamma: discount of the accrued reward that it is shown.
        device: where it draws random numbers.
    """

    @property
    def env(self) -> EnvAdapter: ...

    @property
    def utilities(self) -> Sequence[Utility]: ...

    @property
    def gamma(self) -> float: ...

    @property
    def device(self) -> torch.device: ...

    def act(
        self, observations: NDArray[np.float32], accrued_reward: AccruedReward, generator: torch.Generator | None
    ) -> NDArray[Any]:
        """Actions (N, V) or (N, V, k) for observations (N, V, o); greedy where ``generator`` is None."""


@dataclass
class Evaluation:
    """Episodes of one policy, E of them, for V vehicles.

    Attributes:
        objectives: names of the d components.
        utilities: one per vehicle; empty where none is known.
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
    policy: Policy,
    env: VectorEnv,
    *,
    episodes: int = 100,
    seed: int = 1_000_000,
    greedy: bool = True,
    gamma: float = 0.99,
) -> Evaluation:
    """Run ``episodes`` episodes of a policy.

    The worlds of ``env`` run the first episode after a reset, which gives every scenario the same weight whatever the
    episodes' lengths; more episodes than worlds take several resets. Episode i is seeded with ``seed + i``.

    Args:
        policy: an agent, or anything that acts like one.
        env: a raw environment, from `algorithms.common.env_adapter.make_env`; not the one that trains.
        episodes: E.
        seed: of the first episode.
        greedy: argmax or mean action, instead of samples.
        gamma: discount of the discounted returns; the policy's own discount is used for what it observes.
    """
    worlds = EnvAdapter(env)
    generator = None if greedy else torch.Generator(policy.device).manual_seed(seed)
    columns = _in_batches(lambda rows: policy, worlds, seed + np.arange(episodes), gamma, generator)
    return Evaluation(worlds.objectives, tuple(policy.utilities), *columns)


def evaluate_each(
    policy_of: Callable[[NDArray[np.intp]], Policy],
    count: int,
    env: VectorEnv,
    *,
    episodes: int,
    seed: int,
    gamma: float,
) -> list[Evaluation]:
    """Run ``episodes`` greedy episodes of each of ``count`` policies, all policies on the same seeds, side by side.

    Args:
        policy_of: the policy that acts in N worlds as the policies at N indices do.
        count: K policies.
        env, episodes, seed, gamma: as for :func:`evaluate`.
    """
    worlds = EnvAdapter(env)
    policies = np.repeat(np.arange(count), episodes)
    seeds = seed + np.tile(np.arange(episodes), count)
    columns = _in_batches(lambda rows: policy_of(policies[rows]), worlds, seeds, gamma, None)
    parts = [np.split(column, count) for column in columns]
    return [Evaluation(worlds.objectives, (), *part) for part in zip(*parts, strict=True)]


def _in_batches(
    policy_of: Callable[[NDArray[np.intp]], Policy],
    worlds: EnvAdapter,
    seeds: NDArray[np.int64],
    gamma: float,
    generator: torch.Generator | None,
) -> list[NDArray[Any]]:
    """One episode per seed, as many at a time as there are worlds: the fields of Evaluation from ``returns`` on."""
    batches = []
    for first in range(0, len(seeds), worlds.num_envs):
        # The worlds left over in the last batch repeat its last episode.
        rows = np.minimum(first + np.arange(worlds.num_envs), len(seeds) - 1)
        count = min(worlds.num_envs, len(seeds) - first)
        episodes = _first_episodes(policy_of(rows), worlds, seeds[rows].tolist(), gamma, generator)
        batches.append([array[:count] for array in episodes])
    return [np.concatenate(column) for column in zip(*batches, strict=True)]


def _first_episodes(
    policy: Policy, worlds: EnvAdapter, seeds: list[int], gamma: float, generator: torch.Generator | None
) -> tuple[NDArray[Any], ...]:
    """Every world's first episode after a reset."""
    n, v, d = worlds.num_envs, worlds.vehicles, len(worlds.objectives)
    returns = np.zeros((n, v, d))
    discounted = np.zeros((n, v, d))
    largest = np.zeros((n, v, d))
    lengths = np.zeros((n, v), dtype=np.int64)
    succeeded = np.zeros((n, v), dtype=np.bool_)
    ends = np.full((n, v), None, dtype=object)
    running = np.ones((n, v), dtype=np.bool_)
    unfinished = np.ones(n, dtype=np.bool_)
    accrued_reward = AccruedReward.begin(n, v, d)
    factor = 1.0
    observations = worlds.reset(seeds)
    while unfinished.any():
        step = worlds.step(policy.act(observations, accrued_reward, generator))
        counted = running & step.acted
        rewards = np.where(counted[..., None], step.rewards, 0.0)
        returns += rewards
        discounted += factor * rewards
        factor *= gamma
        accrued_reward.add(step.rewards, policy.gamma)
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
