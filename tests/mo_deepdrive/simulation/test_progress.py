"""Waypoints and lanes at their exact boundaries."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mo_deepdrive.simulation.geometry import HALF_LENGTH, HALF_WIDTH
from mo_deepdrive.simulation.progress import find_lane, follow, skipped
from mo_deepdrive.simulation.state import LANE_WIDTH, VEHICLE
from mo_deepdrive.world.config import EnvConfig
from mo_deepdrive.world.params import make_params

PARAMS = make_params(EnvConfig(scenario="intersection"))[0]


def at(front: tuple[float, float], heading: float = 0.0, *waypoints: tuple[float, float], following: int = 0) -> Any:
    """A vehicle with its front at a point of a coordinate axis, which is exact for the heading 0."""
    vehicle = np.zeros(1, dtype=VEHICLE)[0]
    vehicle.sin_heading, vehicle.cos_heading = math.sin(heading), math.cos(heading)
    vehicle.x = front[0] + vehicle.sin_heading * HALF_LENGTH
    vehicle.y = front[1] - vehicle.cos_heading * HALF_LENGTH
    vehicle.front_x, vehicle.front_y = front
    vehicle.n_waypoints = len(waypoints)
    vehicle.next_waypoint = following
    for k, point in enumerate(waypoints):
        vehicle.waypoints[k] = point
        vehicle.along[k] = 10.0 * (k + 1)
    return vehicle


JUST_INSIDE = float(np.nextafter(1.0, 0.0))


def test_a_destination_is_reached_within_a_metre_and_not_at_a_metre() -> None:
    for away, arrived in ((1.0, False), (JUST_INSIDE, True), (0.0, True)):
        vehicle = at((0.0, 0.0), 0.0, (0.0, away))
        assert follow(vehicle) is arrived
        assert (vehicle.next_waypoint, vehicle.next_distance) == (0, away)
        assert vehicle.route_distance == 10.0 - away


def test_a_waypoint_is_passed_within_a_metre_and_not_at_a_metre() -> None:
    for away, passed in ((1.0, False), (JUST_INSIDE, True)):
        vehicle = at((0.0, 0.0), 0.0, (0.0, away), (0.0, 7.0))
        assert follow(vehicle) is False, "it is not the destination"
        assert (vehicle.next_waypoint, vehicle.next_distance) == ((1, 7.0) if passed else (0, 1.0))
        assert vehicle.route_distance == (20.0 - 7.0 if passed else 10.0 - 1.0)


def test_one_waypoint_is_passed_at_a_time() -> None:
    vehicle = at((0.0, 0.0), 0.0, (0.0, 0.5), (0.0, -0.5), (0.0, 0.25))
    assert [follow(vehicle), follow(vehicle), follow(vehicle)] == [False, False, True]


@pytest.mark.parametrize(
    ("points", "following", "beyond"),
    [
        (((1.0, 0.0), (-1.0, 0.0)), 0, False),  # as near to the next as to the one after
        (((1.0, 0.0), (-JUST_INSIDE, 0.0)), 0, True),
        (((1.0, 0.0), (-JUST_INSIDE, 0.0)), 1, False),
        (((1.0, 0.0), (3.0, 0.0), (0.5, 0.0)), 0, True),
        (((1.0, 0.0), (3.0, 0.0), (0.5, 0.0)), 1, True),
        (((1.0, 0.0), (3.0, 0.0), (0.5, 0.0)), 2, False),
        (((0.5, 0.0), (3.0, 0.0), (1.0, 0.0)), 1, False),  # back at one that it has passed
        (((2.0, 0.0), (1.0, 0.0), (1.0, 0.0)), 1, False),
    ],
)
def test_a_waypoint_is_skipped_if_a_later_one_is_nearer_than_all_others(
    points: tuple[tuple[float, float], ...], following: int, beyond: bool
) -> None:
    assert skipped(at((0.0, 0.0), 0.0, *points, following=following)) is beyond


def test_a_vehicle_approaches_while_all_of_it_is_before_the_crossing() -> None:
    line = float(PARAMS.map_centre) + LANE_WIDTH
    seen = set()
    for y in line + HALF_LENGTH + np.spacing(line + HALF_LENGTH) * np.arange(-3, 4):
        vehicle = at((0.0, y + HALF_LENGTH), 0.0, (0.0, 0.0))
        vehicle.y = y
        find_lane(vehicle, PARAMS)
        assert vehicle.approaching == (y - HALF_LENGTH > line)
        seen.add(np.sign(y - HALF_LENGTH - line))
    assert seen == {-1, 0, 1}


def test_the_left_turn_crosses_from_its_first_waypoint_to_beyond_its_second() -> None:
    first, second = (4.0, 0.0), (-6.0, 5.0)
    before = at((0.0, -1e-9), 0.0, first, second, (-20.0, 5.0))
    find_lane(before, PARAMS)
    # Between the lines of a lane around x = 0.
    assert before.left_lane_distance == pytest.approx(LANE_WIDTH / 2 - HALF_WIDTH)
    assert before.right_lane_distance == pytest.approx(LANE_WIDTH / 2 - HALF_WIDTH)
    assert not before.crossing
    at_the_first = at((0.0, 0.0), 0.0, first, second, (-20.0, 5.0))
    find_lane(at_the_first, PARAMS)
    assert at_the_first.crossing
    assert at_the_first.left_lane_distance == at_the_first.right_lane_distance == LANE_WIDTH / 2
    on_exit = at((-6.0, 5.0), math.pi / 2, first, second, (-20.0, 5.0))
    find_lane(on_exit, PARAMS)
    assert on_exit.crossing, "its front is on the line"
    on_exit.front_x = float(np.nextafter(-6.0, -math.inf))
    find_lane(on_exit, PARAMS)
    assert not on_exit.crossing
    assert on_exit.left_lane_distance == pytest.approx(LANE_WIDTH / 2 - HALF_WIDTH)
    assert on_exit.right_lane_distance == pytest.approx(LANE_WIDTH / 2 - HALF_WIDTH)
