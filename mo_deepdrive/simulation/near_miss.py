"""Near misses: decisions after which a collision is close unless somebody brakes or turns."""

from __future__ import annotations

from mo_deepdrive.simulation.geometry import time_to_collision
from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.state import COLLISION, RUNNING, Record, Records
from mo_deepdrive.simulation.traffic import COS, SIN

# Below this time to collision encounters in towns are conflicts: the threshold of A. R. A. van der Horst and J.
# Hogema, "Time-to-collision and collision avoidance systems", ICTCT workshop, 1993, and the default of the Surrogate
# Safety Assessment Model (D. Gettman et al., FHWA-HRT-08-051, 2008).
CONFLICT_TIME = 1.5  # s


@jit
def near_miss(worlds: Records, i: int, v: int, params: Record) -> float:  # noqa: ARG001  (the signature of a measure)
    """1 if the least time to collision with another vehicle or an oncoming car is below CONFLICT_TIME, else 0.

    It is taken after the decision; every box keeps its velocity and its heading
    (:func:`mo_deepdrive.simulation.geometry.time_to_collision`). Cars whose paths do not meet have none.
    """
    me = worlds[i, v]
    for k in range(worlds.shape[1]):
        # A vehicle that has collided has done so in this decision, and with this one.
        other = worlds[i, k]
        if k != v and (other.end == RUNNING or other.end == COLLISION):
            time = time_to_collision(
                other.x - me.x,
                other.y - me.y,
                other.vx - me.vx,
                other.vy - me.vy,
                me.cos_heading,
                me.sin_heading,
                other.cos_heading,
                other.sin_heading,
            )
            if time < CONFLICT_TIME:
                return 1.0
    for k in range(len(me.cars)):
        if me.cars[k].present:
            car = me.cars[k]
            time = time_to_collision(
                car.x - me.x, car.y - me.y, -me.vx, -car.speed - me.vy, me.cos_heading, me.sin_heading, COS, SIN
            )
            if time < CONFLICT_TIME:
                return 1.0
    return 0.0
