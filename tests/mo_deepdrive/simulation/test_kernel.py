"""Limits are exact: how episodes end, on the limit and a rounding error beyond it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mo_deepdrive.simulation.kernel import ending, lane_excess
from mo_deepdrive.simulation.state import CIRCLING_LIMIT, ENDS, VEHICLE
from mo_deepdrive.world.config import EnvConfig
from mo_deepdrive.world.params import make_params

# The field that reaches its limit, the limit, the direction beyond it, and the end.
LIMITS: dict[str, tuple[str, float, float, str]] = {
    "g-force": ("g_force", 1.5, math.inf, "harmful_g_force"),
    "jerk": ("jerk", 80.0, math.inf, "harmful_jerk"),
    "left lane line": ("left_lane_distance", -0.25, -math.inf, "off_lane"),
    "right lane line": ("right_lane_distance", -0.25, -math.inf, "off_lane"),
    "turned left": ("heading", CIRCLING_LIMIT, math.inf, "circling"),
    "turned right": ("heading", -CIRCLING_LIMIT, -math.inf, "circling"),
    "fallen behind": ("route_distance", 5.0, -math.inf, "backwards"),
}


def make(**fields: Any) -> tuple[Any, Any]:
    """A vehicle in the middle of its lane, and the parameters of an intersection with every limit."""
    params = make_params(
        EnvConfig(
            scenario="intersection",
            harmful_g_force=1.5,
            harmful_jerk=80.0,
            end_on_lane_violation=True,
            time_limit=3.0,
            lane_margin=0.5,
        )
    )[0]
    vehicle = np.zeros(1, dtype=VEHICLE)[0]
    defaults = {"furthest": 7.0, "route_distance": 7.0, "n_waypoints": 1, "decisions": 29}
    for name, value in {"left_lane_distance": 0.4, "right_lane_distance": 0.4, **defaults, **fields}.items():
        vehicle[name] = value
    return vehicle, params


def end_of(vehicle: Any, params: Any, *, collided: bool = False, arrived: bool = False) -> str:
    return ENDS[ending(vehicle, collided, arrived, params)]


@pytest.mark.parametrize("what", LIMITS)
def test_a_vehicle_ends_beyond_a_limit_and_not_on_it(what: str) -> None:
    field, limit, beyond, end = LIMITS[what]
    assert end_of(*make(**{field: limit})) == ""
    assert end_of(*make(**{field: np.nextafter(limit, beyond)})) == end


def test_the_last_decision_is_on_the_time_limit() -> None:
    assert [end_of(*make(decisions=decisions)) for decisions in (29, 30, 31)] == ["", "time_limit", "time_limit"]


def test_circling_is_measured_from_the_starting_heading() -> None:
    assert end_of(*make(heading=3.0 + CIRCLING_LIMIT, start_heading=3.0 + 1e-9)) == ""
    assert end_of(*make(heading=1.0, start_heading=1.5 + CIRCLING_LIMIT)) == "circling"


def test_the_distance_outside_the_lane_counts_from_the_margin_on_each_side() -> None:
    for left, right, excess in ((0.4, 0.7, 0.1), (0.7, 0.4, 0.1), (0.2, 0.1, 0.7), (0.5, 0.5, 0.0), (-1.0, 2.0, 1.5)):
        vehicle, params = make(left_lane_distance=left, right_lane_distance=right)
        assert lane_excess(vehicle, params) == pytest.approx(excess)
