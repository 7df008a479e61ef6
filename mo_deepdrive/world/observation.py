"""What a vehicle observes: :func:`layout` describes the entries, ``simulation/observation.py`` computes them.

Observations are float32 and in SI units. Learners divide by ``scale``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from mo_deepdrive.simulation.neighbours import NEIGHBOURS
from mo_deepdrive.simulation.observation import SIGHT_DISTANCE
from mo_deepdrive.simulation.state import LANE_WIDTH, LENGTH, NEAREST_CARS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mo_deepdrive.world.scenarios import Scenario

_TURN = math.pi
FAR = 2000.0


@dataclass(frozen=True)
class Entry:
    """One observed quantity."""

    name: str  #: unique within a layout
    unit: str  #: SI
    #: Lower bound of the observation space; None if it follows from the configuration (see :func:`bounds`).
    low: float | None
    high: float | None  #: upper bound, likewise
    scale: float  #: nominal magnitude, by which learners divide


# Of every vehicle.
OWN: tuple[Entry, ...] = (
    Entry("next_angle", "rad", -_TURN, _TURN, 1.0),
    Entry("after_angle", "rad", -_TURN, _TURN, 1.0),
    Entry("next_distance", "m", 0.0, FAR, 20.0),
    Entry("after_distance", "m", 0.0, FAR, 20.0),
    Entry("vx", "m/s", None, None, 5.0),
    Entry("vy", "m/s", None, None, 5.0),
    Entry("ax", "m/s^2", None, None, 5.0),
    Entry("ay", "m/s^2", None, None, 5.0),
    Entry("steer", "rad", None, None, 0.2),
    Entry("throttle", "m/s^2", None, None, 1.0),
    Entry("brake", "1", 0.0, 4.0, 1.0),
    Entry("speed", "m/s", None, None, 5.0),
    Entry("left_lane_distance", "m", -FAR, FAR, 1.5),
    Entry("right_lane_distance", "m", -FAR, FAR, 1.5),
    Entry("crossing", "1", 0.0, 1.0, 1.0),
)
# Of every obstacle; the names of the second one begin with obstacle_2.
OBSTACLE: tuple[Entry, ...] = (
    Entry("obstacle_a_distance", "m", 0.0, FAR, 20.0),
    Entry("obstacle_b_distance", "m", 0.0, FAR, 20.0),
    Entry("obstacle_a_angle", "rad", -_TURN, _TURN, 1.0),
    Entry("obstacle_b_angle", "rad", -_TURN, _TURN, 1.0),
)
# Of the other vehicle, if there is one.
OTHER: tuple[Entry, ...] = (
    Entry("other_relative_vx", "m/s", None, None, 5.0),
    Entry("other_relative_vy", "m/s", None, None, 5.0),
    Entry("other_vx", "m/s", None, None, 5.0),
    Entry("other_vy", "m/s", None, None, 5.0),
    Entry("other_ax", "m/s^2", None, None, 5.0),
    Entry("other_ay", "m/s^2", None, None, 5.0),
    *(
        entry
        for corner in ("front_left", "front_right", "back_right", "back_left")
        for entry in (
            Entry(f"other_{corner}_angle", "rad", -_TURN, _TURN, 1.0),
            Entry(f"other_{corner}_distance", "m", 0.0, FAR, 20.0),
        )
    ),
)
# Of the nearest oncoming car: from its front to the crossing, negative inside it.
ONCOMING: tuple[Entry, ...] = (
    Entry("oncoming_distance", "m", -(2 * LANE_WIDTH + LENGTH), SIGHT_DISTANCE, 20.0),
    Entry("oncoming_speed", "m/s", 0.0, None, 5.0),
)
# Of the route, on roads of segments: along it, from the front to where it has right of way (0 from there on) and to its
# end.
ROAD: tuple[Entry, ...] = (
    Entry("entry_distance", "m", 0.0, FAR, 20.0),
    Entry("remaining_distance", "m", -FAR, FAR, 20.0),
    Entry("heading_error", "rad", -_TURN, _TURN, 1.0),
)
# Of each of the nearest vehicles and cars there, in the frame of the vehicle: from centre to centre, and whether it is
# on the stretch with right of way, whether it has right of way over the vehicle, and whether it is there at all.
NEIGHBOUR: tuple[Entry, ...] = (
    Entry("near_right", "m", -FAR, FAR, 20.0),
    Entry("near_ahead", "m", -FAR, FAR, 20.0),
    Entry("near_v_right", "m/s", None, None, 5.0),
    Entry("near_v_ahead", "m/s", None, None, 5.0),
    Entry("near_cos_heading", "1", -1.0, 1.0, 1.0),
    Entry("near_sin_heading", "1", -1.0, 1.0, 1.0),
    Entry("near_inside", "1", 0.0, 1.0, 1.0),
    Entry("near_right_of_way", "1", 0.0, 1.0, 1.0),
    Entry("near_present", "1", 0.0, 1.0, 1.0),
)


def _numbered(entries: tuple[Entry, ...], word: str, numbers: range) -> list[Entry]:
    return [replace(each, name=each.name.replace(word, f"{word}_{number}")) for number in numbers for each in entries]


def layout(scenario: Scenario) -> tuple[Entry, ...]:
    """The entries that are observed in ``scenario``, in order."""
    if scenario.roads:
        return (*OWN, *ROAD, *_numbered(NEIGHBOUR, "near", range(1, NEIGHBOURS + 1)))
    obstacles = [*OBSTACLE, *_numbered(OBSTACLE, "obstacle", range(2, scenario.obstacles + 1))]
    oncoming = _numbered(ONCOMING, "oncoming", range(1, NEAREST_CARS + 1))
    return (
        *OWN,
        *(obstacles if scenario.obstacles else ()),
        *(OTHER if scenario.vehicles > 1 else ()),
        *(oncoming if scenario.cars else ()),
    )


def scales(scenario: Scenario) -> NDArray[np.float64]:
    """Nominal magnitude of every observed entry, shape (size,)."""
    return np.array([entry.scale for entry in layout(scenario)])


def bounds(scenario: Scenario, limits: dict[str, float]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Lower and upper bounds of every observed entry, (size,) each; ``limits`` has bounds by unit or name."""
    low, high = [], []
    for entry in layout(scenario):
        limit = limits.get(entry.name, limits.get(entry.unit, 0.0))
        low.append(-limit if entry.low is None else entry.low)
        high.append(limit if entry.high is None else entry.high)
    return np.array(low, dtype=np.float32), np.array(high, dtype=np.float32)
