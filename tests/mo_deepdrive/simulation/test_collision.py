"""Collisions: the compiled geometry against a slow reference, and no passing through at any speed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from mo_deepdrive.simulation import collision, geometry
from mo_deepdrive.simulation.dynamics import make_scratch

EDGE = 1e-9  # m; closer to contact, rounding decides
IDLE = 0


def reals(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_subnormal=False)


# --------------------------------------------------------------------------------------------------- plane geometry


def touches(box: tuple[float, float, float], segment: np.ndarray) -> bool:
    x, y, heading = box
    return bool(geometry.segment_touches_box(x, y, math.cos(heading), math.sin(heading), *segment.ravel()))


def overlap(first: tuple[float, float, float], second: tuple[float, float, float]) -> bool:
    poses = ((x, y, math.cos(h), math.sin(h)) for x, y, h in (first, second))
    return bool(geometry.boxes_overlap(*next(poses), *next(poses)))


poses = st.tuples(reals(-8, 8), reals(-8, 8), reals(-7, 7))
points = st.tuples(reals(-8, 8), reals(-8, 8))
ORIGIN = (0.0, 0.0, 0.0)


@settings(max_examples=300)
@given(pose=poses, a=points, b=points)
@example(pose=ORIGIN, a=(0.0, 0.0), b=(0.0, 0.0))
@example(pose=ORIGIN, a=(-0.5, 0.1), b=(0.5, 0.1))
@example(pose=ORIGIN, a=(-5.0, 0.0), b=(5.0, 0.0))
@example(pose=ORIGIN, a=(2.0, -5.0), b=(2.0, 5.0))
def test_a_segment_touches_a_box_if_no_axis_separates_them(
    shapes: Any, pose: tuple[float, float, float], a: tuple[float, float], b: tuple[float, float]
) -> None:
    segment = np.array([a, b])
    gap = shapes.gap(shapes.box(*pose), segment)
    assume(abs(gap) > EDGE)
    assert touches(pose, segment) == (gap < 0)
    assert touches(pose, segment[::-1]) == (gap < 0)


@settings(max_examples=300)
@given(first=poses, second=poses)
@example(first=ORIGIN, second=ORIGIN)
@example(first=ORIGIN, second=(1.0, 1.0, math.pi / 2))
@example(first=ORIGIN, second=(2.2, 0.0, 0.0))
@example(first=ORIGIN, second=(2.4, 0.0, 0.0))
def test_two_boxes_overlap_if_no_axis_separates_them(
    shapes: Any, first: tuple[float, float, float], second: tuple[float, float, float]
) -> None:
    gap = shapes.gap(shapes.box(*first), shapes.box(*second))
    assume(abs(gap) > EDGE)
    assert overlap(first, second) == (gap < 0)
    assert overlap(second, first) == (gap < 0)


# --------------------------------------------------------------------------------------------- a car and a bicycle

# Simulation and decision frequencies; at 10 Hz and 100 m/s a car moves by 10 m in a physics step.
FREQUENCIES = [(60, 10), (60, 1), (10, 10), (10, 5), (10, 1), (30, 5), (240, 10)]
DESTINATION_AWAY = 240.0


def set_motion(env: Any, speeds: list[float]) -> None:
    """Set the speed of the vehicles of a vector environment with one world, straight ahead, through its state."""
    saved = env.get_state()
    state = saved["state"].view(env.batch.state.dtype)
    for vehicle, speed in zip(state[0], speeds, strict=True):
        vehicle.speed = vehicle.previous_speed = speed
        vehicle.vx = -speed * math.sin(vehicle.heading)
        vehicle.vy = speed * math.cos(vehicle.heading)
    env.set_state(saved)
    assert [reading["speed"] for reading in env.telemetry()[0]] == speeds


def bicycle_env(make_vector: Any, frequencies: tuple[int, int]) -> Any:
    return make_vector(
        "static_obstacle",
        autoreset_mode="Disabled",
        harmful_g_force=None,
        simulation_frequency=frequencies[0],
        decision_frequency=frequencies[1],
    )


def pass_a_bicycle(env: Any, heading: float, speed: float, bicycle: np.ndarray) -> str:
    """Drive straight from the origin until the car is past the bicycle; how the episode ended ("" if it did not)."""
    direction = np.array([-math.sin(heading), math.cos(heading)])
    start = (0.0, 0.0, heading)
    env.reset(options={"start": start, "destination": DESTINATION_AWAY * direction, "obstacle": bicycle})
    set_motion(env, [speed])
    past = (bicycle @ direction).max() + 10.0
    while env.telemetry()[0][0]["travelled"] < past:
        _, _, terminated, truncated, infos = env.step(np.array([IDLE]))
        if terminated[0] or truncated[0]:
            return str(infos["end"][0])
    return ""


@pytest.mark.slow
@pytest.mark.parametrize("frequencies", FREQUENCIES)
def test_a_car_that_drives_straight_collides_exactly_if_the_bicycle_is_in_its_swath(
    make_vector: Any, shapes: Any, frequencies: tuple[int, int]
) -> None:
    env = bicycle_env(make_vector, frequencies)
    outcomes = {"collision": 0, "": 0}

    @settings(max_examples=150)
    @given(
        heading=reals(-math.pi, math.pi),
        speed=reals(20, 100),
        ahead=reals(3, 60),
        aside=reals(-3, 3),
        turn=reals(0, math.pi),
        length=st.sampled_from([0.0, 1e-3, 0.3, 1.137, 1.137]),
    )
    @example(heading=0.0, speed=100.0, ahead=15.0, aside=0.0, turn=0.0, length=1.137)
    @example(heading=0.0, speed=100.0, ahead=15.0, aside=1.1503, turn=math.pi / 2, length=0.0)
    @example(heading=0.0, speed=100.0, ahead=15.0, aside=1.1504, turn=math.pi / 2, length=0.0)
    def check(heading: float, speed: float, ahead: float, aside: float, turn: float, length: float) -> None:
        direction = np.array([-math.sin(heading), math.cos(heading)])
        right = np.array([math.cos(heading), math.sin(heading)])
        middle = ahead * direction + aside * right
        side = length / 2 * np.array([math.cos(turn), math.sin(turn)])
        bicycle = np.array([middle - side, middle + side])
        assume(shapes.gap(shapes.box(0.0, 0.0, heading), bicycle) > 0)
        # The swath: from the car's rear at the start to its front at the end.
        rear, half = -shapes.length / 2, shapes.width / 2
        corners = ((rear, -half), (rear, half), (90.0, half), (90.0, -half))
        swath = np.array([along * direction + across * right for along, across in corners])
        gap = shapes.gap(swath, bicycle)
        assume(abs(gap) > 1e-7)
        end = pass_a_bicycle(env, heading, speed, bicycle)
        assert end == ("collision" if gap < 0 else "")
        outcomes[end] += 1

    check()
    assert min(outcomes.values()) > 20


# ------------------------------------------------------------------------------------------------- two vehicles


def contact_interval(shapes: Any, starts: np.ndarray, speeds: np.ndarray) -> tuple[float, float]:
    """When the boxes of two vehicles that drive straight begin and cease to overlap (s, at constant speed; an empty
    interval for never): they do where no side of either separates them."""
    headings = starts[:, 2]
    directions = np.stack([-np.sin(headings), np.cos(headings)], axis=1)
    between = starts[1, :2] - starts[0, :2]
    relative = speeds[1] * directions[1] - speeds[0] * directions[0]
    enter, leave = -math.inf, math.inf
    corners = [shapes.box(0.0, 0.0, heading) for heading in headings]
    for heading in headings:
        for axis in ((math.cos(heading), math.sin(heading)), (-math.sin(heading), math.cos(heading))):
            reach = sum((box @ axis).max() for box in corners)
            place, rate = between @ axis, relative @ axis
            if abs(rate) < 1e-12:
                if abs(place) > reach:
                    return math.inf, -math.inf
                continue
            first, second = sorted(((-reach - place) / rate, (reach - place) / rate))
            enter, leave = max(enter, first), min(leave, second)
    return enter, leave


@pytest.mark.slow
@pytest.mark.parametrize("simulation_frequency", [60, 10])
def test_two_vehicles_that_cross_at_any_speed_do_not_pass_through_each_other(
    make_vector: Any, shapes: Any, simulation_frequency: int
) -> None:
    env = make_vector(
        "intersection",
        autoreset_mode="Disabled",
        harmful_g_force=None,
        simulation_frequency=simulation_frequency,
        decision_frequency=1,
    )
    # One decision of a second; friction slows both by the same ratio, so "time" runs at constant speed.
    steps = np.arange(simulation_frequency)
    last = float((0.999 ** (steps * 60 / simulation_frequency)).sum() / simulation_frequency)
    outcomes = {"met": 0, "clear": 0, "clipped": 0}

    @settings(max_examples=250)
    @given(
        headings=st.tuples(reals(-math.pi, math.pi), reals(-math.pi, math.pi)),
        speeds=st.tuples(reals(5, 100), reals(5, 100)),
        part=reals(0.05, 0.95),
        ahead=reals(-5, 5),
        aside=reals(-5, 5),
    )
    @example(headings=(0.0, math.pi / 2), speeds=(100.0, 100.0), part=0.5, ahead=0.0, aside=0.0)
    @example(headings=(0.0, math.pi), speeds=(100.0, 100.0), part=0.5, ahead=0.0, aside=0.0)
    @example(headings=(0.0, math.pi), speeds=(100.0, 100.0), part=0.5, ahead=0.0, aside=2.2)
    @example(headings=(0.0, math.pi), speeds=(100.0, 100.0), part=0.5, ahead=0.0, aside=2.4)
    def check(
        headings: tuple[float, float], speeds: tuple[float, float], part: float, ahead: float, aside: float
    ) -> None:
        # Both are near (30, 30) after the fraction ``part`` of the decision.
        when = part * last
        starts = np.zeros((2, 3))
        for v in range(2):
            direction = np.array([-math.sin(headings[v]), math.cos(headings[v])])
            starts[v, :2] = np.array([30.0, 30.0]) + v * np.array([aside, ahead]) - when * speeds[v] * direction
            starts[v, 2] = headings[v]
        enter, leave = contact_interval(shapes, starts, np.array(speeds))
        assume(enter > leave or enter > 1e-6 or leave < -1e-6)  # they do not touch at the start
        env.reset(options={"starts": starts})
        set_motion(env, list(speeds))
        _, _, terminated, _, _ = env.step(np.full((1, 2), IDLE))
        for v, reading in enumerate(env.telemetry()[0]):
            assert reading["travelled"] == pytest.approx(speeds[v] * last)
        ends = [str(end) for end in env.batch.end_names(0)]
        together = min(leave, last) - enter if enter > 0 else -1.0
        if together * max(speeds) > shapes.width / 4 + 1e-6:
            assert ends == ["collision", "collision"]
            assert terminated.all()
            outcomes["met"] += 1
        elif together < -1e-9:
            assert "collision" not in ends
            outcomes["clear"] += 1
        else:
            outcomes["clipped"] += 1  # corners, for less than the time between two tested poses

    check()
    assert outcomes["met"] > 60
    assert outcomes["clear"] > 20
    assert outcomes["clipped"] < 25


# ------------------------------------------------------------------------------------------ between two physics steps


LANE = 3


def path_of(*poses: tuple[float, float, float]) -> np.ndarray:
    """The path of a vehicle through poses (x, y, heading), as `drive` records it in LANE, after another vehicle's."""
    _, path = make_scratch(2, len(poses) - 1)
    for i, (x, y, heading) in enumerate(poses):
        for name, value in (("x", x), ("y", y), ("cos", math.cos(heading)), ("sin", math.sin(heading))):
            path[name][:, i, :] = np.nan
            path[name][1, i, LANE] = value
    return path


@pytest.mark.parametrize("part", [0.25, 0.5, 0.75])
def test_a_pose_between_two_steps_divides_the_way_and_the_turn(part: float) -> None:
    path = path_of((9.0, 9.0, 9.0), (1.0, 2.0, 0.4), (3.0, -2.0, 1.4))
    x, y, cos, sin = collision.pose(path, 1, 2, LANE, part)
    assert (x, y) == pytest.approx((1.0 + 2.0 * part, 2.0 - 4.0 * part))
    chord = [(1 - part) * wave(0.4) + part * wave(1.4) for wave in (math.cos, math.sin)]
    assert (cos, sin) == pytest.approx(tuple(np.array(chord) / math.hypot(*chord)))
    assert collision.pose(path, 1, 2, LANE, 1.0) == (3.0, -2.0, math.cos(1.4), math.sin(1.4))


def test_half_way_through_half_a_turn_the_pose_has_the_heading_of_the_end() -> None:
    path = path_of((0.0, 0.0, 0.0), (2.0, 4.0, math.pi))
    path["sin"][1, 1, LANE] = 0.0  # math.sin(math.pi) is not zero
    assert collision.pose(path, 1, 1, LANE, 0.5) == (1.0, 2.0, -1.0, 0.0)


def test_no_corner_moves_farther_than_the_bound(shapes: Any) -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        first, second, other = ((*rng.uniform(-3.0, 3.0, 2), rng.uniform(-4.0, 4.0)) for _ in range(3))
        bound = collision.sweep(path_of(other, first, second, other), 1, 2, LANE)
        moved = np.linalg.norm(shapes.box(*second) - shapes.box(*first), axis=1).max()
        assert moved <= bound + EDGE
        ways = math.dist(first[:2], second[:2]), 2 * abs(math.sin((second[2] - first[2]) / 2))
        assert bound == pytest.approx(ways[0] + ways[1] * math.hypot(shapes.width, shapes.length) / 2)
