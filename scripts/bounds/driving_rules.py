"""Driving rules: random hand-written controllers that see the waypoints and their own motion alone.

A rule waits, speeds up to a target speed and coasts or holds it, steers towards the next waypoint by proportional
control of the direction, at first off to a side, and slows down before it arrives. So a part of them collides and a
part arrives, quickly or calmly. They give the front search its first plans, and take over from a plan in the middle of
an episode.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numba
import numpy as np

from algorithms.driving.controls import CURVATURE_PER_STEER, DRAG
from mo_deepdrive.simulation.actions import CURL, DECAY, DECREASE, INCREASE, MAINTAIN, OFFSET, SPEED_CHANGE
from mo_deepdrive.simulation.state import MAX_ACCELERATION, STEER_RANGE
from mo_deepdrive.world.observation import OWN
from scripts.bounds.plans import FULL_SCALE

if TYPE_CHECKING:
    from numpy.typing import NDArray

_COLUMN = {entry.name: column for column, entry in enumerate(OWN)}
NEXT_ANGLE, AFTER_DISTANCE = _COLUMN["next_angle"], _COLUMN["after_distance"]
SPEED, STEER, THROTTLE = _COLUMN["speed"], _COLUMN["steer"], _COLUMN["throttle"]

RULE = np.dtype(
    [
        ("first_decision", np.int64),  # from which the rule drives
        ("wait", np.float64),  # s before it starts
        ("target_speed", np.float64),  # m/s
        ("speed_slack", np.float64),  # share of the target speed that may be lost before it speeds up again
        ("throttle", np.float64),  # while speeding up, of continuous actions (m/s^2)
        ("hold_speed", np.bool_),  # hold the target speed by throttle; else coast
        ("gain", np.float64),  # yaw rate (rad/s) per rad of direction error
        ("max_steer", np.float64),  # rad
        ("dead_zone", np.float64),  # direction error (rad) below which the wheel is straight
        ("detour", np.float64),  # rad by which it heads to a side at first, left is positive
        ("detour_time", np.float64),  # s of driving for which it does
        ("brake_distance", np.float64),  # m to the destination below which it slows down
    ]
)


def _log_uniform(low: float, high: float, n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    return np.asarray(np.exp(rng.uniform(np.log(low), np.log(high), n)))


def random_rules(n: int, rng: np.random.Generator) -> NDArray[Any]:
    """``n`` random rules (n,) of RULE, which drive as fast as traffic does."""
    rules = np.zeros(n, dtype=RULE)
    rules["wait"] = np.where(rng.random(n) < 0.3, 0.0, rng.uniform(0.0, 20.0, n))
    rules["target_speed"] = _log_uniform(1.0, 10.0, n, rng)
    rules["speed_slack"] = rng.uniform(0.02, 0.5, n)
    rules["gain"] = _log_uniform(0.5, 4.0, n, rng)
    rules["dead_zone"] = np.where(rng.random(n) < 0.5, 0.0, _log_uniform(0.001, 0.1, n, rng))
    rules["detour"] = np.where(rng.random(n) < 0.3, 0.0, rng.uniform(-1.2, 1.2, n))
    rules["detour_time"] = rng.uniform(0.0, 8.0, n)
    rules["brake_distance"] = np.where(rng.random(n) < 0.5, 0.0, rng.uniform(0.0, 8.0, n))
    rules["max_steer"] = STEER_RANGE
    rules["throttle"] = MAX_ACCELERATION
    return rules


def random_calm_rules(n: int, rng: np.random.Generator) -> NDArray[Any]:
    """``n`` random rules (n,) of RULE that do not wait, and that may creep and steer or speed up but little."""
    rules = random_rules(n, rng)
    rules["wait"] = 0.0
    rules["target_speed"] = _log_uniform(0.02, 8.0, n, rng)
    rules["max_steer"] = _log_uniform(0.001, 0.3, n, rng)
    rules["throttle"] = _log_uniform(0.02, MAX_ACCELERATION, n, rng)
    rules["hold_speed"] = rng.random(n) < 0.5
    return rules


@numba.njit
def follow_rule(seen: NDArray[Any], rule: np.record, time: float, table: NDArray[Any], action: NDArray[Any]) -> None:
    """Write the action that a rule takes into ``action`` (k,), in the format of plans.

    Args:
        seen: (size,) what the vehicle observes.
        rule: of RULE.
        time: s since the start of the episode.
        table: (actions, 4) of a discrete action set; empty for a continuous one.
        action: (k,), written.
    """
    driving = time - rule.wait
    error = -(np.float64(seen[NEXT_ANGLE]) - (rule.detour if driving < rule.detour_time else 0.0))
    speed = abs(np.float64(seen[SPEED]))
    steer = 0.0
    if abs(error) >= rule.dead_zone:
        steer = rule.gain * error / (CURVATURE_PER_STEER * max(speed, 0.3))
        steer = min(max(steer, -rule.max_steer), rule.max_steer)
    pushes = seen[THROTTLE] > 0.0
    target = rule.target_speed if driving >= 0.0 else 0.0
    faster = speed < target * (1.0 if pushes else 1.0 - rule.speed_slack)
    slower = np.float64(seen[AFTER_DISTANCE]) < rule.brake_distance and speed > 1.0
    if len(table) == 0:
        throttle = rule.throttle if faster else (DRAG * speed if rule.hold_speed else 0.0)
        action[0] = round(min(max(steer / STEER_RANGE, -1.0), 1.0) * FULL_SCALE)
        action[1] = 0 if slower else round(min(throttle / MAX_ACCELERATION, 1.0) * FULL_SCALE)
        action[2] = -FULL_SCALE // 2 if slower else -FULL_SCALE
        return
    change = MAINTAIN
    if slower:
        change = DECREASE
    elif faster:
        change = INCREASE
    elif pushes and not rule.hold_speed:
        change = DECREASE
    least = math.inf
    held = np.float64(seen[STEER])
    for row in range(len(table)):
        if table[row, SPEED_CHANGE] == change:
            offered = table[row, DECAY] * held + table[row, OFFSET] + table[row, CURL] / max(speed, 1.0) ** 2
            if abs(offered - steer) < least:
                least = abs(offered - steer)
                action[0] = row
