"""Near misses: decisions after which a collision is close unless somebody brakes or turns."""

from __future__ import annotations

import math
from typing import Any

from mo_deepdrive.simulation.geometry import RADIUS, time_to_collision
from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.state import COLLISION, RUNNING, Record

# Below this time to collision encounters in towns are conflicts: the threshold of A. R. A. van der Horst and J.
# Hogema, "Time-to-collision and collision avoidance systems", ICTCT workshop, 1993, and the default of the Surrogate
# Safety Assessment Model (D. Gettman et al., FHWA-HRT-08-051, 2008).
CONFLICT_TIME = 1.5  # s
MARGIN = 0.01  # m, for rounding


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
def near_miss(vehicles: Any, v: int, params: Any) -> float:
    """1 if the least time to collision with another vehicle or a car is below ``params.conflict_time``, else 0.

    It is taken after the decision; every box keeps its velocity and its heading
    (:func:`mo_deepdrive.simulation.geometry.time_to_collision`). Cars whose paths do not meet have none.
    """
    me = vehicles[v]
    for k in range(len(vehicles)):
        # A vehicle that has collided has done so in this decision.
        there = k != v and (vehicles[k].end == RUNNING or vehicles[k].end == COLLISION)
        if there and is_near(me, vehicles[k], vehicles[k].vx, vehicles[k].vy, params.conflict_time):
            return 1.0
    for k in range(len(vehicles[0].cars)):
        car = vehicles[0].cars[k]
        vx, vy = -car.sin_heading * car.speed, car.cos_heading * car.speed
        if car.present and is_near(me, car, vx, vy, params.conflict_time):
            return 1.0
    return 0.0
