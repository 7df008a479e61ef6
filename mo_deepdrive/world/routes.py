"""Routes as data: points to drive to, or roads made of straights and arcs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.simulation.state import (
    LANE_WIDTH,
    LENGTH,
    MAX_ROUTES,
    MAX_SEGMENTS,
    MAX_WAYPOINTS,
    STANDSTILL_GAP,
    WIDTH,
)
from mo_deepdrive.support.plain_values import finite_numbers, is_finite

if TYPE_CHECKING:
    from collections.abc import Sequence

MOST_TURNED = 250.0  # rad; largest heading
FARTHEST = 250.0  # m; largest coordinate of a start, waypoint or road, so that observations stay in their space
JOINT = (0.01, 0.001)  # m and rad, by which what joins may be apart
LARGEST_RADIUS = 1e9  # m; of a larger one rounding takes distances to the centre more than it bends

Pose = tuple[float, float, float]  # x, y (m) and heading (rad), which is 0 along +y and grows to the left


@dataclass(frozen=True)
class Segment:
    """A straight or an arc of a route.

    Attributes:
        length: of its line (m).
        curvature: 1 / radius (1/m), positive to the left; 0 for a straight.
    """

    length: float
    curvature: float = 0.0

    def end(self, start: Pose) -> Pose:
        """Where the segment ends that begins at ``start``."""
        x, y, heading = start
        turn = self.length * self.curvature
        ahead = self.length if turn == 0.0 else math.sin(turn) / self.curvature
        left = 0.0 if turn == 0.0 else (1.0 - math.cos(turn)) / self.curvature
        cos, sin = math.cos(heading), math.sin(heading)
        return x - sin * ahead - cos * left, y + cos * ahead - sin * left, heading + turn


@dataclass(frozen=True)
class Route:
    """Where a vehicle starts, and where it drives: to waypoints, or along a lane made of segments.

    Attributes:
        start: x, y (m) and heading (rad). On a lane it is where the lane begins; vehicles start on its first segment.
        waypoints: (x, y) of one to three points (m), the last of which is the destination; none on a lane.
        start_span: range of the start along y (m). On a lane the first vehicle starts with its front up to this far
            before the end of the first segment, and everybody else with as much range behind the one ahead.
        segments: the straights and arcs of a lane, each of which begins where the one before it ends.
        end: where the lane ends: x, y and heading; None for wherever its segments lead.
        lane_width: of a lane (m).
        priority: from where to where along a lane (m) the front has right of way over those who have not reached that
            stretch of their lane; None for all of it.
    """

    start: Pose
    waypoints: tuple[tuple[float, float], ...] = ()
    start_span: float = 0.0
    segments: tuple[Segment, ...] = ()
    end: Pose | None = None
    lane_width: float = LANE_WIDTH
    priority: tuple[float, float] | None = None

    @property
    def length(self) -> float:
        """The length of a lane (m)."""
        return sum(segment.length for segment in self.segments)

    def joints(self) -> list[Pose]:
        """Where the segments of a lane begin, and where the last one ends."""
        poses = [self.start]
        for segment in self.segments:
            poses.append(segment.end(poses[-1]))
        return poses

    def traced(self, start: float = 0.0, step: float = 1.0) -> list[Pose]:
        """The line of a lane from ``start`` (m) on, at least every ``step`` (m), with its joints and its end."""
        poses, along = [], 0.0
        for segment, joint in zip(self.segments, self.joints(), strict=False):
            parts = max(1, math.ceil(segment.length / step))
            for k in range(parts):
                if (distance := segment.length * k / parts) + along >= start:
                    poses.append(Segment(distance, segment.curvature).end(joint))
            along += segment.length
        return [*poses, self.joints()[-1]]


def entries(routes: Sequence[Route]) -> list[int]:
    """The number of the entry at which every lane begins; lanes with the same start have the same entry."""
    starts = list(dict.fromkeys(route.start for route in routes))
    return [starts.index(route.start) for route in routes]


def entry_room(route: Route) -> int:
    """How many vehicles can wait on the first segment of a lane, however they are drawn."""
    each = route.start_span + LENGTH + STANDSTILL_GAP
    return int((route.segments[0].length + STANDSTILL_GAP) / each + 1e-9)


def capacity(routes: Sequence[Route]) -> int:
    """How many vehicles can wait on the first segments of lanes."""
    return sum(entry_room(route) for route in {route.start: route for route in routes}.values())


def shape_of(value: Any) -> tuple[int, ...] | None:
    """The shape of finite numbers; None for anything else."""
    numbers = finite_numbers(value)
    return None if numbers is None else numbers.shape


def as_tuples(route: Route) -> Route:
    """The same route with tuples of floats, which can be compared, instead of arrays and lists."""
    return replace(
        route,
        start=_tuple(route.start),
        waypoints=tuple(_tuple(point) for point in route.waypoints),
        start_span=float(route.start_span),
        segments=tuple(Segment(float(part.length), float(part.curvature)) for part in route.segments),
        end=None if route.end is None else _tuple(route.end),
        lane_width=float(route.lane_width),
        priority=None if route.priority is None else _tuple(route.priority),
    )


def _tuple(numbers: Any) -> Any:
    return tuple(float(number) for number in numbers)


def waypoints_problem(v: int, route: Route, span: tuple[float, float]) -> str:
    """What is wrong with a route of waypoints whose destination has a ``span`` (m); "" if nothing is."""
    shape = shape_of(route.waypoints)
    if not shape or (shape[1:] != (2,) and shape != (0,)):
        return f"waypoints = {route.waypoints!r} of route {v} must be (x, y) pairs of finite numbers in m"
    for name in ("end", "lane_width", "priority"):
        if np.any(getattr(route, name) != getattr(Route, name)):
            return f"{name} = {getattr(route, name)!r} of route {v} has no effect without segments; omit it"
    if not 1 <= shape[0] <= MAX_WAYPOINTS:
        return f"waypoints of route {v} has {shape[0]} points; it must have 1 to {MAX_WAYPOINTS}"
    x, y, _ = route.start
    points = (*route.waypoints, np.add(route.waypoints[-1], span))
    if np.abs(np.array([(x, y), (x, y + route.start_span), *points])).max() > FARTHEST:
        return f"route {v} with its spans leaves [-{FARTHEST:g}, {FARTHEST:g}] m"
    return ""


def start_problem(v: int, route: Route) -> str:
    """What is wrong with the start of a route; "" if nothing is."""
    if shape_of(route.start) != (3,):
        return f"start = {route.start!r} of route {v} must be (x, y, heading): finite numbers in m and rad"
    if abs(route.start[2]) > MOST_TURNED:
        return f"start = {route.start!r} of route {v} must have a heading in [-{MOST_TURNED:g}, {MOST_TURNED:g}] rad"
    if not is_finite(route.start_span):
        return f"start_span = {route.start_span!r} of route {v} must be a finite number in m"
    return ""


def lane_problem(v: int, route: Route) -> str:
    """What is wrong with a route of segments; "" if nothing is."""
    segments, longest = route.segments, 2 * FARTHEST
    if not isinstance(segments, (tuple, list)) or not all(isinstance(segment, Segment) for segment in segments):
        return f"segments = {segments!r} of route {v} must be a tuple of Segment"
    if len(route.waypoints):
        return f"route {v} has waypoints; where routes have segments, none may"
    if not 1 <= len(segments) <= MAX_SEGMENTS:
        return f"segments of route {v} has {len(segments)} entries; an entry needs 1 to {MAX_SEGMENTS} to its exit"
    if not is_finite(route.lane_width) or not WIDTH < route.lane_width <= 20.0:
        return f"lane_width = {route.lane_width!r} of route {v} must be more than a car's {WIDTH:.2f} m and at most 20"
    for k, segment in enumerate(segments):
        finite = is_finite(segment.length) and is_finite(segment.curvature)
        if not finite or not 0.0 < segment.length <= longest:
            return f"segment {k} of route {v} = {segment!r} must have a length in (0, {longest:g}] m, and be finite"
        bend = abs(segment.curvature)
        if bend and not (1 / LARGEST_RADIUS <= bend < min(1.0 / route.lane_width, math.tau / segment.length)):
            return (
                f"curvature = {segment.curvature!r} of segment {k} of route {v} must have a radius above the width of "
                f"the lane and of at most {LARGEST_RADIUS:g} m, and turn by less than a circle; a straight has 0"
            )
    return _joint_problem(v, route)


def _joint_problem(v: int, route: Route) -> str:
    joints = route.joints()
    if np.abs(np.array(joints)[:, :2]).max() > FARTHEST:
        return f"route {v} leaves [-{FARTHEST:g}, {FARTHEST:g}] m"
    if route.end is not None:
        if shape_of(route.end) != (3,):
            return f"end = {route.end!r} of route {v} must be (x, y, heading): finite numbers in m and rad"
        apart = math.dist(joints[-1][:2], route.end[:2])
        turned = abs(math.remainder(joints[-1][2] - route.end[2], math.tau))
        if apart > JOINT[0] or turned > JOINT[1]:
            return (
                f"segments of route {v} end {apart:.2f} m and {turned:.3f} rad from end = {tuple(route.end)}; "
                "they must join"
            )
    stretch = (0.0, 1.0) if route.priority is None else route.priority
    if shape_of(stretch) != (2,) or not 0.0 <= stretch[0] < min(stretch[1], route.length):
        return (
            f"priority = {route.priority!r} of route {v} must be (from, to) in m, with 0 <= from < to, and from "
            f"within its length of {route.length:g} m"
        )
    if route.start_span < 0.0 or entry_room(route) < 1:
        return (
            f"start_span = {route.start_span!r} of route {v} must be at least 0 and leave {LENGTH:.2f} m for a car on "
            f"its first segment of {route.segments[0].length:g} m"
        )
    return ""


def lanes_problem(routes: Sequence[Route]) -> str:
    """What is wrong with lanes together; "" if nothing is."""
    if len(routes) > MAX_ROUTES:
        return f"routes has {len(routes)} entries; of segments there must be at most {MAX_ROUTES}"
    numbers = entries(routes)
    if numbers != sorted(numbers):
        return "routes with the same start must follow each other"
    for v, (route, other) in enumerate(zip(routes[1:], routes, strict=False), 1):
        same = (route.segments[0], route.start_span) == (other.segments[0], other.start_span)
        if route.start == other.start and not same:
            return f"route {v} must have the first segment and the start_span of route {v - 1}, with which it starts"
    return ""
