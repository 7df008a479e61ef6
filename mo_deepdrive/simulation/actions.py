"""From actions to target controls: steer (rad), throttle (m/s^2) and brake (1); see :mod:`.dynamics`.

A discrete action is a row of a table: target ``steer = decay * held + offset + curl / max(speed, 1)^2`` and a speed
change. Only "decay steer" depends on the held steer.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.state import MAX_ACCELERATION, RUNNING, STEER_RANGE, Records

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

# Columns of an action table, and the speed changes of its rows.
DECAY, OFFSET, CURL, SPEED_CHANGE = 0, 1, 2, 3
IDLE, MAINTAIN, DECREASE, INCREASE = 0, 1, 2, 3


@jit
def find_unknown(actions: NDArray[np.int64], count: int) -> int:
    """The first world with a discrete action (worlds, vehicles) outside [0, count), or -1."""
    for i in range(actions.shape[0]):
        for v in range(actions.shape[1]):
            if not 0 <= actions[i, v] < count:
                return i
    return -1


@jit
def find_infinite(actions: NDArray[np.floating]) -> int:
    """The first world with a continuous action (worlds, vehicles, 3) that is not finite, or -1."""
    for i in range(actions.shape[0]):
        for v in range(actions.shape[1]):
            for axis in range(actions.shape[2]):
                if not math.isfinite(actions[i, v, axis]):
                    return i
    return -1


@jit
def decode_discrete(
    worlds: Records, i: int, v: int, action: int, table: NDArray[np.float64], controls: NDArray[np.float64]
) -> None:
    """Write the target controls of vehicle ``v`` of world ``i`` for a row of ``table`` (actions, 4)."""
    # Random actions make branches slow, so these are selections of one value of several.
    vehicle = worlds[i, v]
    change = table[action, SPEED_CHANGE]
    speed = max(vehicle.speed, 1.0)
    steer = table[action, DECAY] * vehicle.steer + table[action, OFFSET] + table[action, CURL] / (speed * speed)
    drift = 0.99 if vehicle.speed > vehicle.previous_speed else 1.0
    drift = 1.01 if vehicle.speed < vehicle.previous_speed else drift
    throttle = 1.0 if change == INCREASE else 0.0
    throttle = vehicle.throttle * drift if change == MAINTAIN else throttle
    brake = 1.0 if vehicle.throttle == 0.0 else 0.0
    brake = brake if change == DECREASE else 0.0
    controls[i, v, 0] = steer
    controls[i, v, 1] = throttle
    controls[i, v, 2] = brake


@jit
def decode_continuous(
    i: int, v: int, steer: float, acceleration: float, brake: float, controls: NDArray[np.float64]
) -> None:
    """Write the target controls of a continuous action, clipped to [-1, 1]."""
    controls[i, v, 0] = min(max(steer, -1.0), 1.0) * STEER_RANGE
    controls[i, v, 1] = min(max(acceleration, -1.0), 1.0) * MAX_ACCELERATION
    controls[i, v, 2] = MAX_ACCELERATION * (1.0 + min(max(brake, -1.0), 1.0)) / 2


@jit
def decode(
    worlds: Records, i: int, v: int, actions: NDArray[Any], table: NDArray[np.float64], controls: NDArray[np.float64]
) -> None:
    """Write the target controls of the action that reaches vehicle ``v`` of world ``i`` now.

    That is the one of this decision or, where the state has room for pending actions, an earlier one; an idle one in
    the first decisions of an episode. Those of running vehicles are sent on their way.

    Args:
        worlds: (worlds, vehicles) of VEHICLE; what is pending changes.
        i: which world.
        v: which vehicle.
        actions: (worlds, vehicles) integers in [0, len(table)), or (worlds, vehicles, 3) finite numbers.
        table: (actions, 4), from :func:`mo_deepdrive.world.actions.action_table`; empty for continuous actions.
        controls: (worlds, vehicles, 3), written: steer (rad), throttle (m/s^2), brake.
    """
    vehicle = worlds[i, v]
    late = len(vehicle.pending)
    if actions.ndim == 2:
        action = int(actions[i, v])
        if late > 0:
            row = vehicle.decisions % late
            sent = action
            action = int(vehicle.pending[row, 0])
            if vehicle.end == RUNNING:
                vehicle.pending[row, 0] = sent
        decode_discrete(worlds, i, v, action, table, controls)
    else:
        decode_continuous(i, v, actions[i, v, 0], actions[i, v, 1], actions[i, v, 2], controls)
        if late > 0:
            row = vehicle.decisions % late
            for k in range(3):
                control = controls[i, v, k]
                controls[i, v, k] = vehicle.pending[row, k]
                if vehicle.end == RUNNING:
                    vehicle.pending[row, k] = control
