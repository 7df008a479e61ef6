"""What a vehicle observes, computed; :func:`mo_deepdrive.world.observation.layout` describes the entries."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mo_deepdrive.simulation import geometry, neighbours, traffic
from mo_deepdrive.simulation.geometry import HALF_LENGTH, HALF_WIDTH
from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.state import MAX_WAYPOINTS, NEAREST_CARS, RUNNING, Record, Records, in_lanes

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

# A vehicle that has left the road is observed straight ahead, at rest, at this distance (m).
ABSENT_DISTANCE = 100.0

# Oncoming cars are observed from this distance to the crossing on (m).
SIGHT_DISTANCE = 100.0

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
def write_oncoming(worlds: Records, i: int, v: int, position: int, params: Record, out: NDArray[np.float32]) -> None:
    """Write distance and speed of the nearest oncoming cars of world ``i`` from the column ``position`` on.

    Where there is none in sight, or fewer are observed, the distance is that of sight, and the speed zero.
    """
    for column in range(position, position + 2 * NEAREST_CARS, 2):
        out[i, v, column] = SIGHT_DISTANCE
        out[i, v, column + 1] = 0.0
    column = position
    last = position + 2 * params.observed_cars
    for k in range(len(worlds[i, v].cars)):
        car = worlds[i, v].cars[k]
        distance = traffic.distance_to_crossing(car)
        seen = car.present and not traffic.has_passed(car) and distance <= SIGHT_DISTANCE
        if seen and column < last:
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
    if params.n_routes > 0:
        for lane in range(lanes):
            neighbours.write(worlds, first + lane, v, position, ABSENT_DISTANCE, params, out)
        return
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
            write_oncoming(worlds, first + lane, v, position, params, out)
