"""Scenarios that are registered from outside, above all two_bicycles of the documentation, through every API."""

from __future__ import annotations

import importlib
import math
from dataclasses import replace
from types import ModuleType
from typing import Any

import gymnasium
import mo_gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test

import mo_deepdrive
from mo_deepdrive import Route, Scenario, Segment, register_scenario
from mo_deepdrive.world.observation import layout
from mo_deepdrive.world.scenarios import SCENARIOS
from mo_deepdrive.wrappers import UtilityReward

ID = "mo-deepdrive-two-bicycles-v0"
FIRST, SECOND = ((15.0, 20.0), (15.0, 30.0)), ((25.0, 20.0), (25.0, 30.0))  # across the way, one behind the other
ASIDE = ((10.0, 45.0), (12.0, 45.0))
AHEAD = {"start": (7.0, 25.0, -math.pi / 2), "destination": (45.0, 25.0)}
ACCELERATE = 3


@pytest.fixture
def two_bicycles(examples: None) -> ModuleType:
    return importlib.import_module("two_bicycles")


def row(**changes: Any) -> Scenario:
    fields: dict[str, Any] = {
        "name": "own",
        "title": "Own",
        "routes": (Route(start=(7.0, 25.0, -1.5), waypoints=((20.0, 5.0),)),),
        "objectives": ("distance", "jerk"),
    }
    return Scenario(**{**fields, **changes})


def lane(**changes: Any) -> Route:
    """A straight lane of 40 m, with room for five vehicles."""
    fields: dict[str, Any] = {"start": (25.0, 0.0, 0.0), "segments": (Segment(40.0),)}
    return Route(**{**fields, **changes})


def angle(pose: Any, point: Any) -> float:
    """From the heading to the point, positive to the right; ``pose`` has the front and the heading."""
    x, y, heading = pose
    return math.remainder(math.atan2(-(point[0] - x), point[1] - y) - heading, math.tau) * -1


# ---------------------------------------------------------------------------------------------------------- the example


def test_importing_the_module_registers_the_id(examples: None) -> None:
    assert ID not in gymnasium.registry
    env = gymnasium.make(f"two_bicycles:{ID}")
    assert env.unwrapped.config.scenario == "two_bicycles"
    assert gymnasium.make_vec(ID, num_envs=2).observation_space.shape == (2, 23)
    assert mo_gymnasium.make(ID).unwrapped.reward_space.shape == (5,)


def test_every_bicycle_is_observed(two_bicycles: ModuleType, make_single: Any) -> None:
    env = make_single("two_bicycles")
    observation, _ = env.reset(seed=4)
    names = [entry.name for entry in layout(SCENARIOS["two_bicycles"])]
    assert names[15:] == [
        f"{bicycle}_{end}_{what}"
        for bicycle in ("obstacle", "obstacle_2")
        for what in ("distance", "angle")
        for end in "ab"
    ]
    for _ in range(10):
        car = env.batch.state[0, 0]
        pose = (car.front_x, car.front_y, car.heading)
        for k, end in enumerate(car.obstacle):
            at = 15 + 4 * (k // 2) + k % 2
            assert observation[at] == pytest.approx(math.dist(pose[:2], end), rel=1e-6)
            assert observation[at + 2] == pytest.approx(angle(pose, end), abs=1e-5)
        assert env.observation_space.contains(observation)
        observation, *_ = env.step(ACCELERATE)


def test_every_bicycle_is_drawn_by_itself_and_fair(two_bicycles: ModuleType, make_vector: Any, shapes: Any) -> None:
    env = make_vector("two_bicycles", 500)
    env.reset(seed=0)
    state = env.batch.state[:, 0]
    bicycles = state["obstacle"].reshape(500, 2, 2, 2)
    destinations = state["waypoints"][:, 0]
    assert destinations.min(axis=0) == pytest.approx([20.0, 5.0], abs=0.3)
    assert destinations.max(axis=0) == pytest.approx([45.0, 45.0], abs=0.3)
    start = np.array([7.0, 25.0])
    way = destinations - start
    length = np.hypot(*way.T)
    places = ((bicycles.mean(axis=2) - start[None, None]) * way[:, None]).sum(axis=-1) / length[:, None] - 4.601
    shares = places / (0.6 * length[:, None])
    sizes = np.hypot(*np.moveaxis(bicycles[:, :, 0] - bicycles[:, :, 1], -1, 0))
    for k in range(2):
        assert shares[:, k].min() == pytest.approx(0.0, abs=0.02)
        assert shares[:, k].max() == pytest.approx(1.0, abs=0.02)
        assert (sizes[:, k].min(), sizes[:, k].max()) == pytest.approx((1.15, 5.75), abs=0.05)
    assert abs(np.corrcoef(shares.T)[0, 1]) < 0.15
    box = shapes.box(*start, -math.pi / 2)
    for world in range(500):
        for bicycle in bicycles[world]:
            assert shapes.gap(box, bicycle) > 0.0
            assert shapes.gap(destinations[world][None], bicycle) > 0.5


@pytest.mark.parametrize(
    ("bicycles", "before"),
    [((FIRST, ASIDE), 15.0), ((ASIDE, FIRST), 15.0), ((ASIDE, SECOND), 25.0), ((ASIDE, ASIDE), None)],
)
def test_every_bicycle_can_be_hit(
    two_bicycles: ModuleType, make_single: Any, bicycles: Any, before: float | None
) -> None:
    env = make_single("two_bicycles")
    env.reset(seed=0, options={**AHEAD, "obstacles": bicycles})
    np.testing.assert_array_equal(env.batch.state[0, 0].obstacle.reshape(2, 2, 2), bicycles)
    done, info, reward = False, {}, None
    while not done:
        _, reward, terminated, truncated, info = env.step(ACCELERATE)
        done = terminated or truncated
    front = env.batch.state[0, 0].front_x
    if before is None:
        assert info["end"] == "arrived"
        assert reward[3] == 0.0
    else:
        assert info["end"] == "collision"
        assert reward[3] == -1.0
        assert before <= front < before + 1.5


def test_fixed_destination_and_obstacles_are_the_same_in_every_episode(
    two_bicycles: ModuleType, make_vector: Any
) -> None:
    env = make_vector("two_bicycles", 20, fixed_destination=True, fixed_obstacle=True)
    env.reset(seed=0)
    scenes = env.batch.state[:, 0][["waypoints", "obstacle"]]
    assert len(np.unique(scenes)) == 1
    first, second = scenes["obstacle"][0].reshape(2, 2, 2).mean(axis=1)
    assert np.hypot(*(first - second)) > 2.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"obstacle": FIRST}, "unknown reset option 'obstacle' in TwoBicycles; did you mean 'obstacles'"),
        ({"obstacles": FIRST}, r"reset option 'obstacles' = .* must be 2 times \(\(x, y\), \(x, y\)\)"),
        ({**AHEAD, "obstacles": (FIRST, ((45.0, 20.0), (45.0, 30.0)))}, "no valid scenario in 1000 draws"),
        ({**AHEAD, "obstacles": (((7.0, 20.0), (7.0, 30.0)), SECOND)}, "a bicycle touches the vehicle at its start"),
    ],
)
def test_reset_options_without_a_valid_scenario_are_refused(
    two_bicycles: ModuleType, make_single: Any, options: Any, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        make_single("two_bicycles").reset(seed=0, options=options)


def test_it_passes_gymnasiums_and_pettingzoos_checks(two_bicycles: ModuleType, make_single: Any) -> None:
    check_env(UtilityReward(make_single("two_bicycles"), "static_obstacle_linear"), skip_render_check=True)
    parallel_api_test(mo_deepdrive.parallel_env(scenario="two_bicycles"), num_cycles=30)


@pytest.mark.slow
def test_the_ramp_of_the_documentation_joins_a_lane_with_right_of_way(examples: None, make_vector: Any) -> None:
    importlib.import_module("merge")
    env = make_vector("merge", 1, time_limit=60.0)
    names = [entry.name for entry in layout(SCENARIOS["merge"])]
    # The vehicles stand; one car comes along the lane, and one along the ramp, which lets it pass.
    env.reset(seed=0, options={"routes": [0, 1, 0, 1], "distances": [6.0, 6.0, 30.0, 24.0], "accepted_gaps": [9, 9]})
    joint = 35.0 + 21.0
    first_there = None
    while env.batch.state[0, 0].cars["present"].any():
        observations = env.step(np.zeros((1, 2), dtype=np.int64))[0][0]
        lane_car, ramp_car = env.batch.state[0, 0].cars
        if first_there is None and (lane_car.route_distance > 60.0 or ramp_car.route_distance > joint):
            first_there = "lane" if lane_car.route_distance > 60.0 else "ramp"
    assert first_there == "lane"
    on_lane, on_ramp = (dict(zip(names, seen, strict=True)) for seen in observations)
    assert (on_lane["near_1_inside"], on_lane["near_1_right_of_way"]) == (0.0, 0.0)
    assert (on_ramp["near_1_inside"], on_ramp["near_1_right_of_way"], on_ramp["near_2_present"]) == (1.0, 1.0, 0.0)
    parallel_api_test(mo_deepdrive.parallel_env(scenario="merge", time_limit=3.0), num_cycles=40)


# --------------------------------------------------------------------------------------------------------- other rows


LANE = SCENARIOS["intersection"].routes


@pytest.mark.parametrize(
    ("changes", "size"),
    [
        ({"obstacles": 5}, 15 + 5 * 4),
        ({"obstacles": 1, "routes": (replace(row().routes[0], start_span=5.0),), "destination_span": (9.0, 9.0)}, 19),
        ({"routes": LANE[:1], "lanes": True, "objectives": ("distance", "lane_violation")}, 15),
        ({"routes": (*row().routes, Route((40.0, 25.0, 1.5), ((10.0, 40.0), (5.0, 45.0))))}, 29),
        ({"routes": LANE[:1], "lanes": True, "cars": 2, "obstacles": 1, "objectives": ("distance", "near_miss")}, 23),
    ],
    ids=["five bicycles", "random start and destination", "left turn alone", "two cars without lanes", "oncoming cars"],
)
@pytest.mark.slow
def test_other_rows_run_through_every_interface(
    registries: None, make_single: Any, make_vector: Any, changes: dict[str, Any], size: int
) -> None:
    scenario = row(**changes)
    register_scenario(scenario)
    single = make_single("own", render_mode="rgb_array")
    vector = make_vector("own", 3, autoreset_mode="SameStep")
    parallel = mo_deepdrive.parallel_env(scenario="own")
    vector.reset(seed=0)
    first, _ = single.reset(seed=0)
    assert first.shape == (size,) == parallel.reset(seed=0)[0]["vehicle_0"].shape
    assert single.observation_space.contains(first)
    np.testing.assert_array_equal(parallel.state()[:size], first)
    for _ in range(200):
        observations, rewards, *_ = vector.step(vector.action_space.sample())
        assert vector.observation_space.contains(observations)
        assert vector.reward_space.contains(rewards[0])
    vector.set_state(vector.get_state())
    assert single.render().shape == (720, 1056, 3)


@pytest.mark.parametrize(
    ("changes", "allowed", "refused"),
    [
        ({}, {}, {"fixed_destination": True}),
        ({"destination_span": (1.0, 0.0)}, {"fixed_destination": True}, {"fixed_obstacle": True}),
        ({"routes": LANE[:1], "lanes": True}, {"lane_margin": 0.5}, {"yield_to_oncoming": False}),
        ({"routes": LANE}, {"end_together": True}, {"end_on_lane_violation": True}),
        ({"routes": LANE[:1], "lanes": True, "cars": 1}, {"traffic": "dense"}, {"end_together": True}),
    ],
)
def test_a_setting_without_effect_in_the_scenario_is_refused(
    registries: None, changes: dict[str, Any], allowed: dict[str, Any], refused: dict[str, Any]
) -> None:
    register_scenario(row(**changes))
    mo_deepdrive.parallel_env(scenario="own", **allowed)
    with pytest.raises(ValueError, match=f"{next(iter(refused))} = .* has no effect in Own; omit it"):
        mo_deepdrive.parallel_env(scenario="own", **refused)


# -------------------------------------------------------------------------------------------------------- registration


def test_a_row_may_have_arrays_and_be_registered_twice(registries: None) -> None:
    for _ in range(2):
        route = Route(start=np.array([7, 25, -1.5]), waypoints=np.array([[20, 5]]))  # type: ignore[arg-type]
        register_scenario(row(routes=[route], destination_span=np.array([9, 9])))
    register_scenario(row(destination_span=(9.0, 9.0)))
    with pytest.raises(ValueError, match="registered already"):
        register_scenario(row())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "Two-Bicycles"}, "scenario name = 'Two-Bicycles' must be lower case letters"),
        ({"name": "one_waypoint"}, "scenario 'one_waypoint' is registered already, with other fields"),
        ({"routes": ()}, "scenario 'own': routes has 0 entries; it must have one per vehicle, at most 2"),
        ({"routes": (Route((7.0, 25.0, 0.0), ((1.0, 1.0),), 230.0),)}, "route 0 with its spans leaves [-250, 250] m"),
        ({"routes": (Route((7.0, 25.0), ((20.0, 5.0),)),)}, "start = (7.0, 25.0) of route 0 must be (x, y, heading)"),
        ({"routes": (Route((7.0, 25.0, 0.0), ()),)}, "waypoints of route 0 has 0 points; it must have 1 to 3"),
        ({"destination_span": 3.0}, "destination_span = 3.0 must be (x, y)"),
        ({"objectives": ("distance", "spending")}, "objective 'spending' is unknown; known: collision, destination"),
        ({"obstacles": 1, "routes": LANE, "lanes": True}, "obstacles = 1 must be 0 where there are two vehicles"),
        ({"obstacles": 1, "routes": (lane(),)}, "or roads of segments"),
        ({"lanes": True, "routes": (lane(),)}, "lanes and destination_span have no effect on roads of segments"),
        ({"routes": (lane(end=(25.0, 41.0, 0.0)),)}, "1.00 m and 0.000 rad from end = (25.0, 41.0, 0.0)"),
        ({"routes": (lane(), *row().routes)}, "route 1 has waypoints; where routes have segments, none may"),
        ({"routes": (lane(segments=(Segment(40.0, 0.4),)),)}, "must have a radius above the width of the lane"),
        ({"routes": (lane(start_span=36.0),)}, "start_span = 36.0 of route 0 must be at least 0 and leave 5.18 m"),
        ({"routes": (lane(priority=(9.0, 3.0)),)}, "priority = (9.0, 3.0) of route 0 must be (from, to) in m"),
        ({"number": 2}, "number = 2 has no effect without roads of segments; omit it"),
        ({"routes": (lane(lane_width=2.0),)}, "lane_width = 2.0 of route 0 must be more than a car's 2.30 m"),
        ({"routes": (lane(), lane(start_span=1.0))}, "route 1 must have the first segment and the start_span of"),
        (
            {"routes": (lane(),), "number": 3, "cars": 3},
            "vehicles = 3 and cars = 3 are more than Own holds: 5 together",
        ),
        ({"cars": 101, "lanes": True}, "cars = 101 must be a number of cars: 0, 1, ... or 100"),
        ({"cars": 2}, "cars = 2 must be 0 where there are two vehicles or no lanes"),
        ({"reference": {"jrk": 1.0}}, "objective 'jrk' is unknown; did you mean 'jerk'?"),
    ],
)
def test_an_invalid_scenario_is_refused_in_one_line(registries: None, changes: dict[str, Any], message: str) -> None:
    before = dict(SCENARIOS)
    with pytest.raises(ValueError, match=r"^[^\n]+$") as caught:
        register_scenario(row(**changes))
    assert message in str(caught.value)
    assert before == SCENARIOS
