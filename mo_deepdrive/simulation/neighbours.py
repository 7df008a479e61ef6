"""What a vehicle on roads of segments observes of its route and of the nearest others."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from mo_deepdrive.simulation import roads
from mo_deepdrive.simulation.jit import separate_jit
from mo_deepdrive.simulation.state import RUNNING, Record, Records

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

NEIGHBOURS = 5  # the nearest vehicles and cars that an observation has room for
NEIGHBOUR_ENTRIES = 9  # of each
ROAD_ENTRIES = 3


@separate_jit
def write_neighbour(
    me: Record, other: Record, vx: float, vy: float, i: int, v: int, column: int, params: Record,
    out: NDArray[np.float32],
) -> None:  # fmt: skip
    """Write what ``me`` observes of another vehicle or car with the velocity (vx, vy) from ``column`` on."""
    cos, sin = me.cos_heading, me.sin_heading
    dx, dy = other.x - me.x, other.y - me.y
    inside = roads.is_inside(params, other.route, other.route_distance)
    entering = me.route_distance < params.priority[me.route, 0]
    out[i, v, column] = dx * cos + dy * sin
    out[i, v, column + 1] = dy * cos - dx * sin
    out[i, v, column + 2] = vx * cos + vy * sin
    out[i, v, column + 3] = vy * cos - vx * sin
    out[i, v, column + 4] = cos * other.cos_heading + sin * other.sin_heading
    out[i, v, column + 5] = cos * other.sin_heading - sin * other.cos_heading
    out[i, v, column + 6] = 1.0 if inside else 0.0
    out[i, v, column + 7] = 1.0 if inside and entering else 0.0
    out[i, v, column + 8] = 1.0


@separate_jit
def write(
    worlds: Records, i: int, v: int, position: int, absent: float, params: Record, out: NDArray[np.float32]
) -> None:
    """Write what vehicle ``v`` of world ``i`` observes of its route and of the nearest others, from ``position`` on.

    Where there are fewer others than an observation has room for, their distance ahead is ``absent`` (m).
    """
    me = worlds[i, v]
    vehicles = worlds.shape[1]
    bodies = vehicles + len(worlds[i, 0].cars)
    out[i, v, position] = max(0.0, params.priority[me.route, 0] - me.route_distance)
    out[i, v, position + 1] = params.route_length[me.route] - me.route_distance
    out[i, v, position + 2] = me.heading_error
    column = position + ROAD_ENTRIES
    # The squares of the distances and the numbers of the nearest five, the nearest one first.
    s0, s1, s2, s3, s4 = math.inf, math.inf, math.inf, math.inf, math.inf
    n0, n1, n2, n3, n4 = -1, -1, -1, -1, -1
    for b in range(bodies):
        if b < vehicles:
            present = b != v and worlds[i, b].end == RUNNING
            dx, dy = worlds[i, b].x - me.x, worlds[i, b].y - me.y
        else:
            present = worlds[i, 0].cars[b - vehicles].present
            dx, dy = worlds[i, 0].cars[b - vehicles].x - me.x, worlds[i, 0].cars[b - vehicles].y - me.y
        square = dx * dx + dy * dy
        if present and square < s4:
            s4, n4 = square, b
            if s4 < s3:
                s3, s4, n3, n4 = s4, s3, n4, n3
            if s3 < s2:
                s2, s3, n2, n3 = s3, s2, n3, n2
            if s2 < s1:
                s1, s2, n1, n2 = s2, s1, n2, n1
            if s1 < s0:
                s0, s1, n0, n1 = s1, s0, n1, n0
    for found in (n0, n1, n2, n3, n4):
        if found < 0:
            for entry in range(NEIGHBOUR_ENTRIES):
                out[i, v, column + entry] = 0.0
            out[i, v, column + 1] = absent
        elif found < vehicles:
            other = worlds[i, found]
            write_neighbour(me, other, other.vx, other.vy, i, v, column, params, out)
        else:
            car = worlds[i, 0].cars[found - vehicles]
            vx, vy = -car.speed * car.sin_heading, car.speed * car.cos_heading
            write_neighbour(me, car, vx, vy, i, v, column, params, out)
        column += NEIGHBOUR_ENTRIES
