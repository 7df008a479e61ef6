r"""Oncoming traffic: cars that come one after another down the lane opposite to a left-turner.

They follow one another by the Intelligent Driver Model (M. Treiber, A. Hennecke, D. Helbing, "Congested traffic states
in empirical observations and microscopic simulations", Physical Review E 62, 1805, 2000). With speed v, desired speed
v0, bumper-to-bumper gap s and approaching rate dv = v - (speed of the car ahead):

    dv/dt = A (1 - (v / v0)^4 - (s*(v, dv) / s)^2)                      equation (3), with the exponent 4
    s*    = S0 + max(0, v T + v dv / (2 sqrt(A B)))                     equation (4), without its term in sqrt(v / v0)

A left-turner in the lane is one more car ahead, standing where its box begins. A driver brakes for it with no more than
``yielding`` (m/s^2), which tells those who let it pass from those who hardly brake. Cars keep to the longitudinal
limits of a vehicle: full throttle and friction, 1 g of braking, no reversing.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.simulation.geometry import HALF_LENGTH, HALF_WIDTH, boxes_overlap
from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.state import (
    GRAVITY,
    HALF_LANE,
    LANE_WIDTH,
    LENGTH,
    MAP_CENTRE,
    MAP_SIZE,
    MAX_ACCELERATION,
    RUNNING,
    STANDSTILL_GAP,
    Record,
    Records,
    in_lanes,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Of the model, for a city (M. Treiber, A. Kesting, "Traffic Flow Dynamics", Springer 2013, table 11.2).
ACCELERATION = 1.0  # m/s^2, A
COMFORTABLE_BRAKING = 1.5  # m/s^2, B
TIME_GAP = 1.0  # s, T; that of a driver whose headway is shorter is the headway
# The g-force above which the episode of a vehicle ends as harmful, by default.
MAX_BRAKING = GRAVITY
SHORTEST_GAP = 0.1  # m; gaps are taken to be no less, so that a touching car brakes as hard as it can

# Distributions of what is drawn per car and episode.
DESIRED_SPEED = (7.0, 12.0)  # m/s, uniform: 25 to 43 km/h
SHORTEST_HEADWAY = 0.8  # s
YIELDING = (0.5, 6.0)  # m/s^2, uniform: from hardly braking to an emergency
# Mean headways (s) of the flows, about 370, 690 and 1,100 cars per hour.
MEAN_HEADWAY = {"light": 9.0, "default": 4.5, "dense": 2.5}

# What reset options may set.
DESIRED_SPEEDS = (1.0, 25.0)  # m/s
HEADWAYS = (0.0, 60.0)  # s
YIELDINGS = (0.0, MAX_BRAKING)  # m/s^2

ONCOMING_LANE = MAP_CENTRE - HALF_LANE  # x of its centre
# The crossing, along the lane: oncoming cars enter it at the one and leave it at the other.
ENTRY = MAP_CENTRE + LANE_WIDTH
EXIT = MAP_CENTRE - LANE_WIDTH
# As a box, an oncoming car looks along -y: cosine and sine of its heading, pi.
COS, SIN = -1.0, 0.0

_ROOTS = 1.0 / (2.0 * math.sqrt(ACCELERATION * COMFORTABLE_BRAKING))
_FREE = 1e9  # m; the gap to nobody

# What a car needs within a decision, besides its pose.
TRAFFIC = in_lanes("speed", "acceleration", "desired_speed", "time_gap", "yielding", "present")


def make_scratch(cars: int) -> NDArray[Any]:
    """The scratch buffer of :func:`drive`: (cars,) of TRAFFIC."""
    return np.zeros(cars, dtype=TRAFFIC)


@jit
def drawn_speed(draw: float) -> float:
    """A desired speed (m/s) from a uniform in [0, 1)."""
    return DESIRED_SPEED[0] + draw * (DESIRED_SPEED[1] - DESIRED_SPEED[0])


@jit
def drawn_headway(draw: float, mean: float) -> float:
    """A headway (s) from a uniform in [0, 1): exponential beyond the shortest one.

    The shifted exponential distribution (M2) of R. J. Cowan, "Useful headway models", Transportation Research 9, 1975.
    """
    return min(SHORTEST_HEADWAY - (mean - SHORTEST_HEADWAY) * math.log(1.0 - draw), HEADWAYS[1])


@jit
def drawn_yielding(draw: float) -> float:
    """With how much a driver brakes for a left-turner at most (m/s^2), from a uniform in [0, 1)."""
    return YIELDING[0] + draw * (YIELDING[1] - YIELDING[0])


@jit
def acceleration(speed: float, desired_speed: float, time_gap: float, gap: float, approaching: float) -> float:
    """The acceleration (m/s^2) of equation (3), with the desired gap of equation (4).

    Args:
        speed: v (m/s).
        desired_speed: v0 (m/s).
        time_gap: T (s).
        gap: s (m).
        approaching: dv (m/s).
    """
    part = speed / desired_speed
    part *= part
    desired_gap = STANDSTILL_GAP + max(0.0, speed * (time_gap + approaching * _ROOTS))
    closeness = desired_gap / max(gap, SHORTEST_GAP)
    return ACCELERATION * (1.0 - part * part - closeness * closeness)


@jit
def first_speed(driver: Record, k: int, speed_ahead: float) -> float:
    """The speed of car ``k`` at the start (m/s).

    It is the desired one if the driver can brake from it to the speed of the car ahead comfortably within the headway.
    """
    most = speed_ahead + COMFORTABLE_BRAKING * driver.headway
    speed: float = min(driver.desired_speed, most) if k > 0 else driver.desired_speed
    return speed


@jit
def first_position(driver: Record, k: int, speed: float, rear_ahead: float) -> float:
    """Where the centre of car ``k`` is at the start along y (m), behind the rear of the car ahead or the crossing.

    The first one reaches the crossing after its headway. The gap in front of every other is the standstill gap and
    what it covers in its headway.
    """
    gap = driver.headway * speed + (STANDSTILL_GAP if k > 0 else 0.0)
    position: float = rear_ahead + gap + HALF_LENGTH
    return position


@jit
def touches_start(spawn: Record) -> bool:
    """Whether an oncoming car touches the vehicle at its start."""
    x = spawn.starts[0, 0]
    cos = math.cos(spawn.starts[0, 2])
    sin = math.sin(spawn.starts[0, 2])
    touches = False
    speed = 0.0
    rear = ENTRY
    for k in range(len(spawn.drivers)):
        speed = first_speed(spawn.drivers[k], k, speed)
        y = first_position(spawn.drivers[k], k, speed, rear)
        overlap = boxes_overlap(x, spawn.starts[0, 1], cos, sin, ONCOMING_LANE, y, COS, SIN)
        touches = touches or (k < spawn.n_cars and overlap)
        rear = y + HALF_LENGTH
    return touches


@jit
def place(worlds: Records, i: int, spawn: Record) -> None:
    """Put the oncoming cars of world ``i`` one after another in their lane."""
    speed = 0.0
    rear = ENTRY
    for k in range(len(worlds[i, 0].cars)):
        car = worlds[i, 0].cars[k]
        driver = spawn.drivers[k]
        speed = first_speed(driver, k, speed)
        y = first_position(driver, k, speed, rear)
        rear = y + HALF_LENGTH
        present = k < spawn.n_cars
        car.x = ONCOMING_LANE
        car.y = y if present else 0.0
        car.speed = speed if present else 0.0
        car.acceleration = 0.0
        car.cos_heading = COS
        car.sin_heading = SIN
        car.route = 0
        car.route_distance = 0.0
        car.entered = 0
        car.driver.desired_speed = driver.desired_speed
        car.driver.headway = driver.headway
        car.driver.yielding = driver.yielding
        car.driver.accepted_gap = 0.0
        car.present = present


@jit
def load(car: Record, lane: int, c: Record, pose: Record) -> None:
    """Copy a car to a lane; it is gone once its rear has left the map."""
    present = car.present and car.y > -HALF_LENGTH
    c.speed[lane] = car.speed if present else 0.0
    c.acceleration[lane] = car.acceleration
    c.desired_speed[lane] = car.driver.desired_speed
    c.time_gap[lane] = min(car.driver.headway, TIME_GAP)
    c.yielding[lane] = car.driver.yielding
    c.present[lane] = 1.0 if present else 0.0
    pose.x[lane] = car.x
    pose.y[lane] = car.y
    pose.cos[lane] = COS
    pose.sin[lane] = SIN
    pose.moved[lane] = 0.0


@jit
def drive(worlds: Records, first: int, last: int, params: Record, traffic: Records, path: Records) -> None:
    """Move the oncoming cars of the worlds ``first`` to ``last`` - 1 by one decision and record their poses.

    Args:
        worlds: (worlds, vehicles) of VEHICLE, changed in place; worlds whose vehicle has ended stay as they are.
        first: the world in lane 0.
        last: the world after the last one, at most ``first`` + LANES.
        params: record of dtype PARAMS.
        traffic: (cars,) of TRAFFIC, scratch.
        path: (vehicles + cars, physics_steps + 1) of POSE; the rows of the cars are written, from those of vehicle 0.
    """
    n = params.physics_steps
    dt = params.dt
    friction = params.speed_friction
    lanes = last - first
    vehicles = worlds.shape[1]
    cars = len(worlds[first, 0].cars)
    for k in range(cars):
        for lane in range(lanes):
            load(worlds[first + lane, 0].cars[k], lane, traffic[k], path[vehicles + k, 0])
    for step in range(1, n + 1):
        turner = path[0, step - 1]
        # Backwards, so that each car sees the one ahead as it was before the step.
        for k in range(cars - 1, -1, -1):
            c = traffic[k]
            ahead = traffic[max(k - 1, 0)]
            before = path[vehicles + k, step - 1]
            before_ahead = path[vehicles + max(k - 1, 0), step - 1]
            now = path[vehicles + k, step]
            for lane in range(lanes):
                v = c.speed[lane]
                y = before.y[lane]
                led = k > 0 and ahead.present[lane] > 0.0
                gap = y - before_ahead.y[lane] - LENGTH if led else _FREE
                approaching = v - ahead.speed[lane] if led else 0.0
                change = acceleration(v, c.desired_speed[lane], c.time_gap[lane], gap, approaching)

                half_x = HALF_LENGTH * abs(turner.sin[lane]) + HALF_WIDTH * abs(turner.cos[lane])
                half_y = HALF_LENGTH * abs(turner.cos[lane]) + HALF_WIDTH * abs(turner.sin[lane])
                blocked = abs(turner.x[lane] - before.x[lane]) < half_x + HALF_LANE and turner.y[lane] < y
                gap = y - HALF_LENGTH - turner.y[lane] - half_y
                yielding = acceleration(v, c.desired_speed[lane], c.time_gap[lane], gap, v)
                yielding = max(yielding, -c.yielding[lane])
                change = min(change, yielding) if blocked else change

                fastest = (v + dt * MAX_ACCELERATION) * friction
                slowest = max(v - dt * MAX_BRAKING, 0.0)
                speed = min(max(v + dt * change, slowest), fastest)
                speed = speed if c.present[lane] > 0.0 else v
                move = dt * v if c.present[lane] > 0.0 else 0.0
                c.acceleration[lane] = (speed - v) / dt
                c.speed[lane] = speed
                now.x[lane] = before.x[lane]
                now.y[lane] = y - move
                now.cos[lane] = COS
                now.sin[lane] = SIN
                now.moved[lane] = before.moved[lane] + move
    for k in range(cars):
        for lane in range(lanes):
            if worlds[first + lane, 0].end == RUNNING:
                car = worlds[first + lane, 0].cars[k]
                car.y = path[vehicles + k, n].y[lane]
                car.speed = traffic[k].speed[lane]
                car.acceleration = traffic[k].acceleration[lane]
                car.present = traffic[k].present[lane] > 0.0


@jit
def distance_to_crossing(car: Record) -> float:
    """How far the front of the car is from the crossing (m); negative inside it."""
    distance: float = car.y - HALF_LENGTH - ENTRY
    return distance


@jit
def has_passed(car: Record) -> bool:
    """Whether the rear of the car has left the crossing."""
    passed: bool = car.y + HALF_LENGTH < EXIT
    return passed


@jit
def approaching(vehicle: Record) -> bool:
    """Whether one of the oncoming cars of ``vehicle`` is on the map and not yet in the crossing."""
    found = False
    for k in range(len(vehicle.cars)):
        distance = distance_to_crossing(vehicle.cars[k])
        found = found or (vehicle.cars[k].present and 0.0 < distance < MAP_SIZE - ENTRY)
    return found
