"""Near misses: decisions after which a collision is close unless somebody brakes or turns."""

from __future__ import annotations

import math

from mo_deepdrive.simulation.geometry import RADIUS, time_to_collision
from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.state import KERNEL_NAMES, RUNNING, Record, Records

MARGIN = 0.01  # m, for rounding
CRASH = KERNEL_NAMES.index("collision")


@jit
def is_near(me: Record, other: Record, vx: float, vy: float, conflict_time: float) -> bool:
    """Whether the time to collision with another box of velocity (vx, vy) is below ``conflict_time`` (s)."""
    dx, dy, dvx, dvy = other.x - me.x, other.y - me.y, vx - me.vx, vy - me.vy
    reach = 2 * RADIUS + MARGIN + conflict_time * math.sqrt(dvx * dvx + dvy * dvy)
    if dx * dx + dy * dy > reach * reach:
        return False
    cos, sin = me.cos_heading, me.sin_heading
    time = time_to_collision(dx, dy, dvx, dvy, cos, sin, other.cos_heading, other.sin_heading)
    return time < conflict_time


@jit
def near_miss(worlds: Records, i: int, v: int, params: Record) -> float:
    """1 if the least time to collision with another vehicle or a car is below ``params.conflict_time``, else 0.

    It is taken after the decision; every box keeps its velocity and its heading
    (:func:`mo_deepdrive.simulation.geometry.time_to_collision`). Cars whose paths do not meet have none.
    """
    me = worlds[i, v]
    for k in range(worlds.shape[1]):
        # A vehicle that has collided in this decision counts.
        other = worlds[i, k]
        there = k != v and (other.end == RUNNING or other.objectives[CRASH] == 1.0)
        if there and is_near(me, other, other.vx, other.vy, params.conflict_time):
            return 1.0
    for k in range(len(worlds[i, 0].cars)):
        car = worlds[i, 0].cars[k]
        vx, vy = -car.sin_heading * car.speed, car.cos_heading * car.speed
        if car.present and is_near(me, car, vx, vy, params.conflict_time):
            return 1.0
    return 0.0
