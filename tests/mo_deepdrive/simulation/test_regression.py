"""A small frozen set of our own trajectories, which guards the dynamics bit for bit.

``data/regression.npz`` has, for each case below, the actions, rewards and ends of every decision, and the state and
observations of every fifth. Worlds are reset automatically, so starts, redraws and the seeded streams are guarded, too.
After an intended change of the simulation,

    python tests/mo_deepdrive/simulation/test_regression.py

writes the set again; the commit message says why.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import mo_deepdrive  # noqa: F401  (registers the ids)
from mo_deepdrive.simulation.state import ENDS

DATA = Path(__file__).resolve().parent / "data" / "regression.npz"
DECISIONS = 160
EVERY = 5
SEED = 20_240

FIELDS = (
    "x",
    "y",
    "heading",
    "speed",
    "yaw_rate",
    "vx",
    "vy",
    "ax",
    "ay",
    "g_force",
    "jerk",
    "steer",
    "throttle",
    "brake",
    "route_distance",
    "travelled",
    "left_lane_distance",
    "right_lane_distance",
)

# Name -> scenario and environment arguments.
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "one_waypoint-discrete": ("one-waypoint", {}),
    "one_waypoint-discrete-16": ("one-waypoint", {"action_type": "discrete-16", "fixed_destination": True}),
    "one_waypoint-continuous": ("one-waypoint", {"action_type": "continuous"}),
    "one_waypoint-constrained": ("one-waypoint", {"action_type": "continuous", "constrain_controls": True}),
    "one_waypoint-coarse": (
        "one-waypoint",
        {"action_type": "continuous", "simulation_frequency": 20, "decision_frequency": 5, "harmful_g_force": None},
    ),
    "static_obstacle-discrete": ("static-obstacle", {"cost_sign": "paper"}),
    "static_obstacle-continuous": ("static-obstacle", {"action_type": "continuous", "time_limit": 8.0}),
    "static_obstacle-unbraked": (
        "static-obstacle",
        {"action_type": "continuous", "ignore_brake": True, "harmful_jerk": 50.0, "harmful_g_force": None},
    ),
    "intersection-discrete": ("intersection", {"end_together": True}),
    "intersection-continuous": ("intersection", {"action_type": "continuous", "lane_margin": 0.5}),
    "intersection-lanes": (
        "intersection",
        {"action_type": "continuous", "end_on_lane_violation": True, "yield_to_oncoming": False},
    ),
    "left_turn-discrete": ("left-turn", {"traffic": "dense"}),
    "left_turn-continuous": (
        "left-turn",
        {"action_type": "continuous", "objectives": ["distance", "collision", "near_miss", "time"]},
    ),
}


def make(case: str) -> Any:
    scenario, options = CASES[case]
    return gymnasium.make_vec(f"mo-deepdrive-{scenario}-v0", num_envs=1, **options)


def replay(env: Any, actions: Any) -> dict[str, np.ndarray]:
    """Drive one world with ``actions``; a callable chooses them from the last observations."""
    observations, _ = env.reset(seed=SEED)
    taken, rewards, ends, states, seen = [], [], [], [], []
    for decision in range(DECISIONS):
        action = actions(observations) if callable(actions) else actions[decision]
        observations, reward, _, _, _ = env.step(action[None])
        taken.append(action)
        rewards.append(reward[0])
        ends.append(env.batch.state["end"][0].astype(np.int8))
        if decision % EVERY == 0:
            states.append([[reading[field] for field in FIELDS] for reading in env.telemetry()[0]])
            seen.append(observations[0])
    return {
        "actions": np.array(taken),
        "rewards": np.array(rewards),
        "ends": np.array(ends),
        "states": np.array(states),
        "observations": np.array(seen),
    }


def wander_and_chase(env: Any) -> Any:
    """A seeded policy of random, repeated actions, which sometimes drives to the waypoint."""
    rng = np.random.default_rng(SEED)
    shape = env.single_action_space.shape
    held = np.zeros(shape, dtype=env.action_space.dtype)
    chasing = False

    def act(observations: np.ndarray) -> np.ndarray:
        nonlocal held, chasing
        if rng.random() < 0.15:
            chasing = rng.random() < 0.7
            held = np.asarray(env.single_action_space.sample())
        if not chasing:
            return held
        rows = observations.reshape(-1, observations.shape[-1])
        return np.array([toward(env, row) for row in rows], dtype=env.action_space.dtype).reshape(shape)

    env.single_action_space.seed(SEED)
    return act


def toward(env: Any, observation: np.ndarray) -> Any:
    """Drive to the next waypoint."""
    angle, speed = float(observation[0]), float(observation[11])
    if env.config.action_type != "continuous":
        if abs(angle) < 0.05:
            return 3  # decay, increase speed
        small = 6 if angle < 0 else 9  # small steer left or right, increase speed
        large = small + (12 if env.config.action_type == "discrete" else 6)
        return large if abs(angle) > 0.3 else small
    steer = float(np.clip(-angle, -1.0, 1.0)) * 0.6 / max(1.0, speed) ** 2
    return [steer, float(np.clip(4.0 - speed, -1.0, 1.0)), -1.0]


def write() -> None:
    """Write the frozen set again."""
    arrays = {}
    for case in CASES:
        env = make(case)
        for name, array in replay(env, wander_and_chase(env)).items():
            arrays[f"{case}/{name}"] = array.astype(np.int8) if array.dtype == np.int64 else array
    DATA.parent.mkdir(exist_ok=True)
    np.savez_compressed(DATA, **arrays)
    ends = {ENDS[code] for case in CASES for code in np.unique(arrays[f"{case}/ends"])}
    print(f"{DATA}: {DATA.stat().st_size} bytes, ends: {', '.join(sorted(ends - {''}))}")


@pytest.fixture(scope="module")
def frozen() -> dict[str, np.ndarray]:
    with np.load(DATA, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


@pytest.mark.parametrize("case", CASES)
def test_the_simulation_reproduces_the_frozen_trajectories(frozen: dict[str, np.ndarray], case: str) -> None:
    expected = {name: frozen[f"{case}/{name}"] for name in ("actions", "rewards", "ends", "states", "observations")}
    env = make(case)
    ours = replay(env, expected["actions"].astype(env.action_space.dtype))
    vehicles = env.vehicles
    assert expected["states"].shape == (math.ceil(DECISIONS / EVERY), vehicles, len(FIELDS))
    assert len(expected["rewards"]) == DECISIONS
    np.testing.assert_array_equal(ours["ends"], expected["ends"])
    for k, field in enumerate(FIELDS):
        # The floor allows for rounding of zeros.
        np.testing.assert_allclose(
            ours["states"][..., k], expected["states"][..., k], rtol=1e-9, atol=1e-9, err_msg=field
        )
    np.testing.assert_allclose(ours["observations"], expected["observations"], rtol=2e-7, atol=1e-9)
    np.testing.assert_allclose(ours["rewards"], expected["rewards"], rtol=2e-7, atol=1e-9)


if __name__ == "__main__":
    write()
