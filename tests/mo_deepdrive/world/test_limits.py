"""States that the kernel cannot take are refused by name, and those that the dynamics reach are not."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from mo_deepdrive.simulation.state import MAX_WAYPOINTS, VEHICLE

FIELDS = VEHICLE.names or ()
FLOATS = [name for name in FIELDS if VEHICLE[name].base == np.float64]
NEVER_NEGATIVE = ("next_distance", "along", "travelled", "jerk", "g_force", "brake")
# Vehicle 1 has one waypoint.
INTEGERS = {"next_waypoint": (0, 0), "n_waypoints": (1, 1), "decisions": (0, 600), "end": (0, 10)}
REFUSED: dict[str, tuple[Any, ...]] = {
    **{name: (np.nan, np.inf, -np.inf, 1e12, -1e12, *([-0.1] if name in NEVER_NEGATIVE else [])) for name in FLOATS},
    **{name: (least - 1, -(2**63), most + 1, 2**63 - 1) for name, (least, most) in INTEGERS.items()},
    "crossing": (7,),
    "approaching": (7,),
}
REFUSED_OF_CARS: dict[str, tuple[Any, ...]] = {
    "cars.x": (np.nan, 1e12),
    "cars.y": (np.nan, 1e12, -1e12),
    "cars.speed": (np.nan, np.inf, -0.1, 1e12),
    "cars.acceleration": (np.nan, -9.9, 4.0),
    "cars.driver.desired_speed": (np.nan, 0.0, 26.0),
    "cars.driver.headway": (np.nan, -0.1, 61.0),
    "cars.driver.yielding": (np.nan, -0.1, 9.9),
    "cars.present": (7,),
}


def assert_refuses(env: Any, path: str, value: Any) -> None:
    """A value in a field of the last vehicle of world 1 is refused by name, and the environment is unchanged."""
    before, saved = env.get_state(), env.get_state()
    field = saved["state"].view(env.batch.state.dtype)
    for part in path.split("."):
        field = field[part]
    field = field.view(np.uint8) if field.dtype == np.bool_ else field
    field[(1, *[-1] * (field.ndim - 1))] = value
    last = env.vehicles - 1
    message = f"state has {path} = {value} for vehicle {last} of world 1; it must be between "
    with pytest.raises(ValueError, match=rf"^{re.escape(message)}[^\n]+$"):
        env.set_state(saved)
    assert all(np.array_equal(array, before[key]) for key, array in env.get_state().items())


@pytest.mark.parametrize("path", [*REFUSED, *REFUSED_OF_CARS])
def test_what_is_out_of_range_is_refused_by_name(make_vector: Any, path: str) -> None:
    env = make_vector("intersection", 2, action_delay=2) if path in REFUSED else make_vector("left_turn", 2)
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.full(env.action_space.shape, 3))
    for value in {**REFUSED, **REFUSED_OF_CARS}[path]:
        assert_refuses(env, path, value)


def test_a_running_vehicle_without_waypoints_is_refused_and_one_that_was_never_placed_is_not(make_vector: Any) -> None:
    env = make_vector("intersection", 2)
    fresh = env.get_state()
    env.reset(seed=0)
    assert_refuses(env, "n_waypoints", 0)
    env.set_state(fresh)
    assert (env.batch.state["n_waypoints"] == 0).all()
    assert (fresh["state"].view(env.batch.state.dtype)["next_waypoint"] < MAX_WAYPOINTS).all()


EXTREMES: dict[str, dict[str, Any]] = {
    "as published": {},
    "discrete": {"action_type": "discrete"},
    "delayed": {"action_delay": 3},
    "constrained": {"constrain_controls": True},
    "coarse": {"simulation_frequency": 1, "decision_frequency": 1},
    "coarse decisions": {"simulation_frequency": 60, "decision_frequency": 1},
    "fine": {"simulation_frequency": 1000, "decision_frequency": 20},
}


@pytest.mark.parametrize("name", EXTREMES)
@pytest.mark.parametrize("scenario", ["static_obstacle", "intersection", "left_turn"])
def test_every_state_that_wild_driving_reaches_is_accepted(make_vector: Any, scenario: str, name: str) -> None:
    options = {"action_type": "continuous", "harmful_g_force": None, "time_limit": 30.0, **EXTREMES[name]}
    env = make_vector(scenario, 16, **options)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    n, speeds = env.action_space.shape, []
    for step in range(120):
        if step % 10 == 0:
            # Full throttle, full brake, full lock and everything in between, each held for a while.
            actions = (
                rng.choice([0, 1, 3, 6, 9, 18, 21], n)
                if options["action_type"] == "discrete"
                else rng.choice([-1.0, 0.0, 1.0], n).astype(np.float32)
            )
        env.step(actions)
        env.set_state(env.get_state())
        speeds.append(np.abs(env.batch.state["speed"]).max())
    assert max(speeds) > 1.0
