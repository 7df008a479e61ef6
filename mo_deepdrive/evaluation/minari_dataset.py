"""Trajectories of a policy as a Minari data set, with vector rewards.

It needs Minari, which nothing else in the package imports: ``pip install --editable ".[minari]"``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mo_gymnasium
import numpy as np

from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.episodes import as_policy
from mo_deepdrive.evaluation.policy import AccruedReward, seeded_generator
from mo_deepdrive.evaluation.splits import FIRST_TRAINING_SEED
from mo_deepdrive.support.faults import check_vehicles

try:
    import h5py  # noqa: F401  (Minari imports it and Pillow when it has recorded everything)
    import minari
    import PIL  # noqa: F401
    from minari.data_collector import EpisodeBuffer
except ImportError as error:
    raise ImportError('recording a data set needs Minari: pip install --editable ".[minari]"') from error

if TYPE_CHECKING:
    from collections.abc import Mapping

    import gymnasium
    import torch

    from mo_deepdrive.evaluation.policy import Policy, PolicyFunction

DATA_FORMAT = "hdf5"  # Minari's other formats flatten the rewards of an episode, which breaks vectors


def record_dataset(
    policy: Policy | PolicyFunction,
    env_id: str,
    dataset_id: str,
    *,
    episodes: int = 100,
    seed: int = FIRST_TRAINING_SEED,
    env_kwargs: Mapping[str, Any] | None = None,
    greedy: bool = True,
    gamma: float = 0.99,
    **metadata: Any,
) -> minari.MinariDataset:
    """Record episodes of a policy as a Minari data set, which ``minari.load_dataset(dataset_id)`` opens again.

    An episode of T decisions has observations (T + 1, ...), actions (T, ...) and float32 vector rewards (T, d) as the
    Gymnasium environment returns and takes them, and its seed as metadata. Minari needs the same infos at every step:
    one that comes only at some steps, such as "end" and "success" at the last, is empty, False or 0 at the others.

    Args:
        policy: an agent or a function, as :func:`mo_deepdrive.evaluation.evaluate` takes it.
        env_id: the environment, with one vehicle; also ``module:id``.
        dataset_id: ``namespace/name-v0``, as Minari takes it; it must not exist.
        episodes: how many.
        seed: of the first episode, counting up; by default of the training scenarios, so that what is learned from the
            data can be scored on the validation and test splits.
        env_kwargs: arguments of the environment.
        greedy: of an agent, take the most likely (or mean) action instead of sampling.
        gamma: discount factor of the accrued reward that a function is given; an agent has its own.
        **metadata: further arguments of ``minari.create_dataset_from_buffers``, such as ``algorithm_name`` and
            ``description``.

    Raises:
        ImportError: if Minari is not installed.
        TypeError: for an unknown environment argument, or a policy that is neither an agent nor a function.
        ValueError: for an environment with several vehicles, or a data set that exists.
    """
    if dataset_id in minari.list_local_datasets():
        raise ValueError(f"dataset_id = {dataset_id!r} exists; minari.delete_dataset deletes it")
    arguments = dict(env_kwargs or {})
    shapes = make_env(env_id, 1, arguments)
    env = mo_gymnasium.make(env_id, **arguments)
    try:
        adapter = EnvAdapter(shapes)
        if adapter.vehicles > 1:
            raise ValueError(f"env_id = {env_id!r} has {adapter.vehicles} vehicles; a Minari data set holds one agent")
        actor = as_policy(policy, adapter, gamma=gamma)
        generator = None if greedy else seeded_generator(actor, seed)
        buffers = [_episode(env, adapter, actor, generator, seed + i) for i in range(episodes)]
        return minari.create_dataset_from_buffers(dataset_id, buffers, env=env, data_format=DATA_FORMAT, **metadata)
    finally:
        env.close()
        shapes.close()


def _episode(
    env: gymnasium.Env[Any, Any], adapter: EnvAdapter, policy: Policy, generator: torch.Generator | None, seed: int
) -> EpisodeBuffer:
    observation, info = env.reset(seed=seed)
    accrued_reward = AccruedReward.begin(1, 1, len(adapter.objectives))
    observations, infos, steps = [observation], [info], []
    for _ in adapter.decisions():
        seen = adapter.policy_observations(np.asarray(observation)[None])
        check_vehicles("observation", seen, adapter.name)
        action = adapter.environment_actions(policy.act(seen, accrued_reward, generator))[0]
        observation, reward, terminated, truncated, info = env.step(action)
        vector = np.asarray(reward, dtype=np.float32)
        check_vehicles("reward", vector[None, None], adapter.name, adapter.objectives)
        accrued_reward.add(vector[None, None], policy.gamma)
        observations.append(observation)
        infos.append(info)
        steps.append((action, vector, terminated, truncated))
        if terminated or truncated:
            break
    absent = {name: np.zeros_like(value)[()] for info in infos for name, value in info.items()}
    infos_by_name = {name: [info.get(name, value) for info in infos] for name, value in absent.items()}
    columns = map(list, zip(*steps, strict=True))
    named = dict(zip(("actions", "rewards", "terminations", "truncations"), columns, strict=True))
    return EpisodeBuffer(seed=seed, observations=observations, infos=infos_by_name, **named)
