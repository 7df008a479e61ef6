"""Scripted drivers for the two vehicles of the intersection, by name.

Vehicle 0 turns left as in LeftTurn and waits for a gap before vehicle 1; vehicle 1 drives straight on at some speed and
may brake for a vehicle in front of it. They remember nothing: an action follows from one observation.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.driving.controls import Driver, make_driver
from algorithms.driving.left_turn_rules import COLUMN, GapDriver, GapRule, locate
from mo_deepdrive.simulation.geometry import HALF_WIDTH
from mo_deepdrive.simulation.observation import ABSENT_DISTANCE, SIGHT_DISTANCE
from mo_deepdrive.simulation.state import LANE_WIDTH, LENGTH
from mo_deepdrive.simulation.traffic import ENTRY
from mo_deepdrive.world.observation import layout
from mo_deepdrive.world.scenarios import SCENARIOS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

SCENARIO = SCENARIOS["intersection"]
SEEN = {entry.name: column for column, entry in enumerate(layout(SCENARIO))}

PASSED = -(2.0 * LANE_WIDTH + LENGTH)  # m, distance to the crossing of a vehicle whose rear has left it
PAST_LINE = -0.3  # m beyond the line a vehicle no longer waits
HEADING_GAIN = 0.05  # curvature (1/m) per rad towards the destination
COMFORTABLE = 2.0  # m/s^2 of braking for a vehicle in front
CLEARANCE = 3.0  # m that are left to it
ASIDE = 0.3  # m beside the own box within which a vehicle is in the way


class TurningDriver(GapDriver):
    """Vehicle 0: turns left once vehicle 1 is at least ``gap`` seconds from the crossing at its present speed."""

    vehicle = 0

    def __init__(self, gap: float, action_type: str):
        super().__init__(GapRule(gap=gap), action_type)

    def __call__(self, observations: NDArray[np.float32], *_: Any) -> NDArray[Any]:
        """Actions for observations (N, size) of the vehicle."""
        seen = as_in_left_turn(np.asarray(observations, dtype=np.float64))
        line = self.line(locate(seen)[0])
        return self.actions(seen, self.may_go(seen, line) | (line < PAST_LINE))


class StraightDriver(Driver):
    """Vehicle 1: drives straight on at a speed (m/s), and may brake for a vehicle in front of it."""

    vehicle = 1

    def __init__(self, speed: float, action_type: str, *, yields: bool):
        super().__init__(action_type)
        self._speed, self._yields = speed, yields

    def __call__(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """Actions for observations (N, size) of the vehicle."""
        seen = np.asarray(observations, dtype=np.float64)
        speed = seen[:, COLUMN["speed"]]
        room = room_ahead(seen) - CLEARANCE
        brakes = (room < speed**2 / (2.0 * COMFORTABLE)) & self._yields
        curvature = -HEADING_GAIN * seen[:, COLUMN["next_angle"]]
        return self.control(seen, curvature, np.where(brakes, 0.0, self._speed), brakes, room)


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


# ``rule:gap_3`` turns left and waits for a gap of 3 s, ``rule:straight_6`` drives straight on at 6 m/s, and
# ``rule:yields_6`` does so and brakes for a vehicle in front of it; any numbers.
make_rule = partial(
    make_driver,
    {
        "gap_NUMBER": TurningDriver,
        "straight_NUMBER": partial(StraightDriver, yields=False),
        "yields_NUMBER": partial(StraightDriver, yields=True),
    },
)
