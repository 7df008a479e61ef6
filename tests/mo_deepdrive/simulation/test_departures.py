"""Intended departures from the published code: one test for each of the ten in ``docs/simulator.md``, in its order."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mo_deepdrive.simulation.state import KERNEL_NAMES
from mo_deepdrive.world.objectives import OBJECTIVES
from mo_deepdrive.world.observation import layout
from mo_deepdrive.world.scenarios import SCENARIOS

IDLE = 0
CRAWL = np.array([0.0, 0.4, -1.0], dtype=np.float32)
COAST = np.array([0.0, 0.0, -1.0], dtype=np.float32)
COSTS = [objective.name for objective in OBJECTIVES if objective.sign < 0 and objective.name in KERNEL_NAMES]
SIZES = {"one_waypoint": 15, "static_obstacle": 19, "intersection": 29}


def random_actions(space: Any, count: int, seed: int) -> list[Any]:
    space.seed(seed)
    return [space.sample() for _ in range(count)]


def drive(env: Any, policy: Any, observation: np.ndarray, most: int = 10_000) -> tuple[list[Any], dict[str, Any]]:
    """Steps (observation, reward, terminated, truncated) of an episode of a single environment, and its last info."""
    steps: list[Any] = []
    info: dict[str, Any] = {}
    while not info and len(steps) < most:
        observation, reward, terminated, truncated, info = env.step(policy(observation))
        steps.append((observation, reward, terminated, truncated))
    return steps, info


@pytest.mark.parametrize("scenario", SIZES)
def test_1_every_cost_is_negated_so_every_component_is_maximised(make_vector: Any, scenario: str) -> None:
    env = make_vector(scenario, 8, action_type="continuous")
    paper = make_vector(scenario, 8, action_type="continuous", cost_sign="paper")
    env.reset(seed=1)
    paper.reset(seed=1)
    costs = np.array([name in COSTS for name in env.objectives])
    assert set(COSTS) == {"g_force", "collision", "jerk", "lane_violation"}
    seen = np.zeros(len(costs), dtype=bool)
    for actions in random_actions(env.action_space, 200, 0):
        rewards, magnitudes = env.step(actions)[1], paper.step(actions)[1]
        np.testing.assert_array_equal(rewards, np.where(costs, -magnitudes, magnitudes))
        assert (magnitudes[..., costs] >= 0).all()
        assert (rewards[..., costs] <= 0).all()
        seen |= (rewards.reshape(-1, len(costs)) != 0).any(axis=0)
    gained = {"distance", "g_force", "jerk"} & set(env.objectives)
    assert gained <= {name for name, moved in zip(env.objectives, seen, strict=True) if moved}


@pytest.mark.parametrize(("scenario", "size"), SIZES.items())
def test_2_observations_are_complete_from_the_reset_and_velocity_has_the_direction_of_motion(
    make_vector: Any, scenario: str, size: int
) -> None:
    env = make_vector(scenario, 4, action_type="continuous", autoreset_mode="Disabled")
    first, _ = env.reset(seed=3)
    vehicles = (2,) if scenario == "intersection" else ()
    assert first.shape == (4, *vehicles, size)
    assert (first[..., 2] > 1.0).all(), "the distance to the next waypoint is observed after the reset"
    # An observation depends on the state alone: that of a vehicle at rest does not change while it is idle.
    actions = np.zeros(env.action_space.shape, dtype=np.float32)
    actions[..., 2] = -1.0
    np.testing.assert_array_equal(env.step(actions)[0], first)
    actions[..., 0], actions[..., 1] = 0.3, 0.5
    for _ in range(8):
        before = np.array([[[car["x"], car["y"]] for car in world] for world in env.telemetry()])
        observations = env.step(actions)[0].reshape(4, -1, size)
        after = np.array([[[car["x"], car["y"]] for car in world] for world in env.telemetry()])
        moved, velocity = (after - before) * 10, observations[..., 4:6]
        along = (moved * velocity).sum(-1) / (np.linalg.norm(moved, axis=-1) * np.linalg.norm(velocity, axis=-1))
        assert (along > 0.99).all()


def test_3_a_collision_is_on_the_decision_of_the_contact_of_solid_shapes(make_single: Any, shapes: Any) -> None:
    bicycle = ((10.0, -1.0), (10.0, 1.0))
    env = make_single("static_obstacle", action_type="continuous")
    env.reset(options={"start": (0.0, 0.0, -math.pi / 2), "destination": (60.0, 0.0), "obstacle": bicycle})
    gaps, steps, info = [], [], {}
    while not info:
        observation, reward, terminated, _, info = env.step(CRAWL)
        steps.append((reward[env.objectives.index("collision")], terminated))
        car = env.telemetry()[0]
        gaps.append(shapes.gap(shapes.box(car["x"], car["y"], car["heading"]), np.array(bicycle)))
        assert observation.shape == (19,)
    assert info == {"end": "collision", "success": False}
    assert min(gaps[:-1]) > 0.0 > gaps[-1], "the last decision is the first after which they overlap"
    assert steps[-1] == (-1.0, True)
    assert set(steps[:-1]) == {(0.0, False)}
    # A segment inside the car that touches none of its edges. It is inside from one physics step to the next: the car
    # starts in front of it with a speed, so that no edge is on it at a physics step.
    small = np.array([[10.0, 0.0], [10.0, 0.01]])
    env = make_single("static_obstacle", harmful_g_force=None, simulation_frequency=10)
    env.reset(options={"start": (0.0, 0.0, -math.pi / 2), "destination": (60.0, 0.0), "obstacle": small})
    car = env.batch.state[0, 0]
    car.speed = car.previous_speed = car.vx = 100.0
    info = env.step(IDLE)[4]
    reading = env.telemetry()[0]
    box = shapes.box(reading["x"], reading["y"], reading["heading"])
    assert reading["x"] == pytest.approx(10.0)
    np.testing.assert_array_less(box.min(axis=0) + 0.5, small.min(axis=0))
    np.testing.assert_array_less(small.max(axis=0), box.max(axis=0) - 0.5)
    assert info["end"] == "collision"


@pytest.mark.parametrize("scenario", SIZES)
def test_4_the_time_limit_truncates(make_vector: Any, scenario: str) -> None:
    env = make_vector(scenario, 2, autoreset_mode="Disabled")
    env.reset(seed=0)
    actions = np.zeros(env.action_space.shape, dtype=np.int64)
    for decision in range(1, 601):
        _, _, terminated, truncated, infos = env.step(actions)
        assert not terminated.any()
        assert truncated.all() == truncated.any() == (decision == 600)
    assert set(infos["end"].ravel()) == {"time_limit"}
    assert not infos["success"].any()


@pytest.mark.parametrize("scenario", SIZES)
def test_5_all_randomness_comes_from_the_environments_own_seeded_generator(make_vector: Any, scenario: str) -> None:
    def spawn(seed: int | None) -> np.ndarray:
        return env.reset(seed=seed)[0]

    env = make_vector(scenario, 3)
    np.random.seed(0)  # noqa: NPY002  (the global generator is what must not matter)
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    first, second = spawn(7), spawn(None)
    assert (np.random.get_state()[1] == before).all(), "the global generator is not used"  # noqa: NPY002
    np.random.seed(1)  # noqa: NPY002
    other = make_vector(scenario, 3)
    other.reset(seed=8)  # another environment, which draws in between
    again = spawn(7)
    other.reset()
    np.testing.assert_array_equal(again, first)
    np.testing.assert_array_equal(spawn(None), second)
    assert (first != second).any()


def test_6_the_vehicles_move_together_and_one_that_ends_leaves_the_road(make_vector: Any, chase: Any) -> None:
    options: dict[str, Any] = {"action_type": "continuous", "autoreset_mode": "Disabled"}
    env = make_vector("intersection", **options)
    # They move at the same time: each observes the current position and speed of the other.
    observations, _ = env.reset(options={"starts": ((27.077, 10.0, 0.0), (24.039, 40.0, math.pi))})
    both = np.stack([CRAWL, CRAWL])[None]
    for _ in range(3):
        observations = env.step(both)[0]
    names = [entry.name for entry in layout(SCENARIOS["intersection"])]
    seen = [names.index("other_vx"), names.index("other_vy")]
    for v, car in enumerate(env.telemetry()[0]):
        assert car["speed"] > 0.1
        np.testing.assert_allclose(observations[0, 1 - v, seen], [car["vx"], car["vy"]], rtol=1e-6, atol=1e-9)
    # The vehicle that drives straight on arrives and leaves the road; then the left turn arrives, too.
    early = ((27.077, 6.0, 0.0), (24.039, 15.0, math.pi))
    observations, _ = env.reset(options={"starts": early})
    ended_at = [0, 0]
    for decision in range(1, 601):
        actions = np.stack([chase(observations[0, 0]), chase(observations[0, 1])])
        actions[0, 1] *= 0.3 if not ended_at[1] else 1.0
        observations, _, terminated, truncated, infos = env.step(actions[None])
        for v in range(2):
            ended_at[v] = ended_at[v] or decision * bool(terminated[0, v] or truncated[0, v])
        if all(ended_at):
            break
    assert list(infos["end"][0]) == ["arrived", "arrived"]
    assert 0 < ended_at[1] < ended_at[0]
    # In the published code the episode ended for both vehicles with the first one.
    together = make_vector("intersection", end_together=True, **options)
    observations, _ = together.reset(options={"starts": early})
    for _ in range(600):
        actions = np.stack([chase(observations[0, 0]) * (0.3, 0.3, 1.0), chase(observations[0, 1])])
        observations, _, terminated, _, infos = together.step(actions[None])
        if terminated.any():
            break
    assert list(infos["end"][0]) == ["other_vehicle", "arrived"]
    assert terminated.all()
    # A collision ends both.
    env.reset(options={"starts": ((27.0, 15.0, 0.0), (27.0, 25.0, math.pi))})
    for _ in range(600):
        _, rewards, terminated, _, infos = env.step(both)
        if terminated.any():
            break
    assert list(infos["end"][0]) == ["collision", "collision"]
    np.testing.assert_array_equal(rewards[0, :, env.objectives.index("collision")], [-1.0, -1.0])


def drawn_bicycle(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Destination and bicycle of five uniforms (section 4)."""
    scale = 405 / 5.17652 / 4
    start = np.array([0.1 * 900 + 50, 0.5 * 900 + 50]) / scale
    goal = np.array([(0.1 + 0.5 * u[0] + 0.1) * 900 + 50, (0.5 + (2 * u[1] - 1) * 0.5) * 900 + 50]) / scale
    route = goal - start
    away = 0.6 * u[2] * np.hypot(*route) + 0.1 * 900 / scale
    middle = start + away * route / np.hypot(*route)
    side = (0.025 + 0.1 * u[3]) / 2 * 900 / scale * np.array([math.cos(math.pi * u[4]), math.sin(math.pi * u[4])])
    return goal, np.array([middle + side, middle - side])


def is_fair(shapes: Any, goal: np.ndarray, bicycle: np.ndarray) -> bool:
    scale = 405 / 5.17652 / 4
    car = shapes.box(140 / scale, 500 / scale, -math.pi / 2)
    along = np.linspace(0, 1, 20_001)[:, None]
    near = np.linalg.norm(bicycle[0] * (1 - along) + bicycle[1] * along - goal, axis=1).min()
    return bool(near > 1.0 and shapes.gap(car, bicycle) > 0)


@pytest.mark.slow
def test_7_a_bicycle_at_the_vehicle_or_the_destination_is_drawn_again(make_single: Any, shapes: Any) -> None:
    env = make_single("static_obstacle")
    redrawn = 0
    for seed in range(400):
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
        goal, bicycle = drawn_bicycle(rng.random(5))
        redrawn += not is_fair(shapes, goal, bicycle)
        while not is_fair(shapes, goal, bicycle):
            goal, bicycle = drawn_bicycle(rng.random(5))
        env.reset(seed=seed)
        car = env.batch.state[0, 0]
        np.testing.assert_allclose(car.waypoints[0], goal, rtol=1e-12)
        np.testing.assert_allclose(car.obstacle, bicycle, rtol=1e-12)
    assert 10 < redrawn < 45  # 6% of the draws


def test_8_one_waypoint_has_the_destination_objective(make_single: Any, chase: Any) -> None:
    env = make_single(action_type="continuous")
    assert "destination" in env.objectives
    steps, info = drive(env, chase, env.reset(seed=0)[0])
    paid = [float(reward[env.objectives.index("destination")]) for _, reward, _, _ in steps]
    assert info == {"end": "arrived", "success": True}
    assert paid == [0.0] * (len(paid) - 1) + [1.0]


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_9_circling_is_measured_from_the_starting_heading(make_vector: Any, side: float) -> None:
    env = make_vector("intersection", action_type="continuous", autoreset_mode="Disabled")
    env.reset(seed=0)
    start = env.telemetry()[0][1]["heading"]
    assert start == math.pi
    # After a full turn to the left the vehicle faces its initial direction, and its heading is 540 degrees.
    saved = env.get_state()
    car = saved["state"].view(env.batch.state.dtype)[0, 1]
    car.heading = start + side * 2 * math.pi
    env.set_state(saved)
    actions = np.stack([COAST, np.array([0.3 * side, 0.3, -1.0], dtype=np.float32)])[None]
    headings = [start + side * 2 * math.pi]
    while env.batch.end_names(0) == ("", ""):
        env.step(actions)
        headings.append(env.telemetry()[0][1]["heading"])
    assert env.batch.end_names(0) == ("", "circling")
    turned = side * (np.array(headings) - start)
    assert (np.diff(turned) >= 0).all()
    assert turned[-2] <= math.radians(400) < turned[-1]
    assert len(turned) > 5


def test_10_an_arrival_on_the_last_decision_counts_as_an_arrival(make_single: Any, chase: Any) -> None:
    env = make_single(action_type="continuous")
    decisions = len(drive(env, chase, env.reset(seed=0)[0])[0])
    assert 20 < decisions < 600
    just = make_single(action_type="continuous", time_limit=decisions / 10)
    steps, info = drive(just, chase, just.reset(seed=0)[0])
    assert info == {"end": "arrived", "success": True}
    assert steps[-1][2:] == (True, False)
    late = make_single(action_type="continuous", time_limit=(decisions - 1) / 10)
    steps, info = drive(late, chase, late.reset(seed=0)[0])
    assert info == {"end": "time_limit", "success": False}
    assert steps[-1][2:] == (False, True)
    assert len(steps) == decisions - 1
