"""Cars with scripted drivers on roads of segments.

They keep to the middle of their lane and follow whoever is ahead on their route by the Intelligent Driver Model (see
``traffic.py``). Before the stretch where their route has right of way they give way: they stop for whoever is on such a
stretch and will be, within the gap that they accept, where their route joins the other. Accelerations are chosen once
per decision.
"""

from __future__ import annotations

from mo_deepdrive.simulation import geometry, roads
from mo_deepdrive.simulation.geometry import HALF_LENGTH, HALF_WIDTH
from mo_deepdrive.simulation.jit import separate_jit
from mo_deepdrive.simulation.state import LENGTH, NEVER, RUNNING, Record, Records
from mo_deepdrive.simulation.traffic import MAX_BRAKING, acceleration

# Distributions of what is drawn per car and episode, uniform: desired speeds of a compact roundabout (16 to 25 km/h),
# time gaps, and the range of the critical gaps that were observed at single-lane roundabouts (L. Rodegerdts et al.,
# "Roundabouts in the United States", NCHRP Report 572, 2007).
DESIRED_SPEED = (4.5, 7.0)  # m/s
HEADWAY = (0.8, 1.8)  # s
ACCEPTED_GAP = (4.2, 5.9)  # s
ACCEPTED_GAPS = (0.0, 60.0)  # s, what reset options may set

SIGHT = 40.0  # m, within which others are seen
STANDING = 1.0  # m/s; at less than this others are taken to come at this speed
ROUNDING = 1e-9  # m
_FREE = 1e9  # m; the gap to nobody


@separate_jit
def move_to(car: Record, params: Record, distance: float) -> None:
    """Put the front of the car ``distance`` (m) along its route, with its centre on the line."""
    x, y, cos, sin = roads.pose_at(params, car.route, distance - HALF_LENGTH)
    car.x = x
    car.y = y
    car.cos_heading = cos
    car.sin_heading = sin
    car.route_distance = distance


@separate_jit
def place(worlds: Records, i: int, spawn: Record, params: Record) -> None:
    """Put the cars of world ``i`` at rest at their places in the queues."""
    vehicles = worlds.shape[1]
    for k in range(len(worlds[i, 0].cars)):
        car = worlds[i, 0].cars[k]
        driver = spawn.drivers[k]
        car.route = int(spawn.routes[vehicles + k])
        move_to(car, params, spawn.distances[vehicles + k])
        car.entered = 0 if roads.is_inside(params, car.route, car.route_distance) else NEVER
        car.speed = 0.0
        car.acceleration = 0.0
        car.driver.desired_speed = driver.desired_speed
        car.driver.headway = driver.headway
        car.driver.yielding = driver.yielding
        car.driver.accepted_gap = driver.accepted_gap
        car.present = True


@separate_jit
def gap_on_route(params: Record, car: Record, x: float, y: float, half: float) -> float:
    """The gap (m) from the car's front to a point in its lane, less ``half``; _FREE if the point is not ahead in it."""
    route = car.route
    for k in range(params.n_segments[route]):
        segment = params.segments[route, k]
        ahead = segment.along + segment.length > car.route_distance
        if ahead and abs(roads.offset(segment, x, y)) < params.half_lane[route]:
            along = roads.projection(segment, x, y)
            if -ROUNDING <= along < segment.length:  # a point at a joint is on one of its segments
                gap = segment.along + along - car.route_distance
                return gap - half if gap > 0.0 else _FREE
    return _FREE


@separate_jit
def gap_ahead(params: Record, car: Record, x: float, y: float, cos: float, sin: float) -> float:
    """The gap (m) from the car's front to another body, to its rear or to whatever of it is in the lane."""
    to_rear = gap_on_route(params, car, x, y, HALF_LENGTH)
    front_x, front_y = geometry.corner(x, y, cos, sin, HALF_LENGTH, 0.0)
    return min(to_rear, gap_on_route(params, car, front_x, front_y, HALF_WIDTH))


@separate_jit
def blocks(params: Record, car: Record, route: int, distance: float, speed: float) -> bool:
    """Whether the car has to give way to a body with its front at ``distance`` (m) along another ``route``."""
    if not roads.is_inside(params, route, distance) or params.entry[route] == params.entry[car.route]:
        return False
    away = params.joins[car.route, route] - distance  # NaN where the routes do not join
    reached: bool = -LENGTH < away < max(speed, STANDING) * car.driver.accepted_gap
    return reached


@separate_jit
def chosen_acceleration(worlds: Records, i: int, k: int, params: Record) -> float:
    """The acceleration (m/s^2) of car ``k`` of world ``i`` until the next decision."""
    car = worlds[i, 0].cars[k]
    desired, time_gap = car.driver.desired_speed, car.driver.headway
    speed = car.speed
    change = acceleration(speed, desired, time_gap, _FREE, 0.0)
    stop = params.priority[car.route, 0] - car.route_distance
    blocked = False
    for v in range(worlds.shape[1]):
        other = worlds[i, v]
        if other.end == RUNNING and geometry.distance(car.x, car.y, other.x, other.y) < SIGHT:
            gap = gap_ahead(params, car, other.x, other.y, other.cos_heading, other.sin_heading)
            change = min(change, acceleration(speed, desired, time_gap, gap, speed - other.speed))
            blocked = blocked or blocks(params, car, other.route, other.route_distance, other.speed)
    for n in range(len(worlds[i, 0].cars)):
        other_car = worlds[i, 0].cars[n]
        if n != k and other_car.present and geometry.distance(car.x, car.y, other_car.x, other_car.y) < SIGHT:
            gap = gap_ahead(params, car, other_car.x, other_car.y, other_car.cos_heading, other_car.sin_heading)
            change = min(change, acceleration(speed, desired, time_gap, gap, speed - other_car.speed))
            blocked = blocked or blocks(params, car, other_car.route, other_car.route_distance, other_car.speed)
    if blocked and stop > 0.0:
        change = min(change, acceleration(speed, desired, time_gap, stop, speed))
    return max(change, -MAX_BRAKING)


@separate_jit
def drive(worlds: Records, i: int, lane: int, params: Record, path: Records) -> None:
    """Move the cars of world ``i`` by one decision and record their poses; call it before the vehicles move.

    Args:
        worlds: (worlds, vehicles) of VEHICLE, changed in place; worlds without a vehicle on the road stay as they are.
        i: which world.
        lane: of the world in ``path``.
        params: record of dtype PARAMS.
        path: (vehicles + cars, physics_steps + 1) of POSE; the rows of the cars are written.
    """
    vehicles = worlds.shape[1]
    decision = -1
    for v in range(vehicles):
        if worlds[i, v].end == RUNNING:
            decision = worlds[i, v].decisions
    cars = len(worlds[i, 0].cars)
    for k in range(cars):
        if decision >= 0 and worlds[i, 0].cars[k].present:
            worlds[i, 0].cars[k].acceleration = chosen_acceleration(worlds, i, k, params)
    for k in range(cars):
        car = worlds[i, 0].cars[k]
        moving = decision >= 0 and car.present
        moved = 0.0
        for step in range(params.physics_steps + 1):
            if step > 0 and moving:
                moved += params.dt * car.speed
                move_to(car, params, car.route_distance + params.dt * car.speed)
                car.speed = max(car.speed + params.dt * car.acceleration, 0.0)
            pose = path[vehicles + k, step]
            pose.x[lane] = car.x
            pose.y[lane] = car.y
            pose.cos[lane] = car.cos_heading
            pose.sin[lane] = car.sin_heading
            pose.moved[lane] = moved
        if moving:
            if roads.is_inside(params, car.route, car.route_distance) and car.entered < 0:
                car.entered = decision
            car.present = car.route_distance < params.route_length[car.route]
