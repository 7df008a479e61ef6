"""Collisions of solid shapes along their paths in one decision.

Shapes are tested at every physics step. If a vehicle moves or turns by more than a quarter of its width within a step,
poses in between are tested, too, so that nothing passes through anything at any speed.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from mo_deepdrive.simulation.dynamics import PATH_COS, PATH_SIN, PATH_X, PATH_Y
from mo_deepdrive.simulation.geometry import RADIUS, boxes_overlap, distance, segment_touches_box
from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.state import WIDTH, Record

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

LONGEST_MOVE = WIDTH / 4


@jit
def sweep(path: NDArray[np.float64], v: int, i: int) -> float:
    """Upper bound of the distance that any point of the vehicle moves in physics step ``i`` of ``path`` (m)."""
    turn = distance(path[v, i, PATH_COS], path[v, i, PATH_SIN], path[v, i - 1, PATH_COS], path[v, i - 1, PATH_SIN])
    move = distance(path[v, i, PATH_X], path[v, i, PATH_Y], path[v, i - 1, PATH_X], path[v, i - 1, PATH_Y])
    return move + turn * RADIUS


@jit
def pose(path: NDArray[np.float64], v: int, i: int, part: float) -> tuple[float, float, float, float]:
    """x, y, cos, sin of vehicle ``v`` at the fraction ``part`` of physics step ``i``; row ``i`` if it is 1."""
    if part == 1.0:
        return path[v, i, PATH_X], path[v, i, PATH_Y], path[v, i, PATH_COS], path[v, i, PATH_SIN]
    rest = 1.0 - part
    cos = rest * path[v, i - 1, PATH_COS] + part * path[v, i, PATH_COS]
    sin = rest * path[v, i - 1, PATH_SIN] + part * path[v, i, PATH_SIN]
    norm = math.sqrt(cos * cos + sin * sin)
    if norm == 0.0:
        cos, sin, norm = path[v, i, PATH_COS], path[v, i, PATH_SIN], 1.0
    x = rest * path[v, i - 1, PATH_X] + part * path[v, i, PATH_X]
    y = rest * path[v, i - 1, PATH_Y] + part * path[v, i, PATH_Y]
    return x, y, cos / norm, sin / norm


@jit
def hits_obstacle(vehicle: Record, k: int, moved: float, params: Record, path: NDArray[np.float64]) -> bool:
    """Whether the vehicle touches the obstacle, a segment, whose ends are the rows ``k`` and ``k`` + 1."""
    n = params.physics_steps
    ax = vehicle.obstacle[k, 0]
    ay = vehicle.obstacle[k, 1]
    bx = vehicle.obstacle[k + 1, 0]
    by = vehicle.obstacle[k + 1, 1]
    reach = RADIUS + distance(ax, ay, bx, by) / 2
    mid_x = (ax + bx) / 2
    mid_y = (ay + by) / 2
    if distance(path[0, n, PATH_X], path[0, n, PATH_Y], mid_x, mid_y) > reach + moved:
        return False
    for i in range(1, n + 1):
        pieces = 1 + int(sweep(path, 0, i) / LONGEST_MOVE)
        for piece in range(1, pieces + 1):
            x, y, cos, sin = pose(path, 0, i, piece / pieces)
            if distance(x, y, mid_x, mid_y) <= reach and segment_touches_box(x, y, cos, sin, ax, ay, bx, by):
                return True
    return False


@jit
def hits_any_obstacle(vehicle: Record, moved: float, params: Record, path: NDArray[np.float64]) -> bool:
    """Whether the vehicle touches one of its obstacles anywhere on its path of length ``moved`` (m)."""
    hit = False
    for k in range(0, len(vehicle.obstacle), 2):
        hit = hit or hits_obstacle(vehicle, k, moved, params, path)
    return hit


@jit
def vehicles_collide(first: Record, second: Record, moved: float, params: Record, path: NDArray[np.float64]) -> bool:
    """Whether the boxes of two vehicles overlap anywhere on their paths (2, steps + 1, 4)."""
    if distance(first.x, first.y, second.x, second.y) > 2 * RADIUS + moved:
        return False
    for i in range(1, params.physics_steps + 1):
        pieces = 1 + int(max(sweep(path, 0, i), sweep(path, 1, i)) / LONGEST_MOVE)
        for piece in range(1, pieces + 1):
            ax, ay, a_cos, a_sin = pose(path, 0, i, piece / pieces)
            bx, by, b_cos, b_sin = pose(path, 1, i, piece / pieces)
            near = distance(ax, ay, bx, by) <= 2 * RADIUS
            if near and boxes_overlap(ax, ay, a_cos, a_sin, bx, by, b_cos, b_sin):
                return True
    return False
