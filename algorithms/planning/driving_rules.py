"""Driving rules: random hand-written controllers that give the front search its first plans.

A rule steers towards a point on the way and then towards the destination, by proportional control of the direction,
speeds up to a target speed, and then coasts or holds it. Rules also take over from a plan in the middle of an episode.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numba
import numpy as np

from algorithms.planning.plans import FULL_SCALE
from mo_deepdrive.actions import CURL, DECAY, DECREASE, IDLE, INCREASE, MAINTAIN, OFFSET, SPEED_CHANGE
from mo_deepdrive.simulation.state import MAX_ACCELERATION, STEER_RANGE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mo_deepdrive.batch import WorldBatch

YAW_PER_STEER = 8.4  # steady yaw rate (rad/s) per rad of steer and m/s
DRAG = 0.06  # deceleration by friction (m/s^2) per m/s

RULE = np.dtype(
    [
        ("first_decision", np.int64),  # from which the rule drives
        ("via_x", np.float64),  # the point on the way (m)
        ("via_y", np.float64),
        ("via_radius", np.float64),  # distance (m) within which that point counts as reached
        ("gain", np.float64),  # yaw rate (rad/s) per rad of direction error
        ("max_steer", np.float64),  # rad
        ("dead_zone", np.float64),  # direction error (rad) below which the wheel is straight
        ("target_speed", np.float64),  # m/s
        ("speed_slack", np.float64),  # share of the target speed that may be lost before the rule speeds up again
        ("throttle", np.float64),  # while speeding up (m/s^2)
        ("hold_speed", np.bool_),  # hold the target speed by throttle; else coast
        ("brake_distance", np.float64),  # distance to the destination (m) below which the rule brakes
    ]
)


def random_rules(n: int, rng: np.random.Generator, batch: WorldBatch) -> NDArray[Any]:
    """``n`` random rules (n,) of RULE for the scenario in the first world of ``batch``."""

    def log_uniform(low: float, high: float) -> NDArray[np.float64]:
        return np.asarray(np.exp(rng.uniform(np.log(low), np.log(high), n)))

    vehicle, has_obstacle = batch.state[0, 0], batch.scenario.obstacles > 0
    if has_obstacle:
        middle = vehicle["obstacle"].mean(axis=0)
    else:
        middle = (vehicle["waypoints"][0] + (vehicle["x"], vehicle["y"])) / 2
    via = middle + rng.normal(0.0, 4.0, (n, 2))
    direct = rng.random(n) < (0.1 if has_obstacle else 0.7)
    rules = np.zeros(n, dtype=RULE)
    rules["via_x"], rules["via_y"] = via.T
    rules["via_radius"] = np.where(direct, np.inf, rng.uniform(1.0, 5.0, n))
    rules["gain"] = log_uniform(0.2, 4.0)
    rules["max_steer"] = log_uniform(0.001, 0.3)
    rules["dead_zone"] = np.where(rng.random(n) < 0.5, 0.0, log_uniform(0.001, 0.3))
    rules["target_speed"] = log_uniform(0.02, 8.0)
    rules["speed_slack"] = np.where(rng.random(n) < 0.5, 0.02, rng.uniform(0.0, 0.8, n))
    rules["throttle"] = log_uniform(0.02, MAX_ACCELERATION)
    rules["hold_speed"] = rng.random(n) < 0.5
    rules["brake_distance"] = np.where(rng.random(n) < 0.7, 0.0, rng.uniform(0.0, 8.0, n))
    return rules


@numba.njit
def follow_rule(
    vehicle: np.record, rule: np.record, via_reached: bool, table: NDArray[Any], action: NDArray[Any]
) -> bool:
    """Write the action that a rule takes into ``action`` (k,), in the format of plans.

    Args:
        vehicle: of VEHICLE, read only.
        rule: of RULE.
        via_reached: whether the vehicle has already reached the point on the way.
        table: (actions, 4) of a discrete action set; empty for a continuous one.
        action: (k,), written.

    Returns:
        Whether the vehicle has now reached the point on the way.
    """
    target_x = rule.via_x - vehicle.front_x
    target_y = rule.via_y - vehicle.front_y
    if via_reached or math.hypot(target_x, target_y) < rule.via_radius:
        via_reached = True
        target_x = vehicle.waypoints[0, 0] - vehicle.front_x
        target_y = vehicle.waypoints[0, 1] - vehicle.front_y
    ahead = target_y * vehicle.cos_heading - target_x * vehicle.sin_heading
    angle = math.atan2(-target_x * vehicle.cos_heading - target_y * vehicle.sin_heading, ahead)
    speed = abs(vehicle.speed)
    steer = 0.0
    if abs(angle) >= rule.dead_zone:
        steer = rule.gain * angle / (YAW_PER_STEER * max(speed, 0.3))
        steer = min(max(steer, -rule.max_steer), rule.max_steer)
    wanted_speed = rule.target_speed if vehicle.throttle > 0.0 else rule.target_speed * (1.0 - rule.speed_slack)
    speed_up = speed < wanted_speed
    slow_down = vehicle.next_distance < rule.brake_distance and speed > 0.3
    if len(table) == 0:
        throttle = rule.throttle if speed_up else (DRAG * speed if rule.hold_speed else 0.0)
        action[0] = round(min(max(steer / STEER_RANGE, -1.0), 1.0) * FULL_SCALE)
        action[1] = 0 if slow_down else round(min(throttle / MAX_ACCELERATION, 1.0) * FULL_SCALE)
        action[2] = -FULL_SCALE // 2 if slow_down else -FULL_SCALE
        return via_reached
    change = MAINTAIN
    if slow_down:
        change = DECREASE
    elif speed_up:
        change = INCREASE
    elif vehicle.throttle > 0.0 and not rule.hold_speed:
        change = IDLE  # which releases the throttle, and the wheel
    action[0] = 0
    least = math.inf
    for row in range(1, len(table)):
        if table[row, SPEED_CHANGE] == change:
            offered = table[row, DECAY] * vehicle.steer + table[row, OFFSET] + table[row, CURL] / max(speed, 1.0) ** 2
            if abs(offered - steer) < least:
                least = abs(offered - steer)
                action[0] = row
    return via_reached
