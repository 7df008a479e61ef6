"""Fixed rules for LeftTurn: drive to the crossing, wait for a gap in the oncoming traffic, turn along the lanes.

A rule knows the road, and of everything that moves what an agent observes. It steers along a path of two straight lines
and an arc, and it goes once no oncoming car would reach the crossing within ``gap`` seconds at its present speed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.driving.controls import BRAKING_TIME, THROTTLE, Driver, Rule, forward
from mo_deepdrive.simulation.geometry import HALF_LENGTH
from mo_deepdrive.simulation.state import LANE_WIDTH, LENGTH
from mo_deepdrive.world.observation import layout
from mo_deepdrive.world.scenarios import SCENARIOS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

SCENARIO = SCENARIOS["left_turn"]
WAYPOINTS = np.array(SCENARIO.routes[0].waypoints)
LEGS = np.hypot(*np.diff(WAYPOINTS, axis=0).T)  # m, lengths of the two legs after the first waypoint
COLUMN = {entry.name: column for column, entry in enumerate(layout(SCENARIO))}

# The path: along the middle of the first lane, an arc, and along the last lane, a little left of its middle so that the
# front, which swings out, stays in the lane.
RADIUS = 7.4  # m
EXIT_OFFSET = 0.11  # m
LEAVING_MARGIN = 0.3  # s between a car that leaves the crossing and the vehicle that enters its lane
TO_ONCOMING_LANE = 1.5  # m, from the first waypoint to where the box touches the oncoming lane
PREVIEW = 0.42  # s by which the wheel is ahead of the path, about the lag of the yaw rate
HEADING_GAIN = 0.22  # curvature (1/m) per rad of error
OFFSET_GAIN = 0.063  # curvature (1/m) per m of error
MAX_CURVATURE = 0.16  # 1/m, a little above that of the arc


@dataclass(frozen=True)
class GapRule(Rule):
    """What a fixed rule for LeftTurn is made of."""

    gap: float  # it goes once the next oncoming car is this far from the crossing (s); 0 to go at once
    approach_speed: float = 2.8  # on the way to the crossing (m/s)
    turn_speed: float = 6.0  # in the crossing (m/s)
    exit_speed: float = 8.0  # after it (m/s)
    stop_distance: float = 0.73  # from the front of the waiting vehicle to the crossing (m)
    least_speed: float = 0.0  # by which oncoming cars are taken to come at least, also those that stand (m/s)


class GapDriver(Driver):
    """Follows a :class:`GapRule`, as a policy for :func:`mo_deepdrive.evaluation.episodes.evaluate`.

    It remembers in which episodes it goes. An episode in which no reward has accrued has only begun.
    """

    def __init__(self, rule: GapRule, action_type: str = "discrete"):
        super().__init__(action_type)
        self.rule = rule
        self._goes = np.zeros(0, dtype=np.bool_)

    def __call__(self, observations: NDArray[Any], accrued: NDArray[Any], _discounts: NDArray[Any]) -> NDArray[Any]:
        """Actions for observations (N, size) and accrued rewards (N, d)."""
        seen = np.asarray(observations, dtype=np.float64)
        if len(self._goes) != len(seen):
            self._goes = np.zeros(len(seen), dtype=np.bool_)
        self._goes &= np.any(accrued != 0.0, axis=1)
        self._goes |= self.may_go(seen, self.line(locate(seen)[0]), self.rule.least_speed)
        return self.actions(seen, self._goes)

    def may_go(self, seen: Floats, line: Floats, least_speed: float | Floats) -> NDArray[np.bool_]:
        """Whether vehicles are at the line (N,) and no oncoming car that is at least so fast comes within the gap."""
        speed = seen[:, COLUMN["speed"]]
        here = line <= speed * BRAKING_TIME + 0.3
        to_lane = np.maximum(line + self.rule.stop_distance + TO_ONCOMING_LANE, 0.0)
        lead_time = (np.sqrt(speed**2 + 2.0 * THROTTLE * to_lane) - speed) / THROTTLE
        free = free_time(seen, lead_time, least_speed)
        return here & (free >= self.rule.gap) | (self.rule.gap == 0.0)

    def line(self, front: Floats) -> Floats:
        """The distance (N,) from the front (N, 2) to where a vehicle waits, on the way straight on; negative beyond."""
        return np.asarray(WAYPOINTS[0, 1] - self.rule.stop_distance - front[:, 1])

    def actions(self, seen: Floats, goes: NDArray[np.bool_]) -> NDArray[Any]:
        """Actions for observations (N, size) of vehicles that go through the crossing (N,), or wait before it."""
        front, heading = locate(seen)
        line, rule = self.line(front), self.rule
        speed = seen[:, COLUMN["speed"]]
        centre = front - HALF_LENGTH * forward(heading)
        turning = front[:, 1] > WAYPOINTS[0, 1] - 1.5
        left = centre[:, 0] < WAYPOINTS[0, 0] - 0.8 * RADIUS
        rolling = np.where(left, rule.exit_speed, np.where(turning, rule.turn_speed, rule.approach_speed))
        waiting = np.minimum(rule.approach_speed, np.where(line > 0.3, 1.5 * line, 0.0))
        target = np.where(goes, rolling, waiting)
        brakes = ~goes & (line <= speed * BRAKING_TIME)
        return self.control(seen, path_curvature(centre, heading, speed), target, brakes, line)


def free_time(seen: Floats, lead_time: Floats, least_speed: float | Floats = 0.0) -> Floats:
    """The time (N,) until the next oncoming car reaches the crossing (s); inf if none does.

    It comes at its present speed, or at the least one (m/s). Cars that have left by ``lead_time`` (N,) (s), when the
    vehicle is in their lane, do not count.
    """
    least = np.full(len(seen), np.inf)
    for name in ("oncoming_1", "oncoming_2"):
        distance, speed = seen[:, COLUMN[f"{name}_distance"]], seen[:, COLUMN[f"{name}_speed"]]
        with np.errstate(divide="ignore", invalid="ignore"):
            arrives = np.where(distance <= 0.0, 0.0, distance / np.maximum(speed, least_speed))
            leaves = (distance + 2.0 * LANE_WIDTH + LENGTH) / speed
        least = np.where(leaves + LEAVING_MARGIN < lead_time, least, np.minimum(least, arrives))
    return least


def locate(seen: Floats) -> tuple[Floats, Floats]:
    """Where the front is (N, 2) (m), and the heading (N,) (rad), from observations (N, size).

    Before the second waypoint by the directions of the next two; after it by that of the destination and by the
    distances to the lane lines.
    """
    first, second = _seen_from(seen, "next"), _seen_from(seen, "after")
    distance = seen[:, COLUMN["next_distance"]]
    between = np.hypot(*(second - first).T)
    leg = np.where(between < 0.5 * LEGS[0], 2, np.where(between < LEGS.mean(), 0, 1))
    seen_direction = np.arctan2(*(second - first).T[::-1])
    after = WAYPOINTS[np.minimum(leg + 1, 2)] - WAYPOINTS[np.minimum(leg, 1)]
    heading = np.arctan2(-after[:, 0], after[:, 1]) - seen_direction

    aside = (seen[:, COLUMN["left_lane_distance"]] - seen[:, COLUMN["right_lane_distance"]]) / 2.0
    rear_in_crossing = distance > LEGS[1] - LENGTH
    ratio = np.clip(aside / np.maximum(distance, 1.0), -1.0, 1.0)
    angle = np.arctan2(first[:, 1], first[:, 0])
    error = np.where(rear_in_crossing, np.arcsin(ratio) - angle, (aside - angle * distance) / (distance + HALF_LENGTH))
    heading = np.where(leg == 2, math.pi / 2 + error, heading)
    ahead = forward(heading)
    to_left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    return WAYPOINTS[leg] - first[:, :1] * ahead - first[:, 1:] * to_left, heading


def _seen_from(seen: Floats, which: str) -> Floats:
    """The next waypoint or the one after it as seen from the front (N, 2): metres ahead, and to the left."""
    distance = seen[:, COLUMN[f"{which}_distance"]]
    if which == "after":  # it is observed by way of the next one; the same entries twice are the destination
        by_way = seen[:, COLUMN["next_distance"]]
        distance = distance - np.where(distance == by_way, 0.0, by_way)
    angle = -seen[:, COLUMN[f"{which}_angle"]]
    return np.asarray(distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def path_curvature(centre: Floats, heading: Floats, speed: Floats) -> Floats:
    """The curvature (N,) (1/m) that leads vehicles along the path of the left turn."""
    ahead = centre + (PREVIEW * speed)[:, None] * forward(heading)
    middle = np.array([WAYPOINTS[0, 0] - RADIUS, WAYPOINTS[1, 1] - EXIT_OFFSET - RADIUS])
    x, y = (ahead - middle).T
    before, beyond = y < 0.0, (x < 0.0) & (y >= 0.0)
    angle = np.where(before, 0.0, np.where(beyond, math.pi / 2, np.arctan2(y, x)))
    # How far the path is to the left of the point ahead.
    offset = np.where(before, x, np.where(beyond, y - EXIT_OFFSET, np.hypot(x, y))) - RADIUS
    curvature = np.where(before | beyond, 0.0, 1.0 / RADIUS)
    wanted = curvature + HEADING_GAIN * (angle - heading) + OFFSET_GAIN * offset
    return np.asarray(np.clip(wanted, -MAX_CURVATURE, MAX_CURVATURE))
