"""What a vehicle observes: :func:`layout` describes the entries, :func:`write` computes them.

Observations are float32 and in SI units. Learners divide by ``scale``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from mo_deepdrive.simulation import geometry
from mo_deepdrive.simulation.geometry import HALF_LENGTH, HALF_WIDTH
from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.state import RUNNING, Record, Records

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mo_deepdrive.scenarios import Scenario

# A vehicle that has left the road is observed straight ahead, at rest, at this distance (m).
ABSENT_DISTANCE = 100.0

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


def layout(scenario: Scenario) -> tuple[Entry, ...]:
    """The entries that are observed in ``scenario``, in order."""
    further = [
        replace(entry, name=entry.name.replace("obstacle", f"obstacle_{number}"))
        for number in range(2, scenario.obstacles + 1)
        for entry in OBSTACLE
    ]
    return (*OWN, *(OBSTACLE if scenario.obstacles else ()), *further, *(OTHER if scenario.vehicles > 1 else ()))


def scales(scenario: Scenario) -> NDArray[np.float64]:
    """Nominal magnitude of every observed entry, shape (size,)."""
    return np.array([entry.scale for entry in layout(scenario)])


@jit
def write(worlds: Records, i: int, v: int, params: Record, out: NDArray[np.float32]) -> None:
    """Write the observation of vehicle ``v`` of world ``i`` into ``out`` (worlds, vehicles, size)."""
    vehicle = worlds[i, v]
    cos = vehicle.cos_heading
    sin = vehicle.sin_heading
    front_x = vehicle.front_x
    front_y = vehicle.front_y
    k = vehicle.next_waypoint
    px = vehicle.waypoints[k, 0]
    py = vehicle.waypoints[k, 1]
    next_angle = geometry.angle_to(front_x, front_y, cos, sin, px, py)
    next_distance = vehicle.next_distance
    after_angle = next_angle
    after_distance = next_distance
    if k + 1 < vehicle.n_waypoints:
        px = vehicle.waypoints[k + 1, 0]
        py = vehicle.waypoints[k + 1, 1]
        after_angle = geometry.angle_to(front_x, front_y, cos, sin, px, py)
        after_distance += geometry.distance(front_x, front_y, px, py)
    out[i, v, 0] = next_angle
    out[i, v, 1] = after_angle
    out[i, v, 2] = next_distance
    out[i, v, 3] = after_distance
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
    position = 15
    if params.has_obstacle:
        for k in range(0, len(vehicle.obstacle), 2):
            for end in range(2):
                px = vehicle.obstacle[k + end, 0]
                py = vehicle.obstacle[k + end, 1]
                out[i, v, position + end] = geometry.distance(front_x, front_y, px, py)
                out[i, v, position + 2 + end] = geometry.angle_to(front_x, front_y, cos, sin, px, py)
            position += 4
    if worlds.shape[1] > 1:
        other = worlds[i, 1 - v]
        if other.end == RUNNING:
            out[i, v, position] = other.vx - vehicle.vx
            out[i, v, position + 1] = other.vy - vehicle.vy
            out[i, v, position + 2] = other.vx
            out[i, v, position + 3] = other.vy
            out[i, v, position + 4] = other.ax
            out[i, v, position + 5] = other.ay
            position += 6
            x = other.x
            y = other.y
            cos_other = other.cos_heading
            sin_other = other.sin_heading
            for corner in range(4):
                ahead = HALF_LENGTH if corner < 2 else -HALF_LENGTH
                right = HALF_WIDTH if corner == 1 or corner == 2 else -HALF_WIDTH
                px, py = geometry.corner(x, y, cos_other, sin_other, ahead, right)
                out[i, v, position + 2 * corner] = geometry.angle_to(front_x, front_y, cos, sin, px, py)
                out[i, v, position + 2 * corner + 1] = geometry.distance(front_x, front_y, px, py)
        else:
            for offset in range(6):
                out[i, v, position + offset] = 0.0
            for corner in range(4):
                out[i, v, position + 6 + 2 * corner] = 0.0
                out[i, v, position + 7 + 2 * corner] = ABSENT_DISTANCE


def bounds(scenario: Scenario, limits: dict[str, float]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Lower and upper bounds of every observed entry, (size,) each; ``limits`` has bounds by unit or name."""
    low, high = [], []
    for entry in layout(scenario):
        limit = limits.get(entry.name, limits.get(entry.unit, 0.0))
        low.append(-limit if entry.low is None else entry.low)
        high.append(limit if entry.high is None else entry.high)
    return np.array(low, dtype=np.float32), np.array(high, dtype=np.float32)
