"""Evaluation of policies, separate from learning: on raw environments, with its own seeds and its own discount.

:func:`evaluate` takes an agent of this package, or a policy of any other library as a function of NumPy arrays; the
latter does not need torch.
"""

from __future__ import annotations

from contextlib import closing
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from mo_deepdrive.evaluation.env_adapter import EnvAdapter, find_spec, is_drivable, make_env
from mo_deepdrive.evaluation.evaluation import Evaluation, Provenance
from mo_deepdrive.evaluation.policy import FunctionPolicy, Policy, check_same_task, drive, seeded_generator
from mo_deepdrive.evaluation.splits import first_seed
from mo_deepdrive.support.machine import check_memory
from mo_deepdrive.support.plain_values import is_finite
from mo_deepdrive.utilities import Utility, check_utility, fitting_utility

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import torch
    from gymnasium.vector import VectorEnv
    from numpy.typing import NDArray

    from mo_deepdrive.evaluation.policy import PolicyFunction
    from mo_deepdrive.evaluation.splits import Split

    UtilityLike = str | Utility | Callable[[Any], Any]

# Parallel environments: this package's cost next to nothing, others a Python step each.
OUR_ENVS, OTHER_ENVS = 256, 8
EPISODE_BYTES = 40  # of results per episode, at the least


def evaluate(
    policy: Policy | PolicyFunction,
    env: str | VectorEnv,
    *,
    split: Split | None = None,
    episodes: int = 100,
    seed: int | None = None,
    utility: UtilityLike | Sequence[UtilityLike] | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    greedy: bool = True,
    gamma: float = 0.99,
) -> Evaluation:
    """Run ``episodes`` episodes of a policy.

    Of each parallel environment only the first episode after a reset counts, which gives every scenario the same weight
    however long its episode is; more episodes than environments take several resets. Episode i is seeded with
    ``seed + i``.

    Args:
        policy: an agent, or a function ``policy(observations, accrued, discounts) -> actions`` on batches of N
            episodes: observations (N, o) and actions (N,) or (N, k) as the environment returns and takes them, the
            accrued reward R_t = sum_{i<t} gamma^i r_i (N, d), and gamma^t (N,). With V vehicles in an environment each
            has a second axis: (N, V, o), (N, V) or (N, V, k), (N, V, d), (N, V).
        env: an id, also as ``module:id``; or a raw vector environment from
            :func:`mo_deepdrive.evaluation.env_adapter.make_env`, not the one used for training.
        split: the scenarios: "validation" (default), or "test" for final scores.
        episodes: E; the test split has 2,000.
        seed: of the first episode, instead of a split.
        utility: a name, as :func:`mo_deepdrive.utilities.make_utility` takes it, a utility, or a function of returns
            (..., d); or a list with one per vehicle. By default the agent's; a function has none.
        env_kwargs: arguments of the environment, if ``env`` is an id.
        greedy: of an agent, take the most likely (or mean) action instead of sampling.
        gamma: discount factor of the discounted returns, and of the accrued reward that a function is given; an agent
            observes rewards accrued with its own.

    Raises:
        TypeError: for an unknown environment argument, or a policy that is neither an agent nor a function.
        ValueError: for invalid arguments, an agent that was trained on another task, or actions of the wrong shape.
        NotFinite: for observations, rewards, actions or utilities that are not finite.
        EndlessEpisode: if an episode is longer than the id's max_episode_steps, or 10,000 decisions where it has none.
    """
    if isinstance(episodes, bool) or not isinstance(episodes, (int, np.integer)) or episodes < 1:
        raise ValueError(f"episodes = {episodes!r} must be a positive integer")
    if not is_finite(gamma) or not 0.0 <= gamma <= 1.0:
        raise ValueError(f"gamma = {gamma!r} must be between 0 and 1")
    gamma, greedy = float(gamma), bool(greedy)
    first = first_seed(split, seed, episodes)
    check_memory(f"episodes = {episodes}", episodes * EPISODE_BYTES)
    if not isinstance(env, str):
        if env_kwargs is not None:
            raise ValueError("env_kwargs are for an environment given by its id")
        return _evaluate(policy, env, first + np.arange(episodes), utility, greedy, gamma)
    arguments = dict(env_kwargs or {})
    with closing(make_env(env, parallel_envs(env, episodes), arguments)) as made:
        evaluation = _evaluate(policy, made, first + np.arange(episodes), utility, greedy, gamma)
    if not is_drivable(env):
        # The environment itself knows neither the module that registers it nor its arguments.
        evaluation.provenance = Provenance(env, first, gamma, greedy, arguments)
    return evaluation


def parallel_envs(env_id: str, episodes: int) -> int:
    """The number of parallel environments that drive ``episodes`` episodes."""
    return min(episodes, OTHER_ENVS if find_spec(env_id).vector_entry_point is None else OUR_ENVS)


def as_policy(
    policy: Policy | PolicyFunction,
    env: EnvAdapter,
    utility: UtilityLike | Sequence[UtilityLike] | None = None,
    gamma: float = 0.99,
) -> Policy:
    """An agent as it is, a function as a policy; arguments and errors are those of :func:`evaluate`."""
    if isinstance(getattr(policy, "env", None), EnvAdapter):  # other libraries' agents have act, too
        agent = cast("Policy", policy)
        check_same_task(agent.env, env)
        return agent
    return FunctionPolicy(cast("PolicyFunction", policy), env, vehicle_utilities(utility, env), gamma)


def _evaluate(
    policy: Policy | PolicyFunction,
    env: VectorEnv,
    seeds: NDArray[np.int64],
    utility: UtilityLike | Sequence[UtilityLike] | None,
    greedy: bool,
    gamma: float,
) -> Evaluation:
    adapter = EnvAdapter(env)
    actor = as_policy(policy, adapter, utility, gamma)
    if not greedy and isinstance(actor, FunctionPolicy):
        raise ValueError("greedy = False is for agents; a function samples its actions itself")
    utilities = tuple(actor.utilities) if utility is None else vehicle_utilities(utility, adapter)
    columns = _in_batches(
        lambda _: actor, adapter, seeds, gamma, None if greedy else seeded_generator(actor, int(seeds[0]))
    )
    about = _provenance(adapter, int(seeds[0]), gamma, greedy=greedy)
    return Evaluation(adapter.objectives, utilities, *columns, provenance=about)


def _provenance(adapter: EnvAdapter, seed: int, gamma: float, *, greedy: bool) -> Provenance:
    """What is known of an evaluation from its environment."""
    env: Any = adapter.vector_env.unwrapped
    arguments = env.config.model_dump(mode="json", exclude={"scenario"}) if adapter.native else {}
    return Provenance(adapter.name, seed, gamma, greedy, arguments)


def vehicle_utilities(utility: UtilityLike | Sequence[UtilityLike] | None, env: EnvAdapter) -> tuple[Utility, ...]:
    """One utility per vehicle, as :func:`evaluate` takes them, over the environment's objectives; none for None."""
    if utility is None:
        return ()
    per_vehicle: list[Any] = list(utility) if isinstance(utility, (list, tuple)) else [utility] * env.vehicles
    if len(per_vehicle) != env.vehicles:
        raise ValueError(f"{len(per_vehicle)} utilities are given for {env.vehicles} vehicles")
    return tuple(_utility(one, env) for one in per_vehicle)


def _utility(utility: UtilityLike, env: EnvAdapter) -> Utility:
    if not isinstance(utility, (str, Utility)):
        utility = Utility(getattr(utility, "__name__", "utility"), env.objectives, utility)
    fitting = fitting_utility(utility, env.objectives, env.cost_sign, named=env.named)
    if fitting is utility:
        check_utility(fitting, np.zeros)
    return fitting


def evaluate_each(
    policy_of: Callable[[NDArray[np.intp]], Policy],
    count: int,
    env: VectorEnv,
    *,
    episodes: int,
    seed: int,
    gamma: float,
) -> list[Evaluation]:
    """Run ``episodes`` greedy episodes of each of ``count`` policies, all on the same seeds, in parallel.

    For N indices ``policy_of`` gives the policy that acts in environment n as the policy at the n-th index does.
    Returns an evaluation per policy, without utilities; the other arguments are those of :func:`evaluate`.
    """
    adapter = EnvAdapter(env)
    check_same_task(policy_of(np.zeros(1, dtype=np.intp)).env, adapter)
    check_memory(f"{episodes} episodes of each of {count} policies", count * episodes * EPISODE_BYTES)
    policies = np.repeat(np.arange(count), episodes)
    seeds = seed + np.tile(np.arange(episodes), count)
    columns = _in_batches(lambda rows: policy_of(policies[rows]), adapter, seeds, gamma, None)
    parts = [np.split(column, count) for column in columns]
    about = _provenance(adapter, seed, gamma, greedy=True)
    return [Evaluation(adapter.objectives, (), *part, provenance=about) for part in zip(*parts, strict=True)]


def _in_batches(
    policy_of: Callable[[NDArray[np.intp]], Policy],
    adapter: EnvAdapter,
    seeds: NDArray[np.int64],
    gamma: float,
    generator: torch.Generator | None,
) -> list[NDArray[Any]]:
    """One episode per seed, as many at a time as there are environments: the arrays of Evaluation in their order."""
    batches = []
    for first in range(0, len(seeds), adapter.num_envs):
        # In the last batch the environments that are left over repeat its last episode.
        rows = np.minimum(first + np.arange(adapter.num_envs), len(seeds) - 1)
        count = min(adapter.num_envs, len(seeds) - first)
        episodes = _first_episodes(policy_of(rows), adapter, seeds[rows].tolist(), gamma, generator)
        batches.append([array[:count] for array in episodes])
    return [np.concatenate(column) for column in zip(*batches, strict=True)]


def _first_episodes(
    policy: Policy, adapter: EnvAdapter, seeds: list[int], gamma: float, generator: torch.Generator | None
) -> tuple[NDArray[Any], ...]:
    """The first episode of every environment after a reset."""
    n, v, d = adapter.num_envs, adapter.vehicles, len(adapter.objectives)
    returns, discounted, largest = np.zeros((3, n, v, d))
    lengths = np.zeros((n, v), dtype=np.int64)
    succeeded = np.zeros((n, v), dtype=np.bool_)
    ends = np.full((n, v), None, dtype=object)
    unfinished = np.ones(n, dtype=np.bool_)
    factor = 1.0
    for _, step, counted, running in drive(policy, adapter, adapter.reset(seeds), generator):
        rewards = np.where(counted[..., None], step.rewards, 0.0)
        returns += rewards
        discounted += factor * rewards
        factor *= gamma
        largest = np.maximum(largest, np.abs(rewards))
        lengths += counted
        succeeded |= counted & step.succeeded
        over = unfinished & ~running.any(axis=1)
        if step.ends is not None and over.any():
            ends[over] = step.ends.reshape(n, v)[over]
        unfinished &= ~over
    return returns, discounted, lengths, succeeded, ends, largest
