"""States that the kernel cannot take are refused by name, and those that the dynamics reach are not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mo_deepdrive.simulation.state import MAX_WAYPOINTS, VEHICLE

FIELDS = VEHICLE.names or ()
FLOATS = [name for name in FIELDS if VEHICLE[name].base == np.float64]
INTEGERS = {"next_waypoint": 2, "n_waypoints": 3, "decisions": 600, "end": 10}
NEVER_NEGATIVE = ("next_distance", "along", "travelled", "jerk", "g_force", "brake")


@pytest.fixture(scope="module")
def driven(make_vector: Any) -> Any:
    """Two intersections, after a few decisions, with room for every field."""
    env = make_vector("intersection", 2, action_delay=2)
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.full((2, 2), 3))
    return env


def refusal(env: Any, name: str, value: Any) -> str:
    """The message that refuses ``value`` in field ``name`` of the last vehicle; the environment is unchanged."""
    before = env.get_state()
    saved = env.get_state()
    vehicles = saved["state"].view(env.batch.state.dtype)
    field = vehicles[name] if vehicles[name].dtype != np.bool_ else vehicles[name].view(np.uint8)
    field[(1, 1, *[-1] * (field.ndim - 2))] = value
    with pytest.raises(ValueError, match=r"^[^\n]+$") as caught:
        env.set_state(saved)
    assert all(np.array_equal(array, before[key]) for key, array in env.get_state().items())
    return str(caught.value)


@pytest.mark.parametrize("name", FLOATS)
def test_floats_out_of_range_are_refused_by_name(driven: Any, name: str) -> None:
    for value in (np.nan, np.inf, -np.inf, 1e12, -1e12, *([-0.1] if name in NEVER_NEGATIVE else [])):
        message = refusal(driven, name, value)
        assert message.startswith(f"state has {name} = {value} for vehicle 1 of world 1; it must be between ")


@pytest.mark.parametrize("name", INTEGERS)
def test_integers_out_of_range_are_refused_by_name(driven: Any, name: str) -> None:
    # Vehicle 1 has one waypoint.
    most = {"next_waypoint": 0, "n_waypoints": 1}.get(name, INTEGERS[name])
    least = 1 if name == "n_waypoints" else 0
    for value in (-1, -(2**63), most + 1, 10**9, 2**63 - 1):
        message = refusal(driven, name, value)
        assert message == (
            f"state has {name} = {value} for vehicle 1 of world 1; it must be between {least} and {most}"
        )


@pytest.mark.parametrize("name", ["crossing", "approaching"])
def test_flags_other_than_0_and_1_are_refused(driven: Any, name: str) -> None:
    assert f"{name} = 7 for vehicle 1 of world 1; it must be between 0 and 1" in refusal(driven, name, 7)


@pytest.mark.parametrize(
    ("path", "wrong"),
    [
        ("cars.x", (np.nan, 1e12)),
        ("cars.y", (np.nan, 1e12, -1e12)),
        ("cars.speed", (np.nan, np.inf, -0.1, 1e12)),
        ("cars.acceleration", (np.nan, -9.9, 4.0)),
        ("cars.driver.desired_speed", (np.nan, 0.0, 26.0)),
        ("cars.driver.headway", (np.nan, -0.1, 61.0)),
        ("cars.driver.yielding", (np.nan, -0.1, 9.9)),
        ("cars.present", (7,)),
    ],
)
def test_a_car_out_of_range_is_refused_by_the_path_of_the_field(
    make_vector: Any, path: str, wrong: tuple[float, ...]
) -> None:
    env = make_vector("left_turn", 2)
    env.reset(seed=0)
    before = env.get_state()
    for value in wrong:
        saved = env.get_state()
        cars = saved["state"].view(env.batch.state.dtype)
        for part in path.split("."):
            cars = cars[part]
        (cars if cars.dtype != np.bool_ else cars.view(np.uint8))[1, 0, 3] = value
        with pytest.raises(ValueError, match=r"^[^\n]+$") as caught:
            env.set_state(saved)
        assert str(caught.value).startswith(f"state has {path} = {value} for vehicle 0 of world 1; it must be between ")
        assert all(np.array_equal(array, before[key]) for key, array in env.get_state().items())


def test_a_running_vehicle_without_waypoints_is_refused_and_one_that_was_never_placed_is_not(make_vector: Any) -> None:
    env = make_vector("intersection", 2)
    fresh = env.get_state()
    env.reset(seed=0)
    message = refusal(env, "n_waypoints", 0)
    assert message == "state has n_waypoints = 0 for vehicle 1 of world 1; it must be between 1 and 1"
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
