"""Oncoming cars: the Intelligent Driver Model, their start, their reaction to a left-turner, and what an agent sees."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mo_deepdrive.simulation.state import ENDS, LANE_WIDTH, LENGTH, WIDTH
from tests.mo_deepdrive.world.test_scenarios import generator

CARS = 5
CENTRE = (900 / 2 + 50) / (405 / 5.17652 / 4)
LANE_X = CENTRE - 1.524
ENTRY, EXIT = CENTRE + 3.048, CENTRE - 3.048
GRAVITY = 9.807
IDLE = (0.0, 0.0, -1.0)
WAITING = (CENTRE + 1.524, 12.0, 0.0)  # in its lane, before the crossing
IN_THE_WAY = (LANE_X, CENTRE, math.pi / 2)  # across the oncoming lane
PINNED = {"cars": 1, "desired_speeds": (10.0,), "headways": (3.0,), "yielding": (4.0,)}


@pytest.fixture
def worlds(make_vector: Any) -> Any:
    """Make worlds of LeftTurn with continuous actions, without autoreset, in which nothing else ends an episode."""

    def make(num_envs: int = 1, **options: Any) -> Any:
        usual = {"action_type": "continuous", "autoreset_mode": "Disabled", "harmful_g_force": None}
        return make_vector("left_turn", num_envs, **{**usual, **options})

    return make


def idle(env: Any, decisions: int) -> None:
    """Let the agents stand, also in worlds whose episode is over."""
    for _ in range(decisions):
        env.batch.step(np.tile(IDLE, (env.num_envs, 1, 1)))


def put(env: Any, x: float, y: float, heading: float, worlds: Any = slice(None), **fields: float) -> None:
    """Move the agents of some worlds without a reset; they head for their last waypoint, so that they miss none."""
    turn = {"cos": math.cos(heading), "sin": math.sin(heading)}
    pose = {"x": x, "y": y, "heading": heading, "start_heading": heading}
    pose |= {f"{name}_{when}": value for name, value in turn.items() for when in ("heading", "before")}
    for name, value in {**pose, "next_waypoint": 2, "furthest": -1000.0, **fields}.items():
        env.batch.state[name][worlds, 0] = value


def cars_of(env: Any, world: int = 0) -> np.ndarray:
    """The oncoming cars of a world, (cars,) of CAR."""
    cars: np.ndarray = env.batch.state["cars"][world, 0]
    return cars


def idm(v: float, v0: float, headway: float, gap: float, dv: float) -> float:
    """The Intelligent Driver Model, with the parameters of the documentation."""
    desired = 2.0 + max(0.0, v * min(headway, 1.0) + v * dv / (2 * math.sqrt(1.0 * 1.5)))
    return 1.0 - (v / v0) ** 4 - (desired / max(gap, 0.1)) ** 2


# ------------------------------------------------------------------------------------------------------------- start


def expected_start(uniforms: np.ndarray, mean: float) -> list[tuple[float, ...]]:
    """Position, speed, desired speed, headway and yielding of the cars, from the draws of the episode."""
    rows: list[tuple[float, ...]] = []
    rear, ahead = ENTRY, math.inf
    for first, second, third in uniforms[5:].reshape(CARS, 3):
        desired, headway = 7.0 + 5.0 * first, min(0.8 - (mean - 0.8) * math.log(1.0 - second), 60.0)
        speed = min(desired, ahead + 1.5 * headway)
        y = rear + headway * speed + (2.0 if rows else 0.0) + LENGTH / 2
        rows.append((y, speed, desired, headway, 0.5 + 5.5 * third))
        rear, ahead = y + LENGTH / 2, speed
    return rows


@pytest.mark.parametrize(("flow", "mean"), [("light", 9.0), ("default", 4.5), ("dense", 2.5)])
def test_the_cars_follow_their_draws(make_single: Any, flow: str, mean: float) -> None:
    env = make_single("left_turn", traffic=flow)
    for seed in range(50):
        env.reset(seed=seed)
        uniforms = generator(seed).random(5 + 3 * CARS)
        assert env.batch.state["y"][0, 0] == pytest.approx(6.0 + 12.0 * uniforms[0])
        cars = cars_of(env)
        found = [cars["y"], cars["speed"], *(cars["driver"][name] for name in ("desired_speed", "headway", "yielding"))]
        np.testing.assert_allclose(np.transpose(found), expected_start(uniforms, mean), rtol=1e-12)
        assert cars["present"].all()
        assert (cars["x"] == LANE_X).all()
        assert not cars["acceleration"].any()


def test_the_flow_scales_the_headways_and_none_has_no_cars(worlds: Any) -> None:
    means = []
    for flow in ("dense", "default", "light"):
        env = worlds(2000, traffic=flow)
        env.reset(seed=0)
        headways = env.batch.state["cars"]["driver"]["headway"]
        assert headways.min() >= 0.8
        means.append(headways.mean())
        gaps = headways[:, 0, 1:]
        if flow == "default":  # gaps of every size
            assert [round(float((gaps > size).mean()), 1) for size in (2, 4, 6, 8)] == [0.7, 0.4, 0.2, 0.1]
    np.testing.assert_allclose(means, [2.5, 4.5, 9.0], rtol=0.05)
    env = worlds(4, traffic="none")
    env.reset(seed=0)
    idle(env, 20)
    assert not env.batch.state["cars"]["present"].any()
    assert (env.batch.observations[:, 0, -4:] == [100.0, 0.0, 100.0, 0.0]).all()


def test_without_traffic_the_agent_drives_as_vehicle_0_of_intersection(worlds: Any, make_vector: Any) -> None:
    env = worlds(traffic="none", objectives=["distance", "g_force", "jerk", "lane_violation"])
    pair = make_vector("intersection", 1, action_type="continuous", autoreset_mode="Disabled", harmful_g_force=None)
    start = (27.0, 9.0, 0.0)
    env.reset(options={"start": start})
    pair.reset(options={"starts": (start, (LANE_X, 47.0, math.pi))})
    rng = np.random.default_rng(0)
    while not env.batch.state["crossing"][0, 0]:
        action = [rng.uniform(-0.003, 0.003) if env.batch.state["y"][0, 0] < 18.5 else 0.03, 0.4, -1.0]
        observations, rewards, *_ = env.step(np.array([action]))
        others, columns, *_ = pair.step(np.array([[action, IDLE]]))
        np.testing.assert_array_equal(observations[0, :15], others[0, 0, :15])
        np.testing.assert_array_equal(rewards[0, 1:], columns[0, 0, [2, 4, 5]])


# ------------------------------------------------------------------------------------------------------------- motion


def simulate(env: Any, before: Any) -> np.ndarray:
    """A plain loop over one decision: y, speed and acceleration of the cars, (cars, 3), beside an agent that stands.

    Args:
        env: the environment.
        before: the vehicle, of VEHICLE, before the decision.
    """
    dt, friction = 1.0 / env.config.simulation_frequency, 0.999 ** (60.0 / env.config.simulation_frequency)
    half_x = LENGTH / 2 * abs(before.sin_heading) + WIDTH / 2 * abs(before.cos_heading)
    half_y = LENGTH / 2 * abs(before.cos_heading) + WIDTH / 2 * abs(before.sin_heading)
    present = [bool(car["present"]) and car["y"] > -LENGTH / 2 for car in before.cars]
    rows = [[car["y"], car["speed"], car["acceleration"]] for car in before.cars]
    rows = [row if there else [row[0], 0.0, 0.0] for row, there in zip(rows, present, strict=True)]
    for _ in range(env.config.physics_steps):
        after = [list(row) for row in rows]
        for k, (y, v, _) in enumerate(rows):
            if present[k]:
                v0, headway, most, _ = before.cars[k]["driver"].tolist()
                led = k > 0 and present[k - 1]
                change = (
                    idm(v, v0, headway, y - rows[k - 1][0] - LENGTH, v - rows[k - 1][1]) if led else 1 - (v / v0) ** 4
                )
                if abs(before.x - LANE_X) < half_x + LANE_WIDTH / 2 and before.y < y:
                    change = min(change, max(idm(v, v0, headway, y - LENGTH / 2 - (before.y + half_y), v), -most))
                speed = min(max(v + dt * change, v - dt * GRAVITY, 0.0), (v + dt * 3.625) * friction)
                after[k] = [y - dt * v, speed, (speed - v) / dt]
        rows = after
    return np.array(rows)


@pytest.mark.slow
@pytest.mark.parametrize(("frequency", "decisions", "moves"), [(60, 10, 0.0), (60, 60, 1.0), (10, 10, 1.0)])
def test_the_cars_move_as_a_plain_loop_says(worlds: Any, frequency: int, decisions: int, moves: float) -> None:
    env = worlds(20, traffic="dense", simulation_frequency=frequency, decision_frequency=decisions)
    env.reset(seed=3)
    for world in range(10):  # in the way of the cars, and somewhere near
        put(env, LANE_X + 0.7 * world, CENTRE - 2.0, math.pi / 2 - 0.2 * world, world)
    rng, braking, left = np.random.default_rng(0), 0.0, False
    for _ in range(12 * decisions):
        before = env.batch.state.copy().view(np.recarray)
        env.batch.step(np.stack([rng.normal(0.0, 0.02, 20), moves * rng.random(20), -np.ones(20)], axis=1)[:, None])
        for world in np.flatnonzero(env.batch.state["end"][:, 0] == 0)[:: decisions // 10]:
            cars = cars_of(env, world)
            found = np.stack([cars["y"], cars["speed"], cars["acceleration"]], axis=1)
            np.testing.assert_allclose(found, simulate(env, before[world, 0]), rtol=1e-9, atol=1e-9)
            braking = min(braking, found[:, 2].min())
            left = left or not cars["present"].all()
    assert braking < -3.0
    assert left or moves


def test_a_car_that_has_left_the_map_is_gone(worlds: Any) -> None:
    env = worlds()
    env.reset(options={"start": WAITING, "cars": 2, "desired_speeds": (12.0, 7.0), "headways": (0.0, 4.0)})
    while cars_of(env)[0]["present"]:
        y = float(cars_of(env)[0]["y"])
        assert y > -LENGTH / 2 - 12.0 * 0.1
        idle(env, 1)
    assert y - 12.0 * 0.1 <= -LENGTH / 2
    gone = cars_of(env)[0].copy()
    idle(env, 30)
    assert cars_of(env)[0] == gone
    assert cars_of(env)["present"].tolist() == [False, True, False, False, False]
    assert (gone["speed"], gone["acceleration"]) == (0.0, 0.0)
    assert cars_of(env)[1]["speed"] == pytest.approx(7.0, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("flow", ["default", "dense"])
def test_no_car_runs_into_the_one_ahead_in_ten_thousand_episodes(worlds: Any, flow: str) -> None:
    rng, ends, stopped = np.random.default_rng(0), np.zeros(len(ENDS), dtype=int), 0
    for part, pose in enumerate((None, IN_THE_WAY, (LANE_X, 12.0, math.pi), None)):
        env = worlds(1250, traffic=flow, time_limit=30.0)
        env.reset(seed=10_000 * part)
        if pose:
            put(env, *pose)
        least = math.inf
        for decision in range(300):
            if decision % 10 == 0:
                actions = (
                    rng.choice([-0.1, 0.0, 0.1, 1.0], (1250, 1, 3)) if part % 2 == 0 else np.tile(IDLE, (1250, 1, 1))
                )
            env.batch.step(actions)
            cars = env.batch.state["cars"][:, 0]
            both = cars["present"][:, 1:] & cars["present"][:, :-1]
            gaps = (cars["y"][:, 1:] - cars["y"][:, :-1] - LENGTH)[both]
            least = min(least, gaps.min(initial=math.inf))
            stopped += int((cars["speed"] < 0.1).any(axis=1)[cars["present"].any(axis=1)].sum())
            assert (cars["speed"] >= 0.0).all()
            if decision == 250:
                env.set_state(env.get_state())
        assert least > 1.0
        ends += np.bincount(env.batch.state["end"][:, 0], minlength=len(ENDS))
    assert ends[ENDS.index("collision")] > 500
    assert stopped > 500


# ------------------------------------------------------------------------------------------------ meeting the agent


def meet(worlds: Any, most: float, headway: float = 3.0) -> tuple[str, float]:
    """How an episode of 8 s ends for an agent that stands in the way of one car, and the car's least speed."""
    env = worlds(time_limit=8.0)
    env.reset(options={**PINNED, "yielding": (most,), "headways": (headway,)})
    put(env, *IN_THE_WAY)
    least = math.inf
    while not env.batch.over().all():
        idle(env, 1)
        least = min(least, float(cars_of(env)[0]["speed"]))
    return env.batch.end_names(0)[0], least


def test_a_driver_who_makes_way_stops_and_one_who_hardly_brakes_collides(worlds: Any) -> None:
    assert meet(worlds, 6.0) == ("time_limit", pytest.approx(0.0, abs=0.2))
    end, least = meet(worlds, 0.5)
    assert end == "collision"
    assert least > 8.0
    # The later the car comes, the less hard it must brake.
    assert meet(worlds, 1.5, headway=2.0)[0] == "collision"
    assert meet(worlds, 2.5, headway=4.0)[0] == "time_limit"


def test_a_collision_ends_the_episode_and_the_world_stands_still(worlds: Any) -> None:
    env = worlds()
    env.reset(options={**PINNED, "yielding": (0.5,)})
    put(env, *IN_THE_WAY)
    rewards = np.zeros(7)
    while not env.batch.over().all():
        idle(env, 1)
        rewards += env.batch.rewards[0, 0]
    assert env.batch.end_names(0) == ("collision",)
    assert rewards[env.objectives.index("collision")] == -1.0
    # The first decision in which the boxes meet: the car was in front of the agent's box one decision before.
    assert -10.0 * 0.1 < cars_of(env)[0]["y"] - LENGTH / 2 - (CENTRE + WIDTH / 2) <= 0.0
    before = env.batch.state.copy()
    idle(env, 50)
    for name in ("x", "y", "cars", "end", "decisions"):
        assert env.batch.state[name].tobytes() == before[name].tobytes()


def test_every_car_is_solid(worlds: Any) -> None:
    for number in range(CARS):
        env = worlds()
        env.reset(options={"start": WAITING, "headways": (1.0,) * CARS, "desired_speeds": (8.0,) * CARS})
        y = -0.8 + float(cars_of(env)[number]["y"])
        for beside, end in ((0.001, ""), (-0.001, "collision")):
            env.reset(options={"start": WAITING, "headways": (1.0,) * CARS, "desired_speeds": (8.0,) * CARS})
            put(env, LANE_X + WIDTH + beside, y, 0.0)
            idle(env, 1)
            assert env.batch.end_names(0) == (end,)


@pytest.mark.parametrize(
    ("distance", "yields", "sign"), [(22.0, True, -1), (24.5, True, 1), (22.0, False, 1), (0.5, True, 1)]
)
def test_progress_is_negative_while_a_car_on_the_map_approaches(
    worlds: Any, distance: float, yields: bool, sign: int
) -> None:
    env = worlds(objectives=["distance"], yield_to_oncoming=yields)
    env.reset(options={**PINNED, "headways": (distance / 10.0,)})
    put(env, CENTRE + 1.0, CENTRE - 2.0, 0.4, next_waypoint=1, speed=1.0)
    env.batch.step(np.array([[[0.0, 0.5, -1.0]]]))
    assert env.batch.state["crossing"][0, 0]
    assert math.copysign(1.0, env.batch.rewards[0, 0, 0]) == sign


# --------------------------------------------------------------------------------------------------------- observation


def test_nothing_hidden_is_observed(worlds: Any) -> None:
    env = worlds(2)
    env.reset(seed=[5, 5], options={"start": WAITING})
    cars = env.batch.state["cars"]
    cars["driver"]["yielding"][0] = 0.5
    cars["driver"]["desired_speed"][0] *= 1.1
    cars["driver"]["headway"][0] *= 0.9
    idle(env, 1)
    saved = env.get_state()
    states = saved["state"].view(env.batch.state.dtype)
    for name in ("x", "y", "speed", "acceleration", "present"):
        states["cars"][name][0] = states["cars"][name][1]
    env.set_state(saved)
    assert env.batch.observations[0].tobytes() == env.batch.observations[1].tobytes()


# ------------------------------------------------------------------------------------------------------- reset options


def test_reset_options_pin_every_drawn_number_and_the_rest_is_drawn_as_before(make_single: Any) -> None:
    env, free = make_single("left_turn"), make_single("left_turn")
    free.reset(seed=5)
    drawn = free.batch.state["cars"][0, 0]["driver"]
    for option, name, values in (
        ("desired_speeds", "desired_speed", (9.0, 8.0, 7.5, 11.0, 10.0)),
        ("headways", "headway", (0.0, 60.0)),
        ("yielding", "yielding", (9.8,)),
    ):
        env.reset(seed=5, options={option: values})
        found = cars_of(env)["driver"]
        assert found[name][: len(values)].tolist() == list(values)
        np.testing.assert_array_equal(found[name][len(values) :], drawn[name][len(values) :])
        for other in {"desired_speed", "headway", "yielding"} - {name}:
            np.testing.assert_array_equal(found[other], drawn[other])
    env.reset(seed=5, options={"cars": 2})
    assert cars_of(env)["present"].tolist() == [True, True, False, False, False]
    # An option holds for one episode.
    env.reset(seed=5)
    assert env.batch.state.tobytes() == free.batch.state.tobytes()
    none = make_single("left_turn", traffic="none")
    none.reset(seed=5, options={"cars": 1, "headways": [3.0], "desired_speeds": [10.0]})
    assert cars_of(none)["y"][0] == pytest.approx(ENTRY + 30.0 + LENGTH / 2)


BAD_OPTIONS: dict[str, tuple[dict[str, Any], str]] = {
    **{
        f"cars = {cars}": ({"cars": cars}, f"'cars' = {cars} must be a number of oncoming cars from 0 to 5")
        for cars in (6, -1, 1.5, True)
    },
    "a negative headway": ({"headways": (2.0, -1.0)}, "'headways' = (2.0, -1.0) must have numbers in [0, 60] s"),
    "a headway that is not a number": ({"headways": (math.nan,)}, "'headways' = (nan,) must have numbers in [0, 60] s"),
    "one headway": ({"headways": 2.0}, "'headways' = 2.0 must have one number per car, at most 5"),
    "more headways than cars": ({"headways": (2.0,) * 3, "cars": 2}, "must have one number per car, at most 2"),
    "a car that stands": ({"desired_speeds": (0.0,)}, "'desired_speeds' = (0.0,) must have numbers in [1, 25] m/s"),
    "brakes that push": ({"yielding": (-0.5,)}, "'yielding' = (-0.5,) must have numbers in [0, 9.807] m/s^2"),
    "an unknown option": ({"headway": (2.0,)}, "unknown reset option 'headway' in LeftTurn; did you mean 'headways'"),
    "a start inside a car": (
        {"start": (LANE_X, ENTRY + 20.0, 0.0), "headways": (2.0,), "desired_speeds": (10.0,)},
        "no valid scenario in 1000 draws with these reset options: an oncoming car touches the vehicle at its start",
    ),
}


@pytest.mark.parametrize("what", BAD_OPTIONS)
def test_options_that_make_no_scenario_are_refused_by_name_and_nothing_changes(
    make_single: Any, worlds: Any, what: str
) -> None:
    options, message = BAD_OPTIONS[what]
    single, vector = make_single("left_turn"), worlds(2)
    for env in (single, vector):
        env.reset(seed=0)
        before = env.batch.state.tobytes()
        with pytest.raises(ValueError, match=r"^[^\n]+$") as caught:
            env.reset(seed=1, options=options)
        assert message in str(caught.value)
        assert env.batch.state.tobytes() == before
    following = single.reset()[0]
    single.reset(seed=0)
    assert following.tobytes() == single.reset()[0].tobytes()
