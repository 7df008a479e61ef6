"""Draw a scenario, check that it is fair, and place it in a world."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from mo_deepdrive.simulation import geometry, progress, road_traffic, roads, traffic
from mo_deepdrive.simulation.jit import jit, separate_jit
from mo_deepdrive.simulation.state import (
    ARRIVAL_RADIUS,
    HALF_LANE,
    LENGTH,
    MAP_UNIT,
    MAX_WAYPOINTS,
    NEVER,
    RUNNING,
    STANDSTILL_GAP,
    Record,
    Records,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

FIXED_DRAW = 0.2
# Half-way to the fixed destination, 3.45 m long, and within two degrees of perpendicular to the direct line.
FIXED_OBSTACLE_DRAWS = (0.4, 0.5, 0.2)

OBSTACLE_NEAREST = 0.1 * MAP_UNIT
OBSTACLE_REACH = 0.6
OBSTACLE_SHORTEST = 0.025 * MAP_UNIT
OBSTACLE_STRETCH = 0.1 * MAP_UNIT


@jit
def given(pinned: float, drawn: float) -> float:
    """The pinned value, or the drawn one where it is NaN."""
    return drawn if math.isnan(pinned) else pinned


@jit
def within(bounds: tuple[float, float], draw: float) -> float:
    """The number between ``bounds`` that belongs to a uniform in [0, 1)."""
    return bounds[0] + draw * (bounds[1] - bounds[0])


@jit
def draw_spawn(draws: NDArray[np.float64], j: int, params: Record, pins: Record, spawn: Record) -> None:
    """Fill ``spawn`` (record SPAWN) from ``pins``, or where they are NaN from the uniforms ``draws[j]`` (draws,)."""
    for k in range(len(spawn.spent)):
        spent = draws[j, params.spent_draw + k] * params.spent_span[k] if params.spent_span[k] > 0.0 else 0.0
        spawn.spent[k] = given(pins.spent[k], spent)
    if params.n_routes > 0:
        draw_queues(draws, j, params, pins, spawn)
        draw_drivers(draws, j, params, pins, spawn)
        return
    for v in range(params.vehicles):
        spawn.starts[v, 0] = given(pins.starts[v, 0], params.starts[v, 0])
        spawn.starts[v, 1] = given(pins.starts[v, 1], params.starts[v, 1] + draws[j, v] * params.start_span[v])
        spawn.starts[v, 2] = given(pins.starts[v, 2], params.starts[v, 2])
        for k in range(MAX_WAYPOINTS):
            for axis in range(2):
                spawn.waypoints[v, k, axis] = params.waypoints[v, k, axis]
    last = params.n_waypoints[0] - 1
    for axis in range(2):
        draw = FIXED_DRAW if params.fixed_destination else draws[j, params.destination_draw + axis]
        spawn.waypoints[0, last, axis] = given(
            pins.waypoints[0, last, axis], params.waypoints[0, last, axis] + draw * params.destination_span[axis]
        )
    start_x = spawn.starts[0, 0]
    start_y = spawn.starts[0, 1]
    route_x = spawn.waypoints[0, last, 0] - start_x
    route_y = spawn.waypoints[0, last, 1] - start_y
    route = math.sqrt(route_x * route_x + route_y * route_y)
    for k in range(len(spawn.obstacle) // 2):
        # Further bicycles are fixed at other places: 0.8, 0.2, 0.6 and 0.0 of the range.
        place_draw = FIXED_OBSTACLE_DRAWS[0] * (k + 1) % 1.0 if params.fixed_obstacle else draws[j, 3 * k + 2]
        length_draw = FIXED_OBSTACLE_DRAWS[1] if params.fixed_obstacle else draws[j, 3 * k + 3]
        angle_draw = FIXED_OBSTACLE_DRAWS[2] if params.fixed_obstacle else draws[j, 3 * k + 4]
        ratio = (OBSTACLE_REACH * place_draw * route + OBSTACLE_NEAREST) / route if route > 0.0 else 0.0
        half = (OBSTACLE_SHORTEST + OBSTACLE_STRETCH * length_draw) / 2
        for end in range(2):
            row = 2 * k + end
            side = half if end == 0 else -half
            spawn.obstacle[row, 0] = given(
                pins.obstacle[row, 0], start_x + ratio * route_x + side * math.cos(math.pi * angle_draw)
            )
            spawn.obstacle[row, 1] = given(
                pins.obstacle[row, 1], start_y + ratio * route_y + side * math.sin(math.pi * angle_draw)
            )
    spawn.n_cars = given(pins.n_cars, params.n_cars)
    for k in range(len(spawn.drivers)):
        first = params.driver_draw + 3 * k
        speed = traffic.drawn_speed(draws[j, first])
        headway = traffic.drawn_headway(draws[j, first + 1], params.mean_headway)
        yielding = traffic.drawn_yielding(draws[j, first + 2])
        spawn.drivers[k].desired_speed = given(pins.drivers[k].desired_speed, speed)
        spawn.drivers[k].headway = given(pins.drivers[k].headway, headway)
        spawn.drivers[k].yielding = given(pins.drivers[k].yielding, yielding)


@separate_jit
def draw_queues(draws: NDArray[np.float64], j: int, params: Record, pins: Record, spawn: Record) -> None:
    """Draw an entry, a route from there and a place in the queue at the entry, for every vehicle and car.

    Who draws an entry without room waits at the next one that has some. The first one in a queue has its front within
    the span of the entry from the end of the first segment, and everybody else within it behind the one ahead. In which
    order vehicles and cars queue begins with one that is drawn.
    """
    bodies = params.vehicles + len(spawn.drivers)
    for entry in range(params.n_entries):
        spawn.waiting[entry] = 0.0
        spawn.room[entry] = params.entry_length[entry]
    first = int(draws[j, 0] * bodies)
    for k in range(bodies):
        b = (first + k) % bodies
        draw = 1 + 3 * b
        entry = int(draws[j, draw] * params.n_entries)
        while spawn.waiting[entry] >= params.entry_room[entry]:
            entry = (entry + 1) % params.n_entries
        drawn = params.first_route[entry] + int(draws[j, draw + 1] * params.n_routes_there[entry])
        route = int(given(pins.routes[b], float(drawn)))
        entry = params.entry[route]
        furthest = spawn.room[entry] - draws[j, draw + 2] * params.entry_span[entry]
        distance = given(pins.distances[b], furthest)
        spawn.routes[b] = route
        spawn.distances[b] = distance
        spawn.waiting[entry] += 1.0
        spawn.room[entry] = min(spawn.room[entry], distance - LENGTH - STANDSTILL_GAP)
        x, y, cos, sin = roads.pose_at(params, route, distance - geometry.HALF_LENGTH)
        spawn.starts[b, 0] = x
        spawn.starts[b, 1] = y
        spawn.starts[b, 2] = math.atan2(sin, cos)


@separate_jit
def draw_drivers(draws: NDArray[np.float64], j: int, params: Record, pins: Record, spawn: Record) -> None:
    """Draw the drivers of the cars on roads of segments."""
    for k in range(len(spawn.drivers)):
        first = params.driver_draw + 3 * k
        driver, pinned = spawn.drivers[k], pins.drivers[k]
        driver.desired_speed = given(pinned.desired_speed, within(road_traffic.DESIRED_SPEED, draws[j, first]))
        driver.headway = given(pinned.headway, within(road_traffic.HEADWAY, draws[j, first + 1]))
        driver.accepted_gap = given(pinned.accepted_gap, within(road_traffic.ACCEPTED_GAP, draws[j, first + 2]))
        driver.yielding = traffic.MAX_BRAKING


@separate_jit
def queues_are_fair(spawn: Record, params: Record) -> bool:
    """Whether all vehicles and cars are on their first segment, and none touches another."""
    bodies = params.vehicles + len(spawn.drivers)
    for a in range(bodies):
        route = int(spawn.routes[a])
        if not LENGTH <= spawn.distances[a] <= params.entry_length[params.entry[route]]:
            return False
        x, y = spawn.starts[a, 0], spawn.starts[a, 1]
        for b in range(a):
            bx, by = spawn.starts[b, 0], spawn.starts[b, 1]
            if geometry.distance(x, y, bx, by) <= 2 * geometry.RADIUS and geometry.boxes_overlap(
                x, y, math.cos(spawn.starts[a, 2]), math.sin(spawn.starts[a, 2]),
                bx, by, math.cos(spawn.starts[b, 2]), math.sin(spawn.starts[b, 2]),
            ):  # fmt: skip
                return False
    return True


@jit
def distance_to_segment(px: float, py: float, ax: float, ay: float, bx: float, by: float) -> float:
    """Distance (m) from the point p to the segment a-b."""
    dx = bx - ax
    dy = by - ay
    square = dx * dx + dy * dy
    along = 0.0
    if square > 0.0:
        along = min(max(((px - ax) * dx + (py - ay) * dy) / square, 0.0), 1.0)
    return geometry.distance(px, py, ax + along * dx, ay + along * dy)


@jit
def spawn_is_fair(spawn: Record, params: Record) -> bool:
    """False if a bicycle or a car touches the vehicle at its start, or a bicycle is within 1 m of the destination.

    On roads of segments as :func:`queues_are_fair`.
    """
    if params.n_routes > 0:
        return queues_are_fair(spawn, params)
    if len(spawn.drivers) > 0 and traffic.touches_start(spawn):
        return False
    if not params.has_obstacle:
        return True
    last = params.n_waypoints[0] - 1
    heading = spawn.starts[0, 2]
    cos = math.cos(heading)
    sin = math.sin(heading)
    for k in range(0, len(spawn.obstacle), 2):
        ax = spawn.obstacle[k, 0]
        ay = spawn.obstacle[k, 1]
        bx = spawn.obstacle[k + 1, 0]
        by = spawn.obstacle[k + 1, 1]
        goal = distance_to_segment(spawn.waypoints[0, last, 0], spawn.waypoints[0, last, 1], ax, ay, bx, by)
        touches = geometry.segment_touches_box(spawn.starts[0, 0], spawn.starts[0, 1], cos, sin, ax, ay, bx, by)
        if goal <= ARRIVAL_RADIUS or touches:
            return False
    return True


@jit
def place(worlds: Records, i: int, spawn: Record, params: Record) -> None:
    """Put every vehicle of world ``i`` at rest at the start of its route."""
    for v in range(worlds.shape[1]):
        vehicle = worlds[i, v]
        heading = spawn.starts[v, 2]
        vehicle.x = spawn.starts[v, 0]
        vehicle.y = spawn.starts[v, 1]
        vehicle.heading = heading
        vehicle.start_heading = heading
        vehicle.cos_heading = math.cos(heading)
        vehicle.sin_heading = math.sin(heading)
        vehicle.cos_before = vehicle.cos_heading
        vehicle.sin_before = vehicle.sin_heading
        vehicle.speed = 0.0
        vehicle.previous_speed = 0.0
        vehicle.yaw_step = 0.0
        vehicle.vx = 0.0
        vehicle.vy = 0.0
        vehicle.ax = 0.0
        vehicle.ay = 0.0
        vehicle.g_force = 0.0
        vehicle.jerk = 0.0
        vehicle.steer = 0.0
        vehicle.throttle = 0.0
        vehicle.brake = 0.0
        vehicle.travelled = 0.0
        vehicle.decisions = 0
        for k in range(len(vehicle.pending)):
            for axis in range(3):
                vehicle.pending[k, axis] = 0.0
        vehicle.end = RUNNING
        vehicle.next_waypoint = 0
        vehicle.n_waypoints = params.n_waypoints[v]
        before_x = vehicle.x
        before_y = vehicle.y
        along = 0.0
        for k in range(MAX_WAYPOINTS):
            px = spawn.waypoints[v, k, 0]
            py = spawn.waypoints[v, k, 1]
            along += geometry.distance(before_x, before_y, px, py)
            vehicle.waypoints[k, 0] = px
            vehicle.waypoints[k, 1] = py
            vehicle.along[k] = along
            before_x = px
            before_y = py
        for k in range(len(vehicle.obstacle)):
            for axis in range(2):
                vehicle.obstacle[k, axis] = spawn.obstacle[k, axis]
        for k in range(len(vehicle.objectives)):
            vehicle.objectives[k] = 0.0
        for k in range(len(vehicle.spent)):
            vehicle.spent[k] = spawn.spent[k]
        vehicle.lane_centre = params.lane_centre[v]
        vehicle.left_lane_distance = HALF_LANE
        vehicle.right_lane_distance = HALF_LANE
        vehicle.crossing = False
        vehicle.approaching = False
        vehicle.route = int(spawn.routes[v]) if params.n_routes > 0 else 0
        vehicle.segment = 0
        vehicle.lane_offset = 0.0
        vehicle.heading_error = 0.0
        vehicle.entered = NEVER
        if params.n_routes > 0:
            roads.follow(vehicle, params)
            roads.find_lane(vehicle, params)
        else:
            progress.follow(vehicle)
            if params.has_lanes:
                progress.find_lane(vehicle, params)
        vehicle.furthest = max(0.0, vehicle.route_distance)
    if params.n_routes > 0:
        road_traffic.place(worlds, i, spawn, params)
    else:
        traffic.place(worlds, i, spawn)


def pin_nothing(spawn: Records) -> None:
    """Mark every entry of a SPAWN record array as not pinned."""
    for name in spawn.dtype.names or ():
        spawn[name] = np.nan
