"""MO-DeepDrive: multi-objective driving environments for Gymnasium, MO-Gymnasium, PettingZoo and MOMAland.

Importing the package registers ``mo-deepdrive-one-waypoint-v0``, ``mo-deepdrive-static-obstacle-v0`` and
``mo-deepdrive-intersection-v0``. :func:`parallel_env` and :func:`env` make the multi-agent environments,
:func:`reference_point` and :func:`reference_front` tell what returns are compared with.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium

if TYPE_CHECKING:
    from pettingzoo import AECEnv

    from mo_deepdrive.envs.parallel import DrivingParallelEnv
    from mo_deepdrive.fronts import reference_front, reference_point

__all__ = ["env", "parallel_env", "raw_env", "reference_front", "reference_point"]

__version__ = "0.2.0"

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


def __getattr__(name: str) -> Any:
    """What is imported when it is first asked for: registering the ids alone takes no time."""
    if name in ("reference_front", "reference_point"):
        from mo_deepdrive import fronts

        return getattr(fronts, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


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
