"""Scripted drivers for the two vehicles of the intersection, by name.

Vehicle 0 turns left as in LeftTurn and waits for a gap before vehicle 1; vehicle 1 drives straight on as one of several
families of drivers, which differ in how fast they are where, and in whom they stop for. All remember nothing: an action
follows from one observation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.driving.controls import BRAKE_LIMIT, Driver, make_driver
from algorithms.driving.left_turn_rules import COLUMN, GapDriver, GapRule, locate
from mo_deepdrive.simulation.geometry import HALF_WIDTH
from mo_deepdrive.simulation.observation import ABSENT_DISTANCE, SIGHT_DISTANCE
from mo_deepdrive.simulation.state import LANE_WIDTH, LENGTH
from mo_deepdrive.simulation.traffic import ENTRY
from mo_deepdrive.world.observation import layout
from mo_deepdrive.world.scenarios import SCENARIOS

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

SCENARIO = SCENARIOS["intersection"]
SEEN = {entry.name: column for column, entry in enumerate(layout(SCENARIO))}

PASSED = -(2.0 * LANE_WIDTH + LENGTH)  # m, distance to the crossing of a vehicle whose rear has left it
HEADING_GAIN = 0.05  # curvature (1/m) per rad towards the destination
COMFORTABLE = 2.0  # m/s^2 of braking for a vehicle in front
CLEARANCE = 3.0  # m that are left to it
ASIDE = 0.3  # m beside the own box within which a vehicle is in the way

# Of drivers of vehicle 1 that stop or slow down somewhere.
PACE = 4.0  # m/s, from which a discrete brake is not harmful
SLOW, FAST = 1.0, 8.0  # m/s, before and after somebody speeds up late
WAVE = 8.0  # m from one place to the next where one that stops and goes is slow
STOP, AT_STOP = 1.0, 0.6  # m before the crossing where it stops, and how near to that it has stopped
STOP_GAIN, ROLLING = 0.8, 0.3  # 1/s, m/s: of the speed before it over the distance to it, and of the last bit
TOO_FAST, STANDING = 0.4, 0.02  # m/s above the wanted speed at which it brakes, and above none
BRAKING_ROOM = 4.0  # m
TO_END = ENTRY - SCENARIO.routes[1].waypoints[0][1]  # m, from the crossing to the destination of vehicle 1


@dataclass(frozen=True)
class MeetingRule(GapRule):
    """What a rule of vehicle 0 is made of."""

    commitment: float = 0.3  # beyond the line it no longer waits (m)


class TurningDriver(GapDriver):
    """Vehicle 0: turns left once vehicle 1 is at least the rule's gap from the crossing."""

    vehicle = 0
    rule: MeetingRule

    def __init__(self, rule: MeetingRule, action_type: str):
        super().__init__(rule, action_type)

    def __call__(self, observations: NDArray[np.float32], *_: Any) -> NDArray[Any]:
        """Actions for observations (N, size) of the vehicle."""
        return self.drive(observations, impatient=False)

    def drive(self, observations: NDArray[np.float32], impatient: bool | NDArray[np.bool_]) -> NDArray[Any]:
        """Actions for observations (N, size); who is impatient (N,) takes no one to come faster than it does."""
        seen = as_in_left_turn(np.asarray(observations, dtype=np.float64))
        line = self.line(locate(seen)[0])
        least_speed = np.where(impatient, 0.0, self.rule.least_speed)
        return self.actions(seen, self.may_go(seen, line, least_speed) | (line < -self.rule.commitment))


class StraightDriver(Driver):
    """Vehicle 1: drives straight on at the speed (m/s) of a family, and may brake for a vehicle in front of it.

    The ``pace`` gives speeds (N,) for observations (N, size), distances to the crossing (N,) (m) and the ``number``.
    """

    vehicle = 1

    def __init__(
        self, pace: Callable[[Floats, Floats, float], Floats], number: float, action_type: str, *, yields: bool = False
    ):
        super().__init__(action_type)
        self._pace, self._number, self._yields = pace, number, yields

    def __call__(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """Actions for observations (N, size) of the vehicle."""
        seen = np.asarray(observations, dtype=np.float64)
        speed, angle = seen[:, COLUMN["speed"]], seen[:, COLUMN["next_angle"]]
        target = self._pace(seen, seen[:, COLUMN["next_distance"]] * np.cos(angle) - TO_END, self._number)
        room = room_ahead(seen) - CLEARANCE
        yields = (room < speed**2 / (2.0 * COMFORTABLE)) & self._yields
        slows = (speed > target + STANDING + TOO_FAST * np.minimum(target, 1.0)) & (speed < BRAKE_LIMIT)
        target, room = np.where(yields, 0.0, target), np.where(yields, room, BRAKING_ROOM)
        return self.control(seen, -HEADING_GAIN * angle, target, yields | slows, room)


# The families of vehicle 1. Each is a speed (N,) by what is seen, by the distance to the crossing, and by a number.


def steadily(_seen: Floats, ahead: Floats, speed: float) -> Floats:
    """At a constant speed (m/s)."""
    return np.full(len(ahead), speed)


def creeping(_seen: Floats, ahead: Floats, speed: float) -> Floats:
    """Slowly (m/s) until it has left the crossing."""
    return np.where(ahead > PASSED, speed, PACE)


def in_waves(_seen: Floats, ahead: Floats, speed: float) -> Floats:
    """Nearly stops every few metres, and is as fast as ``speed`` (m/s) in between."""
    return np.asarray(ROLLING + speed * np.abs(np.sin(math.pi * ahead / WAVE)))


def late(_seen: Floats, ahead: Floats, place: float) -> Floats:
    """Hesitates until it is at a ``place`` (m) before the crossing, and then speeds up."""
    return np.where(ahead > place, SLOW, FAST)


def until(_seen: Floats, ahead: Floats, place: float) -> Floats:
    """Drives to a ``place`` (m) before the crossing, and stands there; or where it is, if it is nearer."""
    return np.minimum(PACE, STOP_GAIN * np.maximum(ahead - place, 0.0))


def stopping(seen: Floats, ahead: Floats, slow: float) -> Floats:
    """Stops before the crossing, and goes once the other one is gone, or slower than ``slow`` (m/s)."""
    speed = np.hypot(seen[:, SEEN["other_vx"]], seen[:, SEEN["other_vy"]])
    return _before_crossing(ahead, PACE, (speed < slow) | gone(seen), stops=True)


def courteous(seen: Floats, ahead: Floats, speed: float) -> Floats:
    """Drives at a speed (m/s), but lets the other one turn first."""
    return _before_crossing(ahead, speed, gone(seen), stops=False)


def _before_crossing(ahead: Floats, speed: float, free: NDArray[np.bool_], *, stops: bool) -> Floats:
    """A speed (N,) (m/s) that waits where it stops unless the way is free, and slows down for it in any case or not."""
    left = ahead - STOP
    beyond, there = left < -AT_STOP, left < AT_STOP
    waits = np.where(there, 0.0, np.minimum(speed, ROLLING + STOP_GAIN * left))
    return np.where(beyond | (free & (there | (not stops))), speed, waits)


def gone(seen: Floats) -> NDArray[np.bool_]:
    """(N,) whether the other vehicle has passed from the left to the right of the own box, or has left the road."""
    return np.asarray((other_corners(seen)[1].max(axis=1) < -HALF_WIDTH - ASIDE) | absent(seen))


def as_in_left_turn(seen: Floats) -> Floats:
    """What vehicle 0 sees of the intersection (N, size), as LeftTurn shows it: vehicle 1 is the one oncoming car."""
    count = len(COLUMN) - 4
    front, heading = locate(np.hstack([seen[:, :count], np.zeros((len(seen), 4))]))
    ahead, left = other_corners(seen)
    # The front of the oncoming vehicle is the middle of its two front corners, which are observed first.
    y = front[:, 1] + (np.cos(heading)[:, None] * ahead + np.sin(heading)[:, None] * left)[:, :2].mean(axis=1)
    distance = y - ENTRY
    gone = absent(seen) | (distance < PASSED)
    cars = np.tile([SIGHT_DISTANCE, 0.0, SIGHT_DISTANCE, 0.0], (len(seen), 1))
    cars[:, 0] = np.where(gone, SIGHT_DISTANCE, np.minimum(distance, SIGHT_DISTANCE))
    # It comes down the road; what it has in the other direction would take it away.
    cars[:, 1] = np.where(gone, 0.0, np.maximum(-seen[:, SEEN["other_vy"]], 0.0))
    return np.hstack([seen[:, :count], cars])


def room_ahead(seen: Floats) -> Floats:
    """The distance (N,) (m) to the nearest corner of the other vehicle if it is in front of the own box, else inf."""
    ahead, left = other_corners(seen)
    spread = left.min(axis=1) < HALF_WIDTH + ASIDE, left.max(axis=1) > -HALF_WIDTH - ASIDE
    in_the_way = spread[0] & spread[1] & (ahead.max(axis=1) > 0.0) & ~absent(seen)
    return np.where(in_the_way, np.maximum(ahead.min(axis=1), 0.0), np.inf)


def other_corners(seen: Floats) -> tuple[Floats, Floats]:
    """The corners of the other vehicle as seen from the own front, (N, 4) each: metres ahead, and to the left."""
    corners = ("front_left", "front_right", "back_right", "back_left")
    angle = seen[:, [SEEN[f"other_{corner}_angle"] for corner in corners]]
    distance = seen[:, [SEEN[f"other_{corner}_distance"] for corner in corners]]
    return distance * np.cos(angle), -distance * np.sin(angle)


def absent(seen: Floats) -> NDArray[np.bool_]:
    """(N,) whether the other vehicle has left the road."""
    return np.asarray(
        (seen[:, SEEN["other_front_left_distance"]] == ABSENT_DISTANCE) & (seen[:, SEEN["other_vy"]] == 0.0)
    )


# Drivers of vehicle 1 in four families to train with, and in four others to meet.
TRAINING_PARTNERS = (
    *("rule:straight_2", "rule:straight_4", "rule:straight_6", "rule:straight_9"),
    *("rule:yields_2", "rule:yields_4", "rule:yields_6", "rule:yields_9"),
    *("rule:creeps_0.5", "rule:creeps_1", "rule:creeps_1.5"),
    *("rule:courteous_2", "rule:courteous_3", "rule:courteous_4"),
)
STRANGERS = (
    *("rule:parked_3", "rule:parked_6", "rule:parked_99"),
    *("rule:stops_0.5", "rule:stops_1", "rule:stops_2"),
    *("rule:late_3", "rule:late_6", "rule:late_12"),
    *("rule:waves_2", "rule:waves_3", "rule:waves_4"),
)

# ``rule:gap_3`` turns left and waits for a gap of 3 s; the others are drivers of vehicle 1. ``rule:straight_6`` drives
# straight on at 6 m/s, ``rule:yields_6`` does so and brakes for a vehicle in front of it; any numbers.
make_rule = partial(
    make_driver,
    {
        "gap_NUMBER": lambda gap, action_type: TurningDriver(MeetingRule(gap=gap), action_type),
        "straight_NUMBER": partial(StraightDriver, steadily),
        "yields_NUMBER": partial(StraightDriver, steadily, yields=True),
        "creeps_NUMBER": partial(StraightDriver, creeping),
        "courteous_NUMBER": partial(StraightDriver, courteous, yields=True),
        "waves_NUMBER": partial(StraightDriver, in_waves),
        "late_NUMBER": partial(StraightDriver, late),
        "parked_NUMBER": partial(StraightDriver, until),
        "stops_NUMBER": partial(StraightDriver, stopping, yields=True),
    },
)
