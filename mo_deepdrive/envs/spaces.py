"""The spaces of an environment, derived from its configuration. They are finite and contain every value."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from gymnasium import spaces

from mo_deepdrive.world import actions, observation
from mo_deepdrive.world.limits import limits, objective_bound
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES, signs
from mo_deepdrive.world.params import chosen_objectives

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mo_deepdrive.world.config import EnvConfig


def observation_space(config: EnvConfig) -> spaces.Box:
    """The observation of one vehicle: float32, shape (size,), SI units; entries in ``observation.layout``."""
    low, high = observation.bounds(config.scenario_data, limits(config))
    return spaces.Box(low, high, dtype=np.float32)


def observation_scales(config: EnvConfig) -> NDArray[np.float32]:
    """Nominal magnitudes of the observation of one vehicle, by which learners divide: (size,)."""
    return observation.scales(config.scenario_data).astype(np.float32)


def action_space(config: EnvConfig) -> spaces.Discrete | spaces.Box:
    """The action of one vehicle: Discrete(22), Discrete(16) or Box(-1, 1, (3,)) (steer, acceleration, brake)."""
    if config.action_type == actions.CONTINUOUS:
        return spaces.Box(-1.0, 1.0, (3,), dtype=np.float32)
    return spaces.Discrete(len(actions.action_table(config.action_type)))


def reward_space(config: EnvConfig) -> spaces.Box:
    """The vector reward of one vehicle in one decision: float32, shape (d,), finite."""
    names = chosen_objectives(config)
    high = np.array([objective_bound(name, config) for name in names])
    low = np.where([OBJECTIVES[INDEX[name]].signed for name in names], -high, 0.0)
    if config.cost_sign == "maximise":
        sign = signs(names)
        low, high = np.where(sign > 0, low, -high), np.where(sign > 0, high, -low + 0.0)
    return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
