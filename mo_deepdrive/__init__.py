"""MO-DeepDrive: multi-objective driving environments for Gymnasium and MO-Gymnasium.

Importing the package registers ``mo-deepdrive-one-waypoint-v0``, ``mo-deepdrive-static-obstacle-v0`` and
``mo-deepdrive-intersection-v0``.
"""

from __future__ import annotations

import gymnasium

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
    vector_entry_point=_VECTOR,
    kwargs={"scenario": "intersection"},
)
