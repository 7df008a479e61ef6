"""Roads of segments: progress, offset, heading and lane distances are those of the lines, on segments and at joints."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mo_deepdrive.simulation import road_traffic, roads
from mo_deepdrive.simulation.state import CAR, NEVER, VEHICLE
from mo_deepdrive.world.config import EnvConfig
from mo_deepdrive.world.params import make_params
from mo_deepdrive.world.routes import Segment
from mo_deepdrive.world.scenarios import SCENARIOS

PARAMS = make_params(EnvConfig(scenario="roundabout"))[0]
ROUTES = SCENARIOS["roundabout"].routes
HALF_LENGTH, HALF_WIDTH = 5.17652 / 2, 2.300675555555556 / 2


def line(route: int, distance: float) -> tuple[complex, float]:
    """The point (x + iy) and the heading of a route, by integrating its curvature exactly, segment by segment."""
    x, y, heading = ROUTES[route].start
    point = complex(x, y)
    for k, segment in enumerate(ROUTES[route].segments):
        last = k == len(ROUTES[route].segments) - 1
        length = distance if last else min(distance, segment.length)
        ahead = 1j * np.exp(1j * heading)
        if segment.curvature:
            point += ahead * (np.exp(1j * segment.curvature * length) - 1.0) / (1j * segment.curvature)
            heading += segment.curvature * length
        else:
            point += ahead * length
        distance -= length
        if distance <= 0.0:
            break
    return point, heading


def vehicle_at(route: int, distance: float, left: float = 0.0, turned: float = 0.0) -> Any:
    """A vehicle whose front is ``left`` m to the left of its line, turned to the left of it by ``turned``."""
    point, heading = line(route, distance)
    front = point - left * np.exp(1j * heading)
    heading += turned
    centre = front - 1j * np.exp(1j * heading) * HALF_LENGTH
    vehicle = np.zeros(1, dtype=VEHICLE)[0]
    vehicle.x, vehicle.y, vehicle.heading = centre.real, centre.imag, heading
    vehicle.cos_heading, vehicle.sin_heading = math.cos(heading), math.sin(heading)
    vehicle.route, vehicle.entered = route, NEVER
    vehicle.segment = np.searchsorted(joints(route)[:-1], distance - 1.0)  # where it was a moment ago
    return vehicle


def joints(route: int) -> list[float]:
    return np.cumsum([segment.length for segment in ROUTES[route].segments]).tolist()


def distances(route: int) -> list[float]:
    """Places along a route: in every segment, and at, just before and just after every joint."""
    ends = joints(route)
    middle = np.linspace(1.0, ends[-1] - 1.0, 23).tolist()
    return [*middle, *(end + step for end in ends[:-1] for step in (-1e-6, 0.0, 1e-6))]


@pytest.mark.parametrize("route", range(3))
def test_progress_offset_and_heading_are_exact_on_straights_arcs_and_joints(route: int) -> None:
    for distance in distances(route):
        for left, turned in ((0.0, 0.0), (1.5, 0.3), (-2.2, -1.2)):
            placed = vehicle_at(route, distance, left, turned)
            arrived = roads.follow(placed, PARAMS)
            assert not arrived
            assert placed.route_distance == pytest.approx(distance, abs=1e-9)
            assert placed.lane_offset == pytest.approx(left, abs=1e-9)
            assert placed.heading_error == pytest.approx(turned, abs=1e-9)
            for waypoint, ahead in zip(placed.waypoints, (roads.NEXT_POINT, roads.POINT_AFTER), strict=False):
                assert complex(*waypoint) == pytest.approx(line(route, distance + ahead)[0], abs=1e-9)
    assert roads.follow(vehicle_at(route, ROUTES[route].length + 1e-6), PARAMS)


def test_progress_goes_back_across_joints() -> None:
    for joint, end in enumerate(joints(1)[:-1]):
        vehicle = vehicle_at(1, end - 0.5)
        vehicle.segment = joint + 1
        roads.follow(vehicle, PARAMS)
        assert (vehicle.segment, vehicle.route_distance) == (joint, pytest.approx(end - 0.5))


@pytest.mark.parametrize("route", range(3))
def test_lane_distances_are_those_of_the_box(route: int) -> None:
    """Compared with the offsets of points along the sides, each from the nearest of many points of the line."""
    grid = np.linspace(-2.0, ROUTES[route].length + 8.0, 30_001)
    traced = [line(route, each) for each in grid]
    points, headings = np.array([point for point, _ in traced]), np.array([heading for _, heading in traced])
    along = np.linspace(-HALF_LENGTH, HALF_LENGTH, 101)
    for distance in np.linspace(6.0, ROUTES[route].length - 0.5, 40):
        for left, turned in ((0.0, 0.0), (0.9, 0.2), (-1.3, -0.5)):
            vehicle = vehicle_at(route, distance, left, turned)
            roads.follow(vehicle, PARAMS)
            roads.find_lane(vehicle, PARAMS)
            ahead = 1j * np.exp(1j * vehicle.heading)
            centre = complex(vehicle.x, vehicle.y)
            sides = np.concatenate([centre + ahead * (along + 1j * side * HALF_WIDTH) for side in (-1, 1)])
            near = np.abs(grid - distance) < 10.0
            nearest = np.abs(sides[:, None] - points[near]).argmin(axis=1)
            lefts = -((sides - points[near][nearest]) * np.exp(-1j * headings[near][nearest])).real
            assert vehicle.left_lane_distance == pytest.approx(2.25 - lefts.max(), abs=2e-4)
            assert vehicle.right_lane_distance == pytest.approx(2.25 + lefts.min(), abs=2e-4)


@pytest.mark.parametrize("route", range(3))
def test_a_driver_sees_whoever_is_ahead_beyond_the_joints_of_its_segments(route: int) -> None:
    car = np.zeros(1, dtype=CAR)[0]
    car.route = route
    seen = 0
    for joint in joints(route)[:-1]:
        for behind, beyond in ((0.1, 0.1), (1.0, 7.0), (4.0, 0.0), (15.0, 15.0)):
            car.route_distance = joint - behind
            ahead = joint + beyond
            if car.route_distance > 0.0 and ahead < ROUTES[route].length:
                point, _ = line(route, ahead)
                gap = road_traffic.gap_on_route(PARAMS, car, point.real, point.imag, 1.5)
                assert gap == pytest.approx(ahead - car.route_distance - 1.5, abs=1e-9)
                back, _ = line(route, joint - behind - 0.5)
                assert road_traffic.gap_on_route(PARAMS, car, back.real, back.imag, 1.5) > 1e6
                seen += 1
    assert seen >= 4


def test_a_segment_ends_where_its_curvature_leads() -> None:
    assert Segment(3.0).end((1.0, 2.0, math.pi / 2)) == pytest.approx((-2.0, 2.0, math.pi / 2))
    quarter = Segment(math.pi, 0.5)  # to the left around (-2, 0)
    assert quarter.end((0.0, 0.0, 0.0)) == pytest.approx((-2.0, 2.0, math.pi / 2))
    assert Segment(math.pi, -0.5).end((0.0, 0.0, 0.0)) == pytest.approx((2.0, 2.0, -math.pi / 2))


def test_routes_join_where_their_lines_meet() -> None:
    """A right turn from arm 0 joins those who come from arm 3 and go on, at the end of its bend."""
    bend, angle = ROUTES[0].segments[1].length, ROUTES[0].segments[1].length / 12.0
    assert PARAMS.joins[0, 0] == pytest.approx(44.0 + bend)
    quarter = 12.75 * math.pi / 2
    assert PARAMS.joins[0, 10] == pytest.approx(44.0 + bend + quarter)  # from arm 3 straight on
    assert PARAMS.joins[0, 8] == pytest.approx(44.0 + bend + 2 * quarter)  # from arm 2 to the left
    assert np.isnan(PARAMS.joins[0, [3, 4, 5, 6, 7, 9]]).all()  # they leave before, or enter behind
    assert angle < math.pi / 2
