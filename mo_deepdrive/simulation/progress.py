"""Progress of a vehicle along its waypoints, and its distances to the lane lines."""

from __future__ import annotations

from mo_deepdrive.simulation import geometry
from mo_deepdrive.simulation.geometry import HALF_LENGTH
from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.state import ARRIVAL_RADIUS, HALF_LANE, LANE_WIDTH, Record


@jit
def follow(vehicle: Record) -> bool:
    """Update the front point, the next waypoint and the distances.

    Route distance = distance along the waypoints to the next one - ``|front -> next waypoint|``.

    Returns:
        Whether the destination is reached.
    """
    vehicle.front_x = vehicle.x - vehicle.sin_heading * HALF_LENGTH
    vehicle.front_y = vehicle.y + vehicle.cos_heading * HALF_LENGTH
    k = vehicle.next_waypoint
    away = geometry.distance(vehicle.front_x, vehicle.front_y, vehicle.waypoints[k, 0], vehicle.waypoints[k, 1])
    last = k == vehicle.n_waypoints - 1
    arrived = last and away < ARRIVAL_RADIUS
    if not last and away < ARRIVAL_RADIUS:
        k += 1
        vehicle.next_waypoint = k
        away = geometry.distance(vehicle.front_x, vehicle.front_y, vehicle.waypoints[k, 0], vehicle.waypoints[k, 1])
    vehicle.next_distance = away
    vehicle.route_distance = vehicle.along[k] - away
    return arrived


@jit
def skipped(vehicle: Record) -> bool:
    """Whether the front is closer to a waypoint beyond the next one than to any other."""
    nearest = 0
    best = geometry.distance(vehicle.front_x, vehicle.front_y, vehicle.waypoints[0, 0], vehicle.waypoints[0, 1])
    for k in range(1, vehicle.n_waypoints):
        away = geometry.distance(vehicle.front_x, vehicle.front_y, vehicle.waypoints[k, 0], vehicle.waypoints[k, 1])
        if away < best:
            nearest = k
            best = away
    beyond: bool = nearest > vehicle.next_waypoint
    return beyond


@jit
def find_lane(vehicle: Record, params: Record) -> None:
    """Update the distances (m) to the left and right lane line and the crossing and approaching flags.

    A route of one waypoint runs straight down its lane; one of more turns left between the first and the second.
    """
    x = vehicle.x
    y = vehicle.y
    cos = vehicle.cos_heading
    sin = vehicle.sin_heading
    lane = vehicle.lane_centre
    low_x, high_x = geometry.extent_x(x, cos, sin)
    low_y, high_y = geometry.extent_y(y, cos, sin)
    vehicle.crossing = False
    if vehicle.n_waypoints == 1:
        vehicle.right_lane_distance = low_x - (lane - HALF_LANE)
        vehicle.left_lane_distance = lane + HALF_LANE - high_x
        vehicle.approaching = low_y > params.map_centre + LANE_WIDTH
    elif vehicle.front_y < vehicle.waypoints[0, 1]:
        vehicle.left_lane_distance = low_x - (lane - HALF_LANE)
        vehicle.right_lane_distance = lane + HALF_LANE - high_x
    elif vehicle.front_x < vehicle.waypoints[1, 0]:
        exit_lane = vehicle.waypoints[1, 1]
        rear_x = x + sin * HALF_LENGTH
        if rear_x > vehicle.waypoints[1, 0]:
            half = abs(sin) * geometry.HALF_WIDTH
            low_y = vehicle.front_y - half
            high_y = vehicle.front_y + half
        vehicle.left_lane_distance = low_y - (exit_lane - HALF_LANE)
        vehicle.right_lane_distance = exit_lane + HALF_LANE - high_y
    else:
        vehicle.crossing = True
        vehicle.left_lane_distance = HALF_LANE
        vehicle.right_lane_distance = HALF_LANE
