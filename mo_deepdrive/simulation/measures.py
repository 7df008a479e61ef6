"""What measures the objectives that the kernel does not measure: functions of the world after a decision."""

from __future__ import annotations

import math

from mo_deepdrive.simulation import roads
from mo_deepdrive.simulation.geometry import RADIUS, time_to_collision
from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.state import ARRIVED, KERNEL_NAMES, LENGTH, RUNNING, Record, Records
from mo_deepdrive.simulation.traffic import MAX_BRAKING, SHORTEST_GAP

MARGIN = 0.01  # m, for rounding
CRASH = KERNEL_NAMES.index("collision")
ENTERING = 2 * LENGTH  # m; who entered is entering until the front is this far beyond the point of entry


@jit
def duration(worlds: Records, i: int, v: int, params: Record) -> float:
    """The seconds of a decision; under ``charge_remaining_time`` also those that an end before the arrival leaves."""
    vehicle = worlds[i, v]
    decisions = 1
    if params.charge_remaining_time and vehicle.end != RUNNING and vehicle.end != ARRIVED:
        decisions += params.max_decisions - vehicle.decisions
    spent = vehicle.spent[2] if vehicle.decisions == 1 else 0.0
    return float(params.dt * params.physics_steps * decisions + spent)


@jit
def energy(worlds: Records, i: int, v: int, params: Record) -> float:
    """The positive work of the traction force per mass in the decision (J/kg).

    The throttle is the acceleration that the traction force gives, so its product with the speed is power per mass; the
    speed is the mean of those before and after the decision. Braking recovers nothing.
    """
    vehicle = worlds[i, v]
    power = vehicle.throttle * (vehicle.speed + vehicle.previous_speed) / 2
    return float(max(power, 0.0) * params.dt * params.physics_steps)


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


@jit
def forced_braking(me: Record, other: Record, speed: float, params: Record) -> float:
    """With how much another vehicle or car with a ``speed`` has to brake (m/s^2) because ``me`` entered ahead of it.

    It is the deceleration rate to avoid a crash, from the gap between its front and the rear of ``me``, along its own
    route, and the difference of the speeds (D. Gettman, L. Head, "Surrogate safety measures from traffic simulation
    models", FHWA-RD-03-050, 2003), with at most MAX_BRAKING; none if it reached its stretch with right of way later.
    """
    if not 0 <= other.entered < me.entered or not roads.is_inside(params, other.route, other.route_distance):
        return 0.0
    joined = params.joins[me.route, other.route]  # NaN where the routes do not join
    joint = params.joins[me.route, me.route]
    gap = joined + me.route_distance - joint - LENGTH - other.route_distance
    closing = speed - me.speed
    if not gap > -LENGTH or closing <= 0.0:  # it does not come there, or is ahead
        return 0.0
    braking: float = min(closing * closing / (2 * max(gap, SHORTEST_GAP)), MAX_BRAKING)
    return braking


@jit
def right_of_way(worlds: Records, i: int, v: int, params: Record) -> float:
    """The most that entering forces anybody with right of way to brake, times the decision's duration (m/s)."""
    me = worlds[i, v]
    most = 0.0
    if me.entered >= 0 and me.route_distance < params.priority[me.route, 0] + ENTERING:
        for k in range(worlds.shape[1]):
            other = worlds[i, k]
            if k != v and other.end == RUNNING:
                most = max(most, forced_braking(me, other, other.speed, params))
        for k in range(len(worlds[i, 0].cars)):
            car = worlds[i, 0].cars[k]
            if car.present:
                most = max(most, forced_braking(me, car, car.speed, params))
    return float(most * params.dt * params.physics_steps)
