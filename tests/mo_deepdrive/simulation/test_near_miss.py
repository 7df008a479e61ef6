"""Near misses: the time to collision of boxes, made by hand, and the objective in the scenarios with other cars."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mo_deepdrive.simulation.geometry import boxes_overlap, time_to_collision
from mo_deepdrive.simulation.state import CONFLICT_TIME, LENGTH, MAP_CENTRE, WIDTH

NORTH, WEST, SOUTH = (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0)  # cosine and sine of headings
LANE_X = MAP_CENTRE - 1.524
IDLE = (0.0, 0.0, -1.0)
COLUMN = 1


def meeting(place: tuple[float, float], velocity: tuple[float, float], other: Any, own: Any = NORTH) -> float:
    """Time until a box at ``place``, relative to one at the origin, reaches it with the relative ``velocity``."""
    return float(time_to_collision(*place, *velocity, *own, *other))


def test_boxes_that_touch_have_no_time_left() -> None:
    assert meeting((0.5, 0.5), (3.0, 3.0), WEST) == 0.0
    assert meeting((WIDTH, 0.0), (0.0, 0.0), NORTH) == 0.0
    assert meeting((WIDTH + 1e-9, 0.0), (0.0, 0.0), NORTH) == math.inf


def test_it_is_the_first_contact_of_two_moving_boxes() -> None:
    rng = np.random.default_rng(0)
    contacts = 0
    for _ in range(300):
        x, y = rng.uniform(-15.0, 15.0, 2)
        vx, vy = rng.uniform(-8.0, 8.0, 2)
        first, second = rng.uniform(-math.pi, math.pi, 2)
        turns = math.cos(first), math.sin(first), math.cos(second), math.sin(second)
        found = time_to_collision(x, y, vx, vy, *turns)
        times = np.arange(0.0, 6.0, 0.002)
        touch = [boxes_overlap(0.0, 0.0, *turns[:2], x + t * vx, y + t * vy, *turns[2:]) for t in times]
        if not any(touch):
            assert found > 5.9 or not touch[math.floor(found / 0.002)]
            continue
        contacts += 1
        assert found == pytest.approx(times[touch.index(True)], abs=0.0021)
    assert contacts > 50


# ----------------------------------------------------------------------------------------------------------- objective


def left_turn(make_vector: Any, **pins: Any) -> Any:
    env = make_vector(
        "left_turn",
        1,
        action_type="continuous",
        autoreset_mode="Disabled",
        objectives=["distance", "near_miss"],
        cost_sign="paper",
    )
    env.reset(options={"cars": 1, "desired_speeds": (10.0,), "headways": (3.0,), "yielding": (0.0,), **pins})
    return env


def test_an_agent_in_the_way_has_near_misses_from_one_and_a_half_seconds_before_the_collision(make_vector: Any) -> None:
    env = left_turn(make_vector)
    state = env.batch.state
    state["x"], state["y"], state["heading"] = LANE_X, MAP_CENTRE, math.pi / 2
    state["cos_heading"], state["sin_heading"] = 0.0, 1.0
    state["cos_before"], state["sin_before"] = 0.0, 1.0
    state["next_waypoint"], state["furthest"] = 2, -1000.0
    flags = []
    while not env.batch.over().all():
        env.batch.step(np.array([[IDLE]]))
        car = env.batch.state["cars"][0, 0, 0]
        gap = car["y"] - LENGTH / 2 - (MAP_CENTRE + WIDTH / 2)
        flags.append(float(env.batch.rewards[0, 0, COLUMN]))
        assert flags[-1] == float(gap < CONFLICT_TIME * car["speed"])
    assert env.batch.end_names(0) == ("collision",)
    assert sum(flags) == pytest.approx(15, abs=1)
    assert flags[-1] == 1.0


def test_a_car_that_passes_a_waiting_agent_is_no_near_miss(make_vector: Any) -> None:
    env = left_turn(make_vector, start=(MAP_CENTRE + 1.524, 18.0, 0.0))
    for _ in range(60):
        env.batch.step(np.array([[IDLE]]))
        assert env.batch.rewards[0, 0, COLUMN] == 0.0
    assert not env.batch.over().any()


def test_a_car_that_is_gone_or_was_never_there_is_none(make_vector: Any) -> None:
    env = make_vector("left_turn", 1, traffic="none", objectives=["near_miss"], autoreset_mode="Disabled")
    env.reset(seed=0)
    # Where absent cars are in the record.
    env.batch.state["x"], env.batch.state["y"], env.batch.state["furthest"] = LANE_X, 0.0, -1000.0
    env.batch.step(np.array([[3]]))
    assert env.batch.rewards[0, 0, 0] == 0.0


def test_both_vehicles_of_intersection_have_it(make_vector: Any) -> None:
    env = make_vector(
        "intersection",
        1,
        objectives=["near_miss"],
        action_type="continuous",
        autoreset_mode="Disabled",
        cost_sign="paper",
    )
    env.reset(options={"starts": ((LANE_X, 20.0, 0.0), (LANE_X, 40.0, math.pi))})
    env.batch.state["furthest"], env.batch.state["next_waypoint"][0, 0] = -1000.0, 2
    for speed, expected in ((4.0, 0.0), (5.5, 1.0)):
        env.batch.state["speed"] = speed
        env.batch.step(np.array([[IDLE, IDLE]]))
        first, second = env.batch.state[0]
        time = (second["y"] - first["y"] - LENGTH) / (first["vy"] - second["vy"])
        assert (time < CONFLICT_TIME) == bool(expected)
        assert env.batch.rewards[0, :, 0].tolist() == [expected, expected]
    while not env.batch.over().all():
        env.batch.step(np.array([[IDLE, IDLE]]))
    assert env.batch.end_names(0) == ("collision", "collision")
    assert env.batch.rewards[0, :, 0].tolist() == [1.0, 1.0]


def test_a_vehicle_that_has_left_the_road_is_none(make_vector: Any) -> None:
    env = make_vector("intersection", 1, objectives=["near_miss"], autoreset_mode="Disabled")
    env.reset(options={"starts": ((LANE_X, 20.0, 0.0), (LANE_X, 26.0, math.pi))})
    env.batch.state["speed"], env.batch.state["furthest"] = 3.0, -1000.0
    env.batch.state["end"][0, 1] = 8  # arrived
    env.batch.step(np.array([[0, 0]]))
    assert env.batch.rewards[0].ravel().tolist() == [0.0, 0.0]
