"""From what a rule wants, a steer and a speed, to the actions of an environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.simulation.actions import CURL, DECAY, DECREASE, INCREASE, MAINTAIN, OFFSET, SPEED_CHANGE
from mo_deepdrive.simulation.state import MAX_ACCELERATION, STEER_RANGE
from mo_deepdrive.world.observation import OWN

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

PREFIX = "rule:"  # of the names of scripted drivers
COLUMN = {entry.name: column for column, entry in enumerate(OWN)}

# Of the simulator's vehicle, by its equations of motion (docs/simulator.md).
CURVATURE_PER_STEER = 8.4  # 1/m per rad
DRAG = 0.06  # deceleration by friction (m/s^2) per m/s
BRAKING = 2.45  # deceleration (m/s^2) per m/s and unit of brake
DECISION = 0.1  # s
THROTTLE = 1.0  # m/s^2, of the discrete actions

SLACK = 0.04
SOFT_CHANGE = 0.15  # m/s^2 by which the throttle changes in a decision, of continuous actions


def braking_distance(speed: Floats) -> Floats:
    """How far (m) a vehicle with a speed (m/s) drives until it stands, braking fully from the next decision on."""
    return speed * (1.0 / BRAKING + 1.5 * DECISION)


def discrete_actions(
    seen: Floats,
    steer: Floats,
    target: Floats,
    brakes: NDArray[np.bool_],
    table: Floats,
    *,
    slack: float = SLACK,
    calm: float = 0.0,
) -> NDArray[Any]:
    """The actions (N,) whose change of speed is the right one and whose steering comes nearest.

    Args:
        seen: observations (N, size).
        steer: (N,) wanted (rad).
        target: (N,) speed (m/s).
        brakes: (N,) whether to brake.
        table: of the action set.
        slack: share of the target speed that may be lost before the vehicle speeds up again.
        calm: by how much a change of the steering counts, where 1 is as much as what it is off.
    """
    speed, throttle = seen[:, COLUMN["speed"]], seen[:, COLUMN["throttle"]]
    wanted = np.where(throttle > 0.0, target, target * (1.0 - slack))
    change = np.where(speed < wanted, INCREASE, np.where(throttle > 0.0, DECREASE, MAINTAIN))
    change = np.where(brakes, DECREASE, change)
    offered = (
        table[:, DECAY] * seen[:, COLUMN["steer"], None]
        + table[:, OFFSET]
        + table[:, CURL] / np.maximum(speed, 1.0)[:, None] ** 2
    )
    error = np.abs(offered - steer[:, None])
    if calm:
        error += calm * np.abs(offered - seen[:, COLUMN["steer"], None])
    return np.asarray(np.where(table[:, SPEED_CHANGE] == change[:, None], error, np.inf).argmin(axis=1))


def continuous_actions(
    seen: Floats, steer: Floats, target: Floats, brakes: NDArray[np.bool_], room: Floats
) -> NDArray[Any]:
    """The actions (N, 3); the arguments are those of :func:`discrete_actions`, but ``room`` (N,) to stop in (m)."""
    speed, throttle = seen[:, COLUMN["speed"]], seen[:, COLUMN["throttle"]]
    wanted = np.clip(target - speed, 0.0, THROTTLE) + DRAG * speed
    wanted = np.where(brakes | (target < speed - 0.5), 0.0, wanted)
    push = np.clip(wanted, throttle - SOFT_CHANGE, throttle + SOFT_CHANGE)
    push = np.where(brakes, 0.0, np.clip(push, 0.0, MAX_ACCELERATION))
    # To rest within the distance that is left: v' = -BRAKING b v, so b = v / (BRAKING distance).
    brake = np.where(brakes, speed / (BRAKING * np.maximum(room, 0.3 * np.maximum(speed, 0.5))), 0.0)
    actions = (steer / STEER_RANGE, push / MAX_ACCELERATION, 2.0 * brake / MAX_ACCELERATION - 1.0)
    return np.clip(np.stack(actions, axis=1), -1.0, 1.0).astype(np.float32)
