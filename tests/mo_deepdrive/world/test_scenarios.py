"""The scenarios and their rules: spawns, lanes, objectives, action sets, observations and how an episode ends."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mo_deepdrive.simulation.state import ENDS
from mo_deepdrive.world.observation import layout
from mo_deepdrive.world.scenarios import SCENARIOS

# Sections 1 and 4 of the specification, independently.
SCALE = 405 / 5.17652 / 4  # pixels per metre
C = (900 / 2 + 50) / SCALE
LANE = 3.048
HALF_LENGTH, HALF_WIDTH = 5.17652 / 2, 2.300675555555556 / 2
START = ((900 * 0.1 + 50) / SCALE, (900 * 0.5 + 50) / SCALE, -math.pi / 2)
LEFT_TURN = ((C + 1.524, C - 3.048), (C - 3.048, C + 1.524), (1.840549443086846, C + 1.524))
STRAIGHT = ((C - 1.524, 4.139197872452702),)
LEFT_X = 27.0770290995851
MAX_ACCELERATION = 3.625

OPEN = ("one_waypoint", "static_obstacle")
EXACT = {"rtol": 1e-12, "atol": 1e-12}
SINGLE = {"rtol": 2e-7, "atol": 2e-6}  # float32


def map_point(p: Any) -> np.ndarray:
    """Metres of a normalised map coordinate."""
    return (900 * np.asarray(p) + 50) / SCALE


def generator(seed: int) -> np.random.Generator:
    """The generator with which Gymnasium seeds an environment."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))


def named(env: Any, observation: np.ndarray) -> dict[str, float]:
    """An observation as a dict by entry."""
    names = [entry.name for entry in layout(SCENARIOS[env.config.scenario])]
    return dict(zip(names, (float(value) for value in observation), strict=True))


def front(x: float, y: float, heading: float) -> np.ndarray:
    return np.array([x - math.sin(heading) * HALF_LENGTH, y + math.cos(heading) * HALF_LENGTH])


def corners(x: float, y: float, heading: float) -> np.ndarray:
    """Front left, front right, back right, back left."""
    ahead = np.array([-math.sin(heading), math.cos(heading)]) * HALF_LENGTH
    right = np.array([math.cos(heading), math.sin(heading)]) * HALF_WIDTH
    return np.array([x, y]) + np.array([ahead - right, ahead + right, right - ahead, -ahead - right])


def angle_to(x: float, y: float, heading: float, point: Any) -> float:
    """Angle at the front from the heading to the point, positive to the right."""
    dx, dy = np.asarray(point) - front(x, y, heading)
    turn = (heading + math.pi / 2) - math.atan2(dy, dx)
    return math.atan2(math.sin(turn), math.cos(turn))


def distance_to(x: float, y: float, heading: float, point: Any) -> float:
    return float(np.hypot(*(np.asarray(point) - front(x, y, heading))))


def set_vehicle(env: Any, vehicle: int = 0, **fields: Any) -> None:
    """Change the state of the first world of a vector environment."""
    saved = env.get_state()
    car = saved["state"].view(env.batch.state.dtype)[0, vehicle]
    for name, value in fields.items():
        car[name] = value
    if "heading" in fields:
        # It drove straight.
        car.cos_heading = car.cos_before = math.cos(car.heading)
        car.sin_heading = car.sin_before = math.sin(car.heading)
    env.set_state(saved)


# --------------------------------------------------------------------------------------------------------- spawning


def test_the_destination_of_an_open_scenario_follows_its_two_draws(make_single: Any) -> None:
    env = make_single()
    for seed in range(100):
        u = generator(seed).random(5)
        observation, _ = env.reset(seed=seed)
        goal = map_point([0.1 + 0.5 * u[0] + 0.1, 0.5 + (2 * u[1] - 1) * 0.5])
        np.testing.assert_allclose(env.batch.state[0, 0].waypoints[0], goal, **EXACT)
        seen = named(env, observation)
        np.testing.assert_allclose(seen["next_distance"], distance_to(*START, goal), **SINGLE)
        np.testing.assert_allclose(seen["next_angle"], angle_to(*START, goal), **SINGLE)
        car = env.telemetry()[0]
        np.testing.assert_allclose([car["x"], car["y"], car["heading"]], START, **EXACT)
        assert {car[name] for name in ("speed", "yaw_rate", "steer", "throttle", "brake", "g_force", "jerk")} == {0.0}


def test_the_starts_at_the_intersection_follow_their_draws(make_vector: Any) -> None:
    env = make_vector("intersection")
    for seed in range(100):
        u = generator(seed).random(5)
        env.reset(seed=seed)
        poses = [[car["x"], car["y"], car["heading"]] for car in env.telemetry()[0]]
        expected = [[LEFT_X, 6 + 12 * u[0], 0.0], [C - 1.524, 33 + 14 * u[1], math.pi]]
        np.testing.assert_allclose(poses, expected, **EXACT)
        state = env.batch.state[0]
        np.testing.assert_allclose(state[0].waypoints, LEFT_TURN, **EXACT)
        np.testing.assert_allclose(state[1].waypoints[:1], STRAIGHT, **EXACT)


@pytest.mark.parametrize("scenario", OPEN)
def test_a_fixed_destination_is_the_same_in_every_episode(make_single: Any, scenario: str) -> None:
    env = make_single(scenario, fixed_destination=True)
    goal = map_point([0.1 + 0.5 * 0.2 + 0.1, 0.5 + (2 * 0.2 - 1) * 0.5])
    bicycles = set()
    for seed in range(20):
        env.reset(seed=seed)
        np.testing.assert_allclose(env.batch.state[0, 0].waypoints[0], goal, **EXACT)
        bicycles.add(env.batch.state[0, 0].obstacle.tobytes())
    if scenario == "static_obstacle":
        assert len(bicycles) == 20


def test_a_fixed_bicycle_is_the_same_in_every_episode(make_single: Any) -> None:
    env = make_single("static_obstacle", fixed_destination=True, fixed_obstacle=True)
    cars = set()
    for seed in range(20):
        env.reset(seed=seed)
        cars.add(env.batch.state[0, 0].tobytes())
    assert len(cars) == 1
    car = env.batch.state[0, 0]
    route = np.array([0.2, -0.3])
    middle = np.array([0.1, 0.5]) + (0.6 * 0.4 + 0.1 / np.hypot(*route)) * route
    side = (0.025 + 0.1 * 0.5) / 2 * np.array([math.cos(math.pi * 0.2), math.sin(math.pi * 0.2)])
    np.testing.assert_allclose(car.obstacle, map_point([middle + side, middle - side]), **EXACT)


def test_reset_options_replace_draws_and_the_rest_is_drawn_as_before(make_single: Any) -> None:
    env = make_single("static_obstacle")
    free = make_single("static_obstacle")
    free.reset(seed=5)
    drawn = free.batch.state[0, 0]
    bicycle = np.array([[20.0, 30.0], [21.0, 31.0]])
    env.reset(seed=5, options={"obstacle": bicycle})
    car = env.batch.state[0, 0]
    np.testing.assert_array_equal(car.obstacle, bicycle)
    np.testing.assert_array_equal(car.waypoints, drawn.waypoints)
    env.reset(seed=5, options={"destination": (40.0, 41.0)})
    np.testing.assert_array_equal(env.batch.state[0, 0].waypoints[0], [40.0, 41.0])
    observation, _ = env.reset(
        seed=5, options={"start": (-3.0, 2.0, 0.5), "destination": [4, 41], "obstacle": bicycle.tolist()}
    )
    reading = env.telemetry()[0]
    assert (reading["x"], reading["y"], reading["heading"]) == (-3.0, 2.0, 0.5)
    np.testing.assert_allclose(named(env, observation)["next_distance"], distance_to(-3.0, 2.0, 0.5, (4, 41)), **SINGLE)
    # A reset option holds for one episode.
    env.reset(seed=5)
    assert env.batch.state[0, 0].tobytes() == drawn.tobytes()


# ------------------------------------------------------------------------------------------------ how episodes end


def run(env: Any, policy: Any, most: int = 700) -> tuple[tuple[str, ...], np.ndarray, int]:
    """Step a vector environment with one world until the episode is over: ends, return, decisions."""
    observations = env.batch.observations.copy()
    total = 0.0
    for decision in range(1, most):
        actions = [policy(v, observations[0, v]) for v in range(env.vehicles)]
        array = np.array(actions if env.vehicles > 1 else actions[0])[None]
        _, rewards, terminated, truncated, _ = env.step(array)
        observations = env.batch.observations.copy()
        total = total + rewards[0].astype(np.float64)
        if (terminated | truncated)[0].all():
            return env.batch.end_names(0), total, decision
    raise AssertionError("the episode does not end")


def control(steer: float = 0.0, accelerate: float = 0.0, brake: float = -1.0) -> np.ndarray:
    return np.array([steer, accelerate, brake], dtype=np.float32)


@pytest.fixture
def world(make_vector: Any) -> Any:
    """Make a vector environment with one world and continuous actions, without autoreset."""

    def make(scenario: str = "one_waypoint", **options: Any) -> Any:
        return make_vector(scenario, 1, **{"action_type": "continuous", "autoreset_mode": "Disabled", **options})

    return make


def test_driving_past_a_waypoint_skips_it(world: Any) -> None:
    env = world("intersection")
    # It turns left before its first waypoint and gets closer to the second one.
    env.reset(options={"starts": ((26.2, 21.0, math.radians(30)), (C - 1.524, 47.0, math.pi))})
    nearest = []
    while env.batch.end_names(0)[0] == "":
        env.step(np.stack([control(0.0, 0.5), control()])[None])
        car = env.telemetry()[0][0]
        here = front(car["x"], car["y"], car["heading"])
        nearest.append(int(np.argmin(np.linalg.norm(np.array(LEFT_TURN) - here, axis=1))))
    assert env.batch.end_names(0) == ("skipped_waypoint", "")
    assert env.batch.state[0, 0].next_waypoint == 0
    assert nearest[-1] == 1
    assert set(nearest[:-1]) == {0}


def test_a_vehicle_that_faces_away_falls_behind_from_a_furthest_of_zero(world: Any) -> None:
    env = world()
    env.reset(options={"start": (0.0, 0.0, math.pi), "destination": (0.0, 50.0)})
    assert env.telemetry()[0][0]["route_distance"] == pytest.approx(-HALF_LENGTH)
    assert run(env, lambda *_: control())[0::2] == (("backwards",), 1)
    env.reset(options={"start": (0.0, 0.0, math.radians(135)), "destination": (0.0, 50.0)})
    assert -2.0 < env.telemetry()[0][0]["route_distance"] < -1.5
    assert run(env, lambda *_: control())[0::2] == (("time_limit",), 600)


def test_of_simultaneous_ends_the_first_in_the_list_counts(world: Any) -> None:
    # One decision that collides, arrives, exceeds g-force and jerk and is the last one before the time limit.
    bicycle = ((8.7, -1.0), (8.7, 1.0))
    pins = {"start": (0.0, 0.0, -math.pi / 2), "destination": (10.0, 0.0), "obstacle": bicycle}
    common: dict[str, Any] = {"time_limit": 0.1, "harmful_jerk": 1.0, "harmful_g_force": 0.01}

    def end(scenario: str, **options: Any) -> tuple[str, np.ndarray]:
        env = world(scenario, **{**common, **options})
        env.reset(options={name: pins[name] for name in pins if name != "obstacle" or scenario == "static_obstacle"})
        set_vehicle(env, x=6.0, speed=10.0, vx=8.0)
        ends, total, decisions = run(env, lambda *_: control(0.0, 1.0))
        assert decisions == 1
        return ends[0], total

    quiet = {"harmful_jerk": None, "harmful_g_force": None}
    assert end("static_obstacle")[0] == "collision"
    assert end("static_obstacle", **quiet)[0] == "collision"
    assert end("one_waypoint")[0] == "harmful_g_force"
    assert end("one_waypoint", harmful_g_force=None)[0] == "harmful_jerk"
    name, total = end("one_waypoint", **quiet)
    assert name == "arrived"
    assert total[1] == 1.0
    # Only an arrival earns the destination reward.
    assert end("one_waypoint")[1][1] == 0.0


# -------------------------------------------------------------------------------------------------- what does not pay


def distance_return(env: Any, seed: int, policy: Any) -> float:
    env.reset(seed=seed)
    return float(run(env, policy)[1][env.objectives.index("distance")])


@pytest.mark.slow
@pytest.mark.parametrize("scenario", OPEN)
def test_spinning_reversing_and_parking_earn_nothing(world: Any, chase: Any, scenario: str) -> None:
    env = world(scenario)
    spins = (control(1.0, 0.1), control(-1.0, 0.1), control(1.0, -0.1), control(0.3, 0.2), control(-1.0, 0.03))
    for seed in range(15):
        driving = distance_return(env, seed, lambda _, observation: chase(observation))
        assert driving > 1.0
        assert distance_return(env, seed, lambda *_: control()) == 0.0
        assert distance_return(env, seed, lambda *_: control(0.0, 0.0, 1.0)) == 0.0
        assert distance_return(env, seed, lambda *_: control(0.0, -0.3)) < 0.0
        assert distance_return(env, seed, lambda *_: control(0.0, -1.0)) < 0.0
        for spin in spins:
            assert distance_return(env, seed, lambda _, __, spin=spin: spin) < 0.5 * driving


@settings(max_examples=40)
@given(seed=st.integers(0, 2**31), wobble=st.floats(0, 1))
def test_the_distance_return_is_the_gained_route_whatever_the_path(make_single: Any, seed: int, wobble: float) -> None:
    env = make_single(action_type="continuous", harmful_g_force=None)
    env.reset(seed=seed)
    before = env.telemetry()[0]["route_distance"]
    rng = np.random.default_rng(seed)
    action, total, info = control(), 0.0, {}
    while not info:
        if rng.random() < 0.2:
            action = rng.uniform(-1, 1, 3).astype(np.float32) * (1.0, wobble, 1.0) + (0.0, 1.0 - wobble, 0.0)
        _, reward, _, _, info = env.step(action)
        total += float(reward[0])
    assert total == pytest.approx(env.telemetry()[0]["route_distance"] - before, rel=1e-5, abs=1e-4)


# --------------------------------------------------------------------------------------------------- lanes and yield


@pytest.mark.parametrize("margin", [0.0, 0.5, 2.0])
def test_lane_violation_is_the_distance_within_the_margin_of_both_lines(make_vector: Any, margin: float) -> None:
    env = make_vector("intersection", 16, action_type="continuous", lane_margin=margin, cost_sign="paper")
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    at = env.objectives.index("lane_violation")
    positive = zero = 0
    for _ in range(150):
        actions = rng.uniform([-0.2, 0.0, -1.0], [0.2, 1.0, -1.0], (16, 2, 3)).astype(np.float32)
        _, rewards, _, _, infos = env.step(actions)
        cars = env.telemetry()
        for world in range(16):
            for v in range(2):
                if infos["acted"][world, v]:
                    left, right = cars[world][v]["left_lane_distance"], cars[world][v]["right_lane_distance"]
                    expected = max(0.0, margin - left) + max(0.0, margin - right)
                    assert rewards[world, v, at] == pytest.approx(expected, rel=1e-6, abs=1e-6)
                    positive += expected > 0
                    zero += expected == 0
    assert positive > 100
    assert zero > 100 or margin > 0.3736  # a car in the middle of its lane is 0.3737 m from both lines


def enter_the_crossing(env: Any, starts: Any, speed: float = 2.0) -> None:
    """The left turn drives to its second waypoint at ``speed`` (m/s)."""
    env.reset(options={"starts": starts})
    set_vehicle(env, 0, next_waypoint=1)
    env.step(np.stack([control(), control()])[None])
    heading = env.telemetry()[0][0]["heading"]
    set_vehicle(env, 0, speed=speed, vx=-speed * math.sin(heading), vy=speed * math.cos(heading))


def test_progress_of_the_left_turn_is_negative_while_the_other_approaches(world: Any) -> None:
    starts = ((25.5, 24.0, math.radians(45)), (C - 1.524, 45.0, math.pi))
    gains = {}
    for rule in (True, False):
        env = world("intersection", yield_to_oncoming=rule)
        enter_the_crossing(env, starts)
        _, rewards, _, _, _ = env.step(np.stack([control(), control()])[None])
        assert env.batch.state[0, 0].crossing
        assert env.batch.state[0, 1].approaching
        gains[rule] = rewards[0, :, env.objectives.index("distance")]
    assert gains[False][0] > 0.05
    assert gains[True][0] == -gains[False][0]
    assert gains[True][1] == gains[False][1]
    # Once the other has left the road or entered the crossing, progress is positive.
    env = world("intersection")
    enter_the_crossing(env, starts)
    set_vehicle(env, 1, end=ENDS.index("backwards"))
    assert env.batch.state[0, 1].approaching
    _, rewards, _, _, _ = env.step(np.stack([control(), control()])[None])
    assert rewards[0, 0, 0] == gains[False][0]
    env = world("intersection")
    enter_the_crossing(env, (starts[0], (C - 1.524, 12.0, math.pi)))
    _, rewards, _, _, _ = env.step(np.stack([control(), control()])[None])
    assert rewards[0, 0, 0] == gains[False][0]


@pytest.mark.parametrize("speed", [2.0, -2.0])
def test_backing_out_of_the_crossing_is_no_gain_while_the_other_approaches(world: Any, speed: float) -> None:
    """The rule turns progress negative; it does not turn a loss into a gain."""
    gains = {}
    for rule in (True, False):
        env = world("intersection", yield_to_oncoming=rule)
        enter_the_crossing(env, ((25.5, 24.0, math.radians(45)), (C - 1.524, 45.0, math.pi)), speed)
        _, rewards, _, _, _ = env.step(np.stack([control(), control()])[None])
        assert env.batch.state[0, 0].crossing
        assert env.batch.state[0, 1].approaching
        gains[rule] = float(rewards[0, 0, env.objectives.index("distance")])
    assert math.copysign(1.0, gains[False]) == math.copysign(1.0, speed)
    assert gains[True] == -abs(gains[False]) < -0.05


# ----------------------------------------------------------------------------------------------------------- actions

SMALL, MICRO = 0.0174533, 0.00174533


def test_continuous_actions_are_scaled_and_clipped(world: Any) -> None:
    env = world()
    for action in ([0.5, -0.25, 0.0], [-1.0, 1.0, 1.0], [3.0, -7.0, -9.0], [0.0, 0.0, -1.0], [1e30, -1e30, 1e30]):
        env.reset(seed=0)
        env.step(np.array([action], dtype=np.float32))
        steer, accelerate, brake = np.clip(np.array(action, dtype=np.float32).astype(np.float64), -1, 1)
        car = env.telemetry()[0][0]
        assert car["steer"] == pytest.approx(steer * math.pi / 6, rel=1e-12)
        assert car["throttle"] == pytest.approx(accelerate * MAX_ACCELERATION, rel=1e-12)
        assert car["brake"] == pytest.approx(MAX_ACCELERATION * (1 + brake) / 2, rel=1e-12)


# ------------------------------------------------------------------------------------------------------ observations


def expected_observation(env: Any, world: int, v: int) -> list[float]:
    """The observation by section 7, from telemetry and the scenario."""
    car = env.telemetry()[world][v]
    pose = (car["x"], car["y"], car["heading"])
    state = env.batch.state[world, v]
    points = state.waypoints[: state.n_waypoints]
    k = int(state.next_waypoint)
    after = points[k + 1] if k + 1 < len(points) else None
    away = distance_to(*pose, points[k])
    expected = [angle_to(*pose, points[k]), angle_to(*pose, points[k] if after is None else after)]
    expected += [away, away + (0.0 if after is None else distance_to(*pose, after))]
    expected += [car[name] for name in ("vx", "vy", "ax", "ay", "steer", "throttle", "brake", "speed")]
    expected += [car["left_lane_distance"], car["right_lane_distance"]]
    turns_left, nose = env.config.scenario in ("intersection", "left_turn") and v == 0, front(*pose)
    expected.append(float(turns_left and nose[1] >= LEFT_TURN[0][1] and nose[0] >= LEFT_TURN[1][0]))
    if env.config.scenario == "static_obstacle":
        expected += [distance_to(*pose, end) for end in state.obstacle]
        expected += [angle_to(*pose, end) for end in state.obstacle]
    if env.config.scenario == "intersection":
        other = env.telemetry()[world][1 - v]
        expected += [other["vx"] - car["vx"], other["vy"] - car["vy"]]
        expected += [other[name] for name in ("vx", "vy", "ax", "ay")]
        for corner in corners(other["x"], other["y"], other["heading"]):
            expected += [angle_to(*pose, corner), distance_to(*pose, corner)]
    if env.config.scenario == "left_turn":
        numbers = [number for number in range(1, 6) if car[f"car_{number}_present"]]
        ways = {number: car[f"car_{number}_y"] - HALF_LENGTH - (C + LANE) for number in numbers}
        # From the northern edge of the crossing; a car has passed when its rear is beyond the southern one.
        seen = [number for number in numbers if -(2 * LANE + 2 * HALF_LENGTH) <= ways[number] <= 100.0][:2]
        for number in seen:
            expected += [ways[number], car[f"car_{number}_speed"]]
        expected += [100.0, 0.0] * (2 - len(seen))
    return expected


@pytest.mark.slow
@pytest.mark.parametrize("scenario", [name for name, scenario in SCENARIOS.items() if not scenario.roads])
def test_an_observation_is_that_of_the_specification(make_vector: Any, chase: Any, scenario: str) -> None:
    env = make_vector(scenario, 6, action_type="continuous")
    observations, _ = env.reset(seed=0)
    rng = np.random.default_rng(0)
    noise = np.zeros(env.action_space.shape)
    compared = 0
    for step in range(120):
        if step % 6 == 0:
            noise = rng.normal(0.0, (0.15, 0.3, 0.1), env.action_space.shape)
        rows = observations.reshape(-1, observations.shape[-1])
        actions = np.array([chase(row) for row in rows]).reshape(env.action_space.shape)
        observations = env.step((actions + noise).astype(np.float32))[0]
        running = env.batch.state["end"] == 0
        for world in np.flatnonzero(running.all(axis=1)):
            for v in range(env.vehicles):
                seen = observations[world] if env.vehicles == 1 else observations[world, v]
                np.testing.assert_allclose(seen, expected_observation(env, world, v), rtol=1e-6, atol=1e-5)
                compared += 1
    assert compared > 300


def test_a_vehicle_that_has_left_the_road_is_observed_far_away_and_at_rest(world: Any) -> None:
    env = world("intersection")
    env.reset(seed=0)
    while env.batch.end_names(0) != ("", "backwards"):
        observations = env.step(np.stack([control(0.0, 0.05), control(0.0, -0.5)])[None])[0]
    seen = named(env, observations[0, 0])
    others = {name: value for name, value in seen.items() if name.startswith("other_")}
    assert len(others) == 14
    assert {value for name, value in others.items() if name.endswith("_distance")} == {100.0}
    assert {value for name, value in others.items() if not name.endswith("_distance")} == {0.0}
    assert seen["speed"] > 0.0
