"""MO-DeepDrive: multi-objective driving environments for Gymnasium, MO-Gymnasium, PettingZoo and MOMAland.

Importing the package registers ``mo-deepdrive-one-waypoint-v0``, ``mo-deepdrive-static-obstacle-v0`` and
``mo-deepdrive-intersection-v0``. :func:`parallel_env` and :func:`env` make the multi-agent environments.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium

if TYPE_CHECKING:
    from pettingzoo import AECEnv

    from mo_deepdrive.envs.parallel import DrivingParallelEnv

__all__ = ["env", "parallel_env", "raw_env"]

__version__ = "0.1.0"

_VECTOR = "mo_deepdrive.envs.vector:DrivingVectorEnv"
_SINGLE = "mo_deepdrive.envs.single:DrivingEnv"

gymnasium.register(
    "mo-deepdrive-one-waypoint-v0",
    entry_point=_SINGLE,
    vector_entry_point=_VECTOR,
    kwargs={"scenario": "one_waypoint"},
)
gymnasium.register(
    "mo-deepdrive-static-obstacle-v0",
    entry_point=_SINGLE,
    vector_entry_point=_VECTOR,
    kwargs={"scenario": "static_obstacle"},
)
gymnasium.register(
    "mo-deepdrive-intersection-v0",
    entry_point="mo_deepdrive.envs.turn_based:TurnBasedEnv",
    vector_entry_point=_VECTOR,
    kwargs={"scenario": "intersection"},
)


def parallel_env(**kwargs: Any) -> DrivingParallelEnv:
    """The PettingZoo parallel environment with vector rewards.

    Args:
        **kwargs: of :class:`mo_deepdrive.envs.parallel.DrivingParallelEnv`: ``scenario`` (the intersection unless
            named), ``render_mode``, ``keep_finished`` and every field of :class:`mo_deepdrive.config.EnvConfig`.
    """
    return raw_env(**kwargs)


def env(**kwargs: Any) -> AECEnv:
    """The PettingZoo AEC environment with vector rewards, by MOMAland's conversion.

    Args:
        **kwargs: as of :func:`parallel_env`.

    Raises:
        ImportError: where MOMAland is not installed: ``pip install "mo-deepdrive[momaland]"``.
    """
    from mo_deepdrive.envs.parallel import aec_env

    return aec_env(raw_env(**kwargs))


def raw_env(**kwargs: Any) -> DrivingParallelEnv:
    """The environment that :func:`parallel_env` and :func:`env` build on, without any wrapper."""
    from mo_deepdrive.envs.parallel import DrivingParallelEnv

    return DrivingParallelEnv(**kwargs)
