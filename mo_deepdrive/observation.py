"""What a vehicle observes: :func:`layout` describes the entries, :func:`write` computes them.

Observations are float32 and in SI units. Learners divide by ``scale``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from mo_deepdrive.simulation import geometry, traffic
from mo_deepdrive.simulation.geometry import HALF_LENGTH, HALF_WIDTH
from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.lanes import in_lanes
from mo_deepdrive.simulation.state import LANE_WIDTH, LENGTH, MAX_WAYPOINTS, RUNNING, Record, Records

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mo_deepdrive.scenarios import Scenario

# A vehicle that has left the road is observed straight ahead, at rest, at this distance (m).
ABSENT_DISTANCE = 100.0

# So many oncoming cars are observed, the next ones that have not passed the crossing, from this distance to it on (m).
NEAREST_CARS = 2
SIGHT_DISTANCE = 100.0

_TURN = math.pi
FAR = 2000.0


@dataclass(frozen=True)
class Entry:
    """One observed quantity.

    Attributes:
        name: unique within a layout.
        unit: SI.
        low: lower bound of the observation space; None if it follows from the configuration (see :func:`bounds`).
        high: upper bound, likewise.
        scale: nominal magnitude, by which learners divide.
    """

    name: str
    unit: str
    low: float | None
    high: float | None
    scale: float


def _corner_entries() -> tuple[Entry, ...]:
    corners = ("front_left", "front_right", "back_right", "back_left")
    return tuple(
        entry
        for corner in corners
        for entry in (
            Entry(f"other_{corner}_angle", "rad", -_TURN, _TURN, 1.0),
            Entry(f"other_{corner}_distance", "m", 0.0, FAR, 20.0),
        )
    )


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
    *_corner_entries(),
)
# Of the nearest oncoming car: from its front to the crossing, negative inside it.
ONCOMING: tuple[Entry, ...] = (
    Entry("oncoming_distance", "m", -(2 * LANE_WIDTH + LENGTH), SIGHT_DISTANCE, 20.0),
    Entry("oncoming_speed", "m/s", 0.0, None, 5.0),
)


def layout(scenario: Scenario) -> tuple[Entry, ...]:
    """The entries that are observed in ``scenario``, in order."""
    obstacles = [
        replace(entry, name=entry.name.replace("obstacle", f"obstacle_{number}" if number > 1 else "obstacle"))
        for number in range(1, scenario.obstacles + 1)
        for entry in OBSTACLE
    ]
    oncoming = [
        replace(entry, name=entry.name.replace("oncoming", f"oncoming_{number}"))
        for number in range(1, NEAREST_CARS + 1 if scenario.cars else 1)
        for entry in ONCOMING
    ]
    return (*OWN, *obstacles, *(OTHER if scenario.vehicles > 1 else ()), *oncoming)


def scales(scenario: Scenario) -> NDArray[np.float64]:
    """Nominal magnitude of every observed entry, shape (size,)."""
    return np.array([entry.scale for entry in layout(scenario)])


# Where the vehicles in the lanes look from, at which points, and what they see.
SIGHT = in_lanes("front_x", "front_y", "cos", "sin", "x", "y", "angle", "distance")


@jit
def look(s: Record, lanes: int) -> None:
    """Measure the angle and the distance to the point (x, y) of every lane."""
    for lane in range(lanes):
        x, y = s.front_x[lane], s.front_y[lane]
        s.angle[lane] = geometry.angle_to(x, y, s.cos[lane], s.sin[lane], s.x[lane], s.y[lane])
        s.distance[lane] = geometry.distance(x, y, s.x[lane], s.y[lane])


@jit
def write_oncoming(worlds: Records, i: int, v: int, position: int, out: NDArray[np.float32]) -> None:
    """Write distance and speed of the nearest oncoming cars of world ``i`` from the column ``position`` on.

    Where there is none in sight, the distance is that of sight, and the speed zero.
    """
    for column in range(position, position + 2 * NEAREST_CARS, 2):
        out[i, v, column] = SIGHT_DISTANCE
        out[i, v, column + 1] = 0.0
    column = position
    for k in range(len(worlds[i, v].cars)):
        car = worlds[i, v].cars[k]
        distance = traffic.distance_to_crossing(car)
        seen = car.present and not traffic.has_passed(car) and distance <= SIGHT_DISTANCE
        if seen and column < position + 2 * NEAREST_CARS:
            out[i, v, column] = distance
            out[i, v, column + 1] = car.speed
            column += 2


@jit
def write(
    worlds: Records, first: int, last: int, v: int, params: Record, sight: Records, out: NDArray[np.float32]
) -> None:
    """Write the observations of vehicle ``v`` of the worlds ``first`` to ``last`` - 1.

    Args:
        worlds: (worlds, vehicles) of VEHICLE.
        first: the world in lane 0.
        last: the world after the last one, at most ``first`` + LANES.
        v: which vehicle.
        params: record of dtype PARAMS.
        sight: (1,) of SIGHT, scratch.
        out: (worlds, vehicles, size), written.
    """
    s = sight[0]
    lanes = last - first
    for lane in range(lanes):
        vehicle = worlds[first + lane, v]
        s.front_x[lane] = vehicle.front_x
        s.front_y[lane] = vehicle.front_y
        s.cos[lane] = vehicle.cos_heading
        s.sin[lane] = vehicle.sin_heading
        s.x[lane] = vehicle.waypoints[vehicle.next_waypoint, 0]
        s.y[lane] = vehicle.waypoints[vehicle.next_waypoint, 1]
    look(s, lanes)
    for lane in range(lanes):
        i = first + lane
        vehicle = worlds[i, v]
        out[i, v, 0] = s.angle[lane]
        out[i, v, 1] = s.angle[lane]
        out[i, v, 2] = vehicle.next_distance
        out[i, v, 3] = vehicle.next_distance
        out[i, v, 4] = vehicle.vx
        out[i, v, 5] = vehicle.vy
        out[i, v, 6] = vehicle.ax
        out[i, v, 7] = vehicle.ay
        out[i, v, 8] = vehicle.steer
        out[i, v, 9] = vehicle.throttle
        out[i, v, 10] = vehicle.brake
        out[i, v, 11] = vehicle.speed
        out[i, v, 12] = vehicle.left_lane_distance
        out[i, v, 13] = vehicle.right_lane_distance
        out[i, v, 14] = 1.0 if vehicle.crossing else 0.0
    if params.n_waypoints[v] > 1:
        for lane in range(lanes):
            vehicle = worlds[first + lane, v]
            k = min(vehicle.next_waypoint + 1, MAX_WAYPOINTS - 1)
            s.x[lane] = vehicle.waypoints[k, 0]
            s.y[lane] = vehicle.waypoints[k, 1]
        look(s, lanes)
        for lane in range(lanes):
            vehicle = worlds[first + lane, v]
            if vehicle.next_waypoint + 1 < vehicle.n_waypoints:
                out[first + lane, v, 1] = s.angle[lane]
                out[first + lane, v, 3] = vehicle.next_distance + s.distance[lane]
    position = 15
    if params.has_obstacle:
        for k in range(len(worlds[first, v].obstacle)):
            for lane in range(lanes):
                s.x[lane] = worlds[first + lane, v].obstacle[k, 0]
                s.y[lane] = worlds[first + lane, v].obstacle[k, 1]
            look(s, lanes)
            # Of each obstacle: the distances to both ends, then the angles.
            column = position + 4 * (k // 2) + k % 2
            for lane in range(lanes):
                out[first + lane, v, column] = s.distance[lane]
                out[first + lane, v, column + 2] = s.angle[lane]
        position += 2 * len(worlds[first, v].obstacle)
    if worlds.shape[1] > 1:
        for lane in range(lanes):
            i = first + lane
            vehicle = worlds[i, v]
            other = worlds[i, 1 - v]
            present = other.end == RUNNING
            out[i, v, position] = other.vx - vehicle.vx if present else 0.0
            out[i, v, position + 1] = other.vy - vehicle.vy if present else 0.0
            out[i, v, position + 2] = other.vx if present else 0.0
            out[i, v, position + 3] = other.vy if present else 0.0
            out[i, v, position + 4] = other.ax if present else 0.0
            out[i, v, position + 5] = other.ay if present else 0.0
        position += 6
        for corner in range(4):
            ahead = HALF_LENGTH if corner < 2 else -HALF_LENGTH
            right = HALF_WIDTH if corner == 1 or corner == 2 else -HALF_WIDTH
            for lane in range(lanes):
                other = worlds[first + lane, 1 - v]
                s.x[lane], s.y[lane] = geometry.corner(
                    other.x, other.y, other.cos_heading, other.sin_heading, ahead, right
                )
            look(s, lanes)
            for lane in range(lanes):
                present = worlds[first + lane, 1 - v].end == RUNNING
                out[first + lane, v, position + 2 * corner] = s.angle[lane] if present else 0.0
                out[first + lane, v, position + 2 * corner + 1] = s.distance[lane] if present else ABSENT_DISTANCE
        position += 8
    if len(worlds[first, v].cars) > 0:
        for lane in range(lanes):
            write_oncoming(worlds, first + lane, v, position, out)


def bounds(scenario: Scenario, limits: dict[str, float]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Lower and upper bounds of every observed entry, (size,) each; ``limits`` has bounds by unit or name."""
    low, high = [], []
    for entry in layout(scenario):
        limit = limits.get(entry.name, limits.get(entry.unit, 0.0))
        low.append(-limit if entry.low is None else entry.low)
        high.append(limit if entry.high is None else entry.high)
    return np.array(low, dtype=np.float32), np.array(high, dtype=np.float32)
