"""Roads of segments: where a vehicle is along its route, and its distances to the lines of its lane.

A route is a sequence of straights and arcs, each of which begins where and in which direction the one before it ends.
All positions are computed from the segments, without tables. A point is projected onto the segment whose normals at
both ends enclose it; there is one such segment for every point that is nearer to the line than the smallest radius.
"""

from __future__ import annotations

import math

from mo_deepdrive.simulation import geometry
from mo_deepdrive.simulation.geometry import HALF_LENGTH, HALF_WIDTH
from mo_deepdrive.simulation.jit import jit, separate_jit
from mo_deepdrive.simulation.state import LENGTH, Record
from mo_deepdrive.simulation.trigonometry import SMALLEST, angle_of, sine_cosine

# The two points of its route that a vehicle observes, ahead of its front (m).
NEXT_POINT = 6.0
POINT_AFTER = 15.0
# The rear corners are within this distance behind the projection of the front, and the front corners within it ahead.
BOX_REACH = 1.5 * LENGTH


@jit
def ahead_and_left(segment: Record, x: float, y: float) -> tuple[float, float]:
    """How far the point is ahead of the start of the segment, and to the left of it (m)."""
    dx = x - segment.x
    dy = y - segment.y
    ahead: float = dy * segment.cos_heading - dx * segment.sin_heading
    left: float = -(dx * segment.cos_heading + dy * segment.sin_heading)
    return ahead, left


@jit
def offset(segment: Record, x: float, y: float) -> float:
    """How far the point is to the left of the segment's line (m)."""
    ahead, left = ahead_and_left(segment, x, y)
    if segment.curvature == 0.0:
        return left
    radius: float = 1.0 / segment.curvature  # negative to the right
    away = math.sqrt((radius - left) * (radius - left) + ahead * ahead)
    return radius - math.copysign(away, radius)


@jit
def projection(segment: Record, x: float, y: float) -> float:
    """The arc length (m) from the start of the segment to the projection of the point onto its line."""
    ahead, left = ahead_and_left(segment, x, y)
    if segment.curvature == 0.0:
        return ahead
    # The angle at the centre is measured from the middle of the arc, so that it has one value along all of it.
    outwards = math.copysign(1.0, segment.curvature) * (1.0 / segment.curvature - left)
    cos, sin = segment.cos_half_angle, segment.sin_half_angle
    angle = angle_of(ahead * cos - outwards * sin, outwards * cos + ahead * sin)
    along: float = 0.5 * segment.length + angle / abs(segment.curvature)
    return along


@jit
def direction(segment: Record, x: float, y: float) -> tuple[float, float]:
    """Cosine and sine of the heading of the segment's line at the projection of the point."""
    if segment.curvature == 0.0:
        return segment.cos_heading, segment.sin_heading
    ahead, left = ahead_and_left(segment, x, y)
    outwards = math.copysign(1.0, segment.curvature) * (1.0 / segment.curvature - left)
    away = max(math.sqrt(outwards * outwards + ahead * ahead), SMALLEST)
    cos, sin = outwards / away, math.copysign(1.0, segment.curvature) * ahead / away
    return (
        segment.cos_heading * cos - segment.sin_heading * sin,
        segment.sin_heading * cos + segment.cos_heading * sin,
    )


@separate_jit
def pose_at(params: Record, route: int, distance: float) -> tuple[float, float, float, float]:
    """x, y (m), and cosine and sine of the heading, of the route's line ``distance`` (m) from its start.

    The first and the last segment continue beyond the ends of the route.
    """
    k = 0
    while k < params.n_segments[route] - 1 and distance >= params.segments[route, k + 1].along:
        k += 1
    segment = params.segments[route, k]
    along = distance - segment.along
    ahead, left, sin, cos = along, 0.0, 0.0, 1.0
    if segment.curvature != 0.0:
        sin, cos = sine_cosine(along * segment.curvature)
        ahead, left = sin / segment.curvature, (1.0 - cos) / segment.curvature
    return (
        segment.x - segment.sin_heading * ahead - segment.cos_heading * left,
        segment.y + segment.cos_heading * ahead - segment.sin_heading * left,
        segment.cos_heading * cos - segment.sin_heading * sin,
        segment.sin_heading * cos + segment.cos_heading * sin,
    )


@separate_jit
def follow(vehicle: Record, params: Record) -> bool:
    """Update where the front is along the route, and the two points ahead of it.

    The route distance is the arc length from the start of the route to the projection of the front.

    Returns:
        Whether the front has reached the end of the route.
    """
    x = vehicle.x - vehicle.sin_heading * HALF_LENGTH
    y = vehicle.y + vehicle.cos_heading * HALF_LENGTH
    route = vehicle.route
    k = vehicle.segment
    last = params.n_segments[route] - 1
    along = projection(params.segments[route, k], x, y)
    onwards = False
    while k < last and along >= params.segments[route, k].length:
        k += 1
        along = projection(params.segments[route, k], x, y)
        onwards = True
    while not onwards and k > 0 and along < 0.0:
        k -= 1
        along = projection(params.segments[route, k], x, y)
    segment = params.segments[route, k]
    cos, sin = direction(segment, x, y)
    vehicle.front_x = x
    vehicle.front_y = y
    vehicle.segment = k
    vehicle.route_distance = segment.along + along
    vehicle.lane_offset = offset(segment, x, y)
    vehicle.heading_error = angle_of(
        vehicle.sin_heading * cos - vehicle.cos_heading * sin, vehicle.cos_heading * cos + vehicle.sin_heading * sin
    )
    for point in range(2):
        ahead = NEXT_POINT if point == 0 else POINT_AFTER
        px, py, _, _ = pose_at(params, route, vehicle.route_distance + ahead)
        vehicle.waypoints[point, 0] = px
        vehicle.waypoints[point, 1] = py
    vehicle.next_distance = geometry.distance(x, y, vehicle.waypoints[0, 0], vehicle.waypoints[0, 1])
    vehicle.crossing = is_inside(params, route, vehicle.route_distance)
    if vehicle.crossing and vehicle.entered < 0:
        vehicle.entered = vehicle.decisions
    arrived: bool = vehicle.route_distance >= params.route_length[route]
    return arrived


@jit
def is_inside(params: Record, route: int, distance: float) -> bool:
    """Whether a front at ``distance`` (m) along the route is on the stretch that has right of way."""
    inside: bool = params.priority[route, 0] <= distance <= params.priority[route, 1]
    return inside


@jit
def segment_of(vehicle: Record, params: Record, x: float, y: float) -> int:
    """The segment of its route that a point of the vehicle's box is on."""
    route = vehicle.route
    k: int = vehicle.segment
    behind = vehicle.route_distance - params.segments[route, k].along
    while k > 0 and behind < BOX_REACH and ahead_and_left(params.segments[route, k], x, y)[0] < 0.0:
        k -= 1
        behind += params.segments[route, k].length
    if k < vehicle.segment:
        return k
    beyond = params.segments[route, k].length - behind
    while (
        k < params.n_segments[route] - 1
        and beyond < BOX_REACH
        and ahead_and_left(params.segments[route, k + 1], x, y)[0] >= 0.0
    ):
        k += 1
        beyond += params.segments[route, k].length
    return k


@separate_jit
def find_lane(vehicle: Record, params: Record) -> None:
    """Update the distances (m) from the vehicle's box to the left and the right line of its lane.

    A side of the box is nearest to a line at a corner, or where the normal of an arc meets the side at a right angle.
    """
    route = vehicle.route
    x, y, cos, sin = vehicle.x, vehicle.y, vehicle.cos_heading, vehicle.sin_heading
    leftmost, rightmost = -math.inf, math.inf
    first, last = vehicle.segment, vehicle.segment
    for corner in range(4):
        ahead = HALF_LENGTH if corner < 2 else -HALF_LENGTH
        right = HALF_WIDTH if corner % 2 == 0 else -HALF_WIDTH
        px, py = geometry.corner(x, y, cos, sin, ahead, right)
        k = segment_of(vehicle, params, px, py)
        left = offset(params.segments[route, k], px, py)
        leftmost, rightmost = max(leftmost, left), min(rightmost, left)
        first, last = min(first, k), max(last, k)
    for k in range(first, last + 1):
        segment = params.segments[route, k]
        if segment.curvature != 0.0:
            centre_x = segment.x - segment.cos_heading / segment.curvature
            centre_y = segment.y - segment.sin_heading / segment.curvature
            ahead = (centre_y - y) * cos - (centre_x - x) * sin
            if abs(ahead) < HALF_LENGTH:
                for side in range(2):
                    px, py = geometry.corner(x, y, cos, sin, ahead, HALF_WIDTH if side == 0 else -HALF_WIDTH)
                    if segment_of(vehicle, params, px, py) == k:
                        left = offset(segment, px, py)
                        leftmost, rightmost = max(leftmost, left), min(rightmost, left)
    vehicle.left_lane_distance = params.half_lane[route] - leftmost
    vehicle.right_lane_distance = params.half_lane[route] + rightmost
