"""MO-DeepDrive: multi-objective driving environments for Gymnasium, MO-Gymnasium, PettingZoo and MOMAland.

Importing the package registers ``mo-deepdrive-one-waypoint-v1``, ``mo-deepdrive-static-obstacle-v1``,
``mo-deepdrive-intersection-v1`` and ``mo-deepdrive-left-turn-v1``, and the same with ``v0``, and
``mo-deepdrive-roundabout-v0`` and ``mo-deepdrive-roundabout-solo-v0``. :func:`parallel_env` and :func:`env` make the
multi-agent environments, :func:`reference_point` and :func:`reference_front` are what returns are compared with.
:func:`register_objective` and :func:`register_scenario` add one's own.
"""

from __future__ import annotations

import importlib
import warnings
from typing import TYPE_CHECKING, Any

from mo_deepdrive.world.objectives import Objective, register_objective
from mo_deepdrive.world.routes import Route, Segment
from mo_deepdrive.world.scenarios import SCENARIOS, Scenario, register_id, register_scenario

if TYPE_CHECKING:
    from pettingzoo import AECEnv

    from mo_deepdrive.envs.parallel import DrivingParallelEnv
    from mo_deepdrive.fronts.reference_fronts import reference_front, reference_point

__all__ = [
    "Objective",
    "Route",
    "Scenario",
    "Segment",
    "env",
    "parallel_env",
    "raw_env",
    "reference_front",
    "reference_point",
    "register_objective",
    "register_scenario",
]

__version__ = "0.2.0"

for _scenario in SCENARIOS.values():
    register_id(_scenario)
# Earlier versions stay what results were published with, so Gymnasium's advice to leave them is wrong.
warnings.filterwarnings("ignore", "(?s).*The environment mo-deepdrive-.* is out of date")


def __getattr__(name: str) -> Any:
    """Import ``reference_front``, ``reference_point`` and the module ``parallel_v1`` when they are first used."""
    if name == "parallel_v1":
        return importlib.import_module("mo_deepdrive.parallel_v1")
    if name in ("reference_front", "reference_point"):
        return getattr(importlib.import_module("mo_deepdrive.fronts.reference_fronts"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def parallel_env(**kwargs: Any) -> DrivingParallelEnv:
    """The PettingZoo parallel environment with vector rewards, in the newest version of the scenario.

    Args:
        **kwargs: arguments of :class:`mo_deepdrive.envs.parallel.DrivingParallelEnv`: ``scenario`` (default:
            "intersection"), ``render_mode``, ``keep_finished`` and every field of
            :class:`mo_deepdrive.world.config.EnvConfig`.
    """
    return raw_env(**kwargs)


def env(**kwargs: Any) -> AECEnv:
    """The PettingZoo AEC environment with vector rewards, converted by MOMAland.

    Args:
        **kwargs: the arguments of :func:`parallel_env`.

    Raises:
        ImportError: if MOMAland is not installed (extra ``momaland``).
    """
    from mo_deepdrive.envs.parallel import aec_env

    return aec_env(raw_env(**kwargs))


def raw_env(**kwargs: Any) -> DrivingParallelEnv:
    """The environment behind :func:`parallel_env` and :func:`env`, without wrappers."""
    from mo_deepdrive.envs.parallel import DrivingParallelEnv

    return DrivingParallelEnv(**kwargs)
