"""The environments of these tests: short episodes, so that a few hundred steps have several ends."""

from __future__ import annotations

from typing import Any

import gymnasium
import mo_gymnasium
import numpy as np
import pytest

import mo_deepdrive
from mo_deepdrive.world.scenarios import VERSIONS
from mo_deepdrive.wrappers import UtilityReward

ONE_WAYPOINT = "mo-deepdrive-one-waypoint-v0"
INTERSECTION = "mo-deepdrive-intersection-v0"
LEFT_TURN = "mo-deepdrive-left-turn-v0"
SHORT = {"time_limit": 2.0}
TWO = {**SHORT, **VERSIONS["intersection"]["v0"]}  # for PettingZoo, whose default is the newest version
VEHICLES = ("vehicle_0", "vehicle_1")
# Weights of MOMAland's LinearizeReward.
WEIGHTS = {agent: np.array([0.1, 1.0, 0.1, 1.0, 0.0, 0.1]) for agent in VEHICLES}


def single(env_id: str = ONE_WAYPOINT, **options: Any) -> Any:
    """A single environment with vector rewards, as a user makes it."""
    return mo_gymnasium.make(env_id, **{**SHORT, **options})


def scalar(**options: Any) -> Any:
    """A single environment whose reward is the utility."""
    return UtilityReward(single(**options), "one_waypoint_linear")


def vector(env_id: str = ONE_WAYPOINT, num_envs: int = 3, **options: Any) -> Any:
    """The native vector environment."""
    return gymnasium.make_vec(env_id, num_envs=num_envs, **{**SHORT, **options})


def parallel(**options: Any) -> Any:
    """The parallel environment of two vehicles."""
    return mo_deepdrive.parallel_env(**{**TWO, **options})


def aec(**options: Any) -> Any:
    """The environment of two vehicles that act in turns; skips the test without MOMAland."""
    pytest.importorskip("momaland", reason="MOMAland is not installed: it converts to AEC")
    return mo_deepdrive.env(**{**TWO, **options})


def one_leaves_early(agents: list[str]) -> dict[str, int]:
    """Actions with which ``vehicle_0`` ends within a second in environments with ``harmful_g_force=0.1``."""
    return {agent: 3 if agent == "vehicle_0" else 0 for agent in agents}
