"""Roundabout: who starts where, what is observed, who collides and leaves, what it costs, and the scripted drivers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import mo_deepdrive
from mo_deepdrive.simulation.roads import pose_at
from mo_deepdrive.simulation.state import ENDS
from mo_deepdrive.world.observation import layout
from mo_deepdrive.world.scenarios import SCENARIOS

NAMES = [entry.name for entry in layout(SCENARIOS["roundabout"])]
ROUTES = SCENARIOS["roundabout"].routes
LENGTH = 5.17652
STILL, GO, COLLISION = 0, 3, ENDS.index("collision")


def named(observation: np.ndarray) -> dict[str, float]:
    return dict(zip(NAMES, observation.tolist(), strict=True))


def drive(env: Any, chosen: dict[int, int], decisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Let some vehicles act, by their number, and the others stand; the last observations and rewards of world 0."""
    for _ in range(decisions):
        actions = np.zeros((1, env.vehicles), dtype=np.int64)
        for v, action in chosen.items():
            actions[0, v] = action
        observations, rewards, *_ = env.step(actions if env.vehicles > 1 else actions[:, 0])
    return np.atleast_2d(observations[0]), np.atleast_2d(rewards[0])


def set_speed(env: Any, **speeds: float) -> None:
    """Let vehicles roll straight on with a speed: ``v0=5.0``."""
    saved = env.get_state()
    for name, speed in speeds.items():
        car = saved["state"].view(env.batch.state.dtype)[0, int(name[1:])]
        car.speed = car.previous_speed = speed
        car.vx, car.vy = -speed * car.sin_heading, speed * car.cos_heading
    env.set_state(saved)


def test_starts_are_drawn_in_queues_at_all_arms_without_touching(make_vector: Any, shapes: Any) -> None:
    env = make_vector("roundabout", 200, vehicles=16)
    observations, _ = env.reset(seed=0)
    assert env.observation_space.contains(observations)
    state = env.batch.state
    assert set(np.unique(state["route"])) == set(range(12))
    assert not state["speed"].any()
    assert not state["crossing"].any()
    for world in state[:20]:
        boxes = [shapes.box(car.x, car.y, car.heading) for car in world]
        for a in range(16):
            assert min(shapes.gap(boxes[a], boxes[b]) for b in range(16) if b != a) > 1.9
    for world in state:
        for arm in range(4):
            fronts = np.sort(world["route_distance"][world["route"] // 3 == arm])[::-1]
            assert len(fronts) == 4, "16 vehicles fill every arm"
            assert 40.0 < fronts[0] <= 44.0
            ahead = fronts[:-1] - fronts[1:] - LENGTH - 2.0
            assert ((ahead >= -1e-9) & (ahead < 4.0)).all()
    few = make_vector("roundabout", 500, vehicles=2).reset(seed=0)
    assert few[0].shape == (500, 2, 63)


def test_what_is_observed_of_others_is_in_the_frame_of_the_vehicle(make_vector: Any) -> None:
    env = make_vector("roundabout", 1, vehicles=8, harmful_g_force=None)
    env.reset(seed=2)
    rng = np.random.default_rng(0)
    for _ in range(60):
        observations = env.step(rng.choice([3, 6, 9], (1, 8)))[0]
    world = env.batch.state[0]
    running = np.flatnonzero(world["end"] == 0)
    assert len(running) > 3
    for v in running:
        me, seen = world[v], named(observations[0, v])
        others = sorted((o for o in running if o != v), key=lambda o: np.hypot(world[o].x - me.x, world[o].y - me.y))
        turn = np.exp(-1j * me.heading)
        for k in range(5):
            got = [seen[f"near_{k + 1}_{name}"] for name in ("right", "ahead", "v_right", "v_ahead", "present")]
            if k >= len(others):
                assert got == [0.0, 100.0, 0.0, 0.0, 0.0]
                continue
            other = world[others[k]]
            place = (complex(other.x, other.y) - complex(me.x, me.y)) * turn
            motion = complex(other.vx, other.vy) * turn
            assert got == pytest.approx([place.real, place.imag, motion.real, motion.imag, 1.0], abs=1e-4)
            between = math.atan2(seen[f"near_{k + 1}_sin_heading"], seen[f"near_{k + 1}_cos_heading"])
            assert between == pytest.approx(math.remainder(other.heading - me.heading, math.tau), abs=1e-5)
            inside = bool(other.crossing)
            assert seen[f"near_{k + 1}_inside"] == inside
            assert seen[f"near_{k + 1}_right_of_way"] == (inside and seen["entry_distance"] > 0.0)
        assert seen["crossing"] == me.crossing
        assert seen["remaining_distance"] == pytest.approx(ROUTES[me.route].length - me.route_distance, abs=1e-4)


def test_only_those_who_touch_collide_and_then_they_leave_the_road(make_vector: Any) -> None:
    env = make_vector("roundabout", 1, vehicles=3)
    # One behind another at arm 0, and one at arm 1.
    env.reset(seed=0, options={"routes": [0, 1, 4], "distances": [40.0, 33.0, 40.0]})
    set_speed(env, v1=6.0)
    ends = np.zeros(3)
    while not ends.any():
        observations, rewards = drive(env, {}, 1)
        ends = env.batch.state["end"][0].copy()
    assert ends.tolist() == [COLLISION, COLLISION, 0]
    crash = env.objectives.index("collision")
    assert rewards[:, crash].tolist() == [-1.0, -1.0, 0.0]
    assert {named(observations[2])[f"near_{k}_present"] for k in range(1, 6)} == {0.0}
    _, rewards = drive(env, {}, 1)
    assert not rewards[:2].any()
    # Who left blocks nobody: the third drives through where they were.
    saved = env.get_state()
    worlds = saved["state"].view(env.batch.state.dtype)
    worlds[0, 2].x, worlds[0, 2].y = worlds[0, 0].x, worlds[0, 0].y
    env.set_state(saved)
    _, rewards = drive(env, {}, 1)
    assert env.batch.end_names(0)[2] != "collision"
    assert rewards[2, env.objectives.index("near_miss")] == 0.0


def test_leaving_the_road_ends_the_episode(make_vector: Any) -> None:
    env = make_vector("roundabout", 1, vehicles=2, action_type="continuous", harmful_g_force=None)
    env.reset(seed=0, options={"routes": [0, 3], "distances": [40.0, 40.0]})
    set_speed(env, v0=4.0)
    straight = np.tile(np.array([0.0, 0.0, -1.0], dtype=np.float32), (1, 2, 1))
    offsets = []
    while env.batch.end_names(0)[0] == "":
        env.step(straight)
        offsets.append(env.batch.state[0, 0].lane_offset)
    assert env.batch.end_names(0) == ("off_lane", "")
    assert offsets[-2] <= 4.5 < offsets[-1], "its front is a lane's width to the left of the line"


def test_entering_costs_what_it_forces_those_inside_to_brake(make_vector: Any) -> None:
    env = make_vector("roundabout", 1, vehicles=3)
    line = ROUTES[0].priority[0]  # type: ignore[index]
    column = env.objectives.index("right_of_way")
    env.reset(seed=0, options={"routes": [0, 10, 10], "distances": [44.0, 44.0, 30.0]})
    saved = env.get_state()
    worlds = saved["state"].view(env.batch.state.dtype)
    joint, around = env.batch.params[0].joins[0, 0], env.batch.params[0].joins[0, 10]

    def put(v: int, distance: float, speed: float, entered: int) -> None:
        """On its line, which is compared with a pose in test_roads.py."""
        car = worlds[0, v]
        x, y, cos, sin = pose_at(env.batch.params[0], car.route, distance - LENGTH / 2)
        car.x, car.y, car.heading = x, y, math.atan2(sin, cos)
        car.cos_heading = car.cos_before = cos
        car.sin_heading = car.sin_before = sin
        car.speed = car.previous_speed = speed
        car.segment, car.entered = (
            np.searchsorted(np.cumsum([s.length for s in ROUTES[car.route].segments]), distance),
            entered,
        )
        car.start_heading, car.furthest, car.decisions, car.vx, car.vy = car.heading, 0.0, 5, -speed * sin, speed * cos

    for first, second, costs in ((3, 4, True), (4, 3, False)):  # who was inside before
        put(0, line + 4.0, 2.0, second)
        put(1, around - 15.0, 6.0, first)
        env.set_state(saved)
        _, rewards = drive(env, {}, 1)
        me, other = env.batch.state[0, :2]
        gap = around + me.route_distance - joint - LENGTH - other.route_distance
        needed = (other.speed - me.speed) ** 2 / (2 * gap)
        assert 0.2 < needed < 5.0
        assert rewards[0, column] == pytest.approx(-0.1 * needed if costs else 0.0, rel=1e-6)
        assert rewards[1:, column].tolist() == [0.0, 0.0]


def test_energy_is_the_positive_work_of_the_traction_force(make_vector: Any) -> None:
    env = make_vector("roundabout", 1, vehicles=2, objectives=("energy", "distance"))
    env.reset(seed=0)
    spent = np.zeros(2)
    for decision in range(40):
        _, rewards = drive(env, {0: GO if decision < 20 else 2}, 1)
        spent -= rewards[:, 0]
    # What a mass of 1 kg gained by 2 s of 1 m/s^2, and what friction took meanwhile; braking gave nothing back.
    assert spent[0] == pytest.approx(1.94**2 / 2, rel=0.1)
    assert spent[1] == 0.0


@pytest.mark.slow
def test_scripted_drivers_arrive_without_touching_each_other(make_vector: Any, shapes: Any) -> None:
    env = make_vector("roundabout_solo", 40, cars=15, autoreset_mode="Disabled", time_limit=600.0)
    env.reset(seed=1, options={"routes": [0], "distances": [6.0]})  # the vehicle stands behind all others
    touched, speeds, steps = set(), [], 0
    cars = env.batch.state[:, 0]["cars"]
    while cars["present"].any() and steps < 2000:
        env.step(np.zeros(40, dtype=np.int64))
        cars = env.batch.state[:, 0]["cars"]
        steps += 1
        if steps % 5 == 0:
            for world in range(40):
                present = cars[world][cars[world]["present"]]
                speeds += present["speed"].tolist()
                for a in range(len(present)):
                    for b in range(a):
                        if np.hypot(present[a].x - present[b].x, present[a].y - present[b].y) < 6.0:
                            first, second = (
                                shapes.box(car.x, car.y, math.atan2(car.sin_heading, car.cos_heading))
                                for car in (present[a], present[b])
                            )
                            if shapes.gap(first, second) < 0.0:
                                touched.add((world, a, b))
    assert not cars["present"].any()
    assert len(touched) <= 0.01 * 40 * 15
    assert max(speeds) <= 7.0


def test_types_of_drivers_are_drawn_and_hidden(make_vector: Any) -> None:
    env = make_vector("roundabout_solo", 300)
    env.reset(seed=0)
    drivers = env.batch.state[:, 0]["cars"]["driver"]
    for name, low, high in (("desired_speed", 4.5, 7.0), ("headway", 0.8, 1.8), ("accepted_gap", 4.2, 5.9)):
        assert drivers[name].min() == pytest.approx(low, abs=0.02)
        assert drivers[name].max() == pytest.approx(high, abs=0.02)
    env.reset(seed=0, options={"accepted_gaps": [1.0] * 7, "desired_speeds": [3.0], "routes": [5], "distances": [30.0]})
    world = env.batch.state[:, 0]
    assert (world["cars"]["driver"]["accepted_gap"] == 1.0).all()
    assert (world["cars"]["driver"]["desired_speed"][:, 0] == 3.0).all()
    assert set(world["route"]) == {5}


@pytest.mark.parametrize(
    ("scenario", "arguments", "message"),
    [
        ("roundabout", {"vehicles": 17}, "'vehicles' = 17: Input should be less than or equal to 16"),
        ("roundabout", {"vehicles": 1}, "'vehicles' = 1: Input should be greater than or equal to 2"),
        ("roundabout", {"vehicles": 12, "cars": 5}, "vehicles = 12 and cars = 5 are more than Roundabout holds: 16"),
        ("roundabout_solo", {"cars": 16}, "'cars' = 16: Input should be less than 16"),
        ("roundabout_solo", {"vehicles": 3}, "vehicles = 3 has no effect in Roundabout solo; omit it"),
        ("intersection", {"vehicles": 3}, "vehicles = 3 has no effect in Intersection; omit it"),
        ("left_turn", {"cars": 2}, "cars = 2 has no effect in LeftTurn; omit it"),
        ("roundabout", {"traffic": "dense"}, "traffic = 'dense' has no effect in Roundabout; omit it"),
        ("left_turn", {"objectives": ["right_of_way"]}, "objectives has 'right_of_way', which LeftTurn does not have"),
    ],
)
def test_settings_that_do_not_fit_are_refused(scenario: str, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=r"^[^\n]*$") as caught:
        mo_deepdrive.parallel_env(scenario=scenario, **arguments)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"routes": [12]},
            r"'routes' = \[12\] must have a number in \[0, 11\] per vehicle and car, at most 4",
        ),
        ({"routes": [0.5]}, r"reset option 'routes' = \[0.5\] must have whole numbers"),
        (
            {"distances": [45.0]},
            r"'distances' = \[45.0\] must have a number in \[0, 44\] m per vehicle and car",
        ),
        ({"routes": [0, 1], "distances": [30.0, 31.0]}, "vehicles or cars touch, or are not on their first segment"),
        ({"start": (0.0, 0.0, 0.0)}, "unknown reset option 'start' in Roundabout; .*known: distances, routes"),
    ],
)
def test_reset_options_that_do_not_fit_are_refused(make_single: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_single("roundabout").reset(seed=0, options=options)
