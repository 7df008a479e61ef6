"""Collisions of solid shapes along their paths in one decision.

Shapes are tested at every physics step. If a vehicle moves or turns by more than a quarter of its width within a step,
poses in between are tested, too, so that nothing passes through anything at any speed. A path, from ``dynamics.drive``,
is (vehicles, physics_steps + 1) of POSE, with one world per lane; below the vehicles it has the oncoming cars.
"""

from __future__ import annotations

import math

from mo_deepdrive.simulation.geometry import RADIUS, boxes_overlap, distance, segment_touches_box
from mo_deepdrive.simulation.jit import jit, separate_jit
from mo_deepdrive.simulation.state import RUNNING, WIDTH, Record, Records

LONGEST_MOVE = WIDTH / 4


@jit
def sweep(path: Records, v: int, i: int, lane: int) -> float:
    """Upper bound of the distance that any point of the vehicle moves in physics step ``i`` of ``path`` (m)."""
    before = path[v, i - 1]
    now = path[v, i]
    turn = distance(now.cos[lane], now.sin[lane], before.cos[lane], before.sin[lane])
    move = distance(now.x[lane], now.y[lane], before.x[lane], before.y[lane])
    return move + turn * RADIUS


@jit
def pose(path: Records, v: int, i: int, lane: int, part: float) -> tuple[float, float, float, float]:
    """x, y, cos, sin of vehicle ``v`` at the fraction ``part`` of physics step ``i``; row ``i`` if it is 1."""
    now = path[v, i]
    if part == 1.0:
        return now.x[lane], now.y[lane], now.cos[lane], now.sin[lane]
    before = path[v, i - 1]
    rest = 1.0 - part
    cos = rest * before.cos[lane] + part * now.cos[lane]
    sin = rest * before.sin[lane] + part * now.sin[lane]
    norm = math.sqrt(cos * cos + sin * sin)
    if norm == 0.0:
        cos, sin, norm = now.cos[lane], now.sin[lane], 1.0
    x = rest * before.x[lane] + part * now.x[lane]
    y = rest * before.y[lane] + part * now.y[lane]
    return x, y, cos / norm, sin / norm


@jit
def hits_obstacle(vehicle: Record, k: int, params: Record, path: Records, lane: int) -> bool:
    """Whether the vehicle touches the obstacle, a segment, whose ends are the rows ``k`` and ``k`` + 1."""
    n = params.physics_steps
    ax = vehicle.obstacle[k, 0]
    ay = vehicle.obstacle[k, 1]
    bx = vehicle.obstacle[k + 1, 0]
    by = vehicle.obstacle[k + 1, 1]
    reach = RADIUS + distance(ax, ay, bx, by) / 2
    mid_x = (ax + bx) / 2
    mid_y = (ay + by) / 2
    end = path[0, n]
    if distance(end.x[lane], end.y[lane], mid_x, mid_y) > reach + end.moved[lane]:
        return False
    for i in range(1, n + 1):
        pieces = 1 + int(sweep(path, 0, i, lane) / LONGEST_MOVE)
        for piece in range(1, pieces + 1):
            x, y, cos, sin = pose(path, 0, i, lane, piece / pieces)
            if distance(x, y, mid_x, mid_y) <= reach and segment_touches_box(x, y, cos, sin, ax, ay, bx, by):
                return True
    return False


@jit
def hits_any_obstacle(vehicle: Record, params: Record, path: Records, lane: int) -> bool:
    """Whether the vehicle touches one of its obstacles anywhere on its path."""
    hit = False
    for k in range(0, len(vehicle.obstacle), 2):
        hit = hit or hits_obstacle(vehicle, k, params, path, lane)
    return hit


@jit
def vehicles_collide(params: Record, path: Records, a: int, b: int, lane: int) -> bool:
    """Whether the boxes of two vehicles or cars of a world, the rows ``a`` and ``b`` of ``path``, overlap anywhere."""
    n = params.physics_steps
    first = path[a, n]
    second = path[b, n]
    moved = first.moved[lane] + second.moved[lane]
    if distance(first.x[lane], first.y[lane], second.x[lane], second.y[lane]) > 2 * RADIUS + moved:
        return False
    for i in range(1, n + 1):
        pieces = 1 + int(max(sweep(path, a, i, lane), sweep(path, b, i, lane)) / LONGEST_MOVE)
        for piece in range(1, pieces + 1):
            ax, ay, a_cos, a_sin = pose(path, a, i, lane, piece / pieces)
            bx, by, b_cos, b_sin = pose(path, b, i, lane, piece / pieces)
            near = distance(ax, ay, bx, by) <= 2 * RADIUS
            if near and boxes_overlap(ax, ay, a_cos, a_sin, bx, by, b_cos, b_sin):
                return True
    return False


@separate_jit
def find_collisions(worlds: Records, i: int, column: int, params: Record, path: Records, lane: int) -> None:
    """Write to ``objectives[column]`` of every vehicle of world ``i`` whether it touches something on its way: 1 or 0.

    That is one of its obstacles, another vehicle on the road, or a car that is present; only vehicles on the road do.
    """
    vehicles = worlds.shape[1]
    for v in range(vehicles):
        worlds[i, v].objectives[column] = 0.0
    for v in range(vehicles):
        vehicle = worlds[i, v]
        if vehicle.end == RUNNING:
            if params.has_obstacle and hits_any_obstacle(vehicle, params, path, lane):
                vehicle.objectives[column] = 1.0
            for other in range(v):
                if worlds[i, other].end == RUNNING and vehicles_collide(params, path, other, v, lane):
                    vehicle.objectives[column] = 1.0
                    worlds[i, other].objectives[column] = 1.0
            for k in range(len(worlds[i, 0].cars)):
                if worlds[i, 0].cars[k].present and vehicles_collide(params, path, v, vehicles + k, lane):
                    vehicle.objectives[column] = 1.0
