"""Intended departures from the published code, by their numbers in ``docs/simulator.md``.

The others are compared elsewhere: collisions (3) and their decision in ``test_golden.py``, time limits, circling and
arrivals (4, 8, 9, 10) in ``test_kernel.py`` and ``test_scenarios.py``, seeds (5) and vehicles that move together and
leave the road (6) in ``test_interfaces.py``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mo_deepdrive.simulation.state import KERNEL_NAMES
from mo_deepdrive.world.objectives import OBJECTIVES

COSTS = [objective.name for objective in OBJECTIVES if objective.sign < 0 and objective.name in KERNEL_NAMES]
SIZES = {"one_waypoint": 15, "static_obstacle": 19, "intersection": 29}


def random_actions(space: Any, count: int, seed: int) -> list[Any]:
    space.seed(seed)
    return [space.sample() for _ in range(count)]


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
