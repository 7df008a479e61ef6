"""Version 1 of the ids, in which time costs and ending early saves none, and arguments that test generalisation."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

import mo_deepdrive
from mo_deepdrive.utilities import make_utility
from mo_deepdrive.world.actions import action_names
from mo_deepdrive.world.scenarios import SCENARIOS

BACKWARDS = np.array([0.0, -1.0, -1.0], dtype=np.float32)
STILL = np.array([0.0, 0.0, -1.0], dtype=np.float32)
FAST_LEFT = {
    "discrete": action_names("discrete").index("small steer left, increase speed"),
    "continuous": np.array([0.1, 1.0, -1.0], dtype=np.float32),
}


def make(scenario: str, version: int = 1, **arguments: Any) -> Any:
    name = f"mo-deepdrive-{scenario.replace('_', '-')}-v{version}"
    return gymnasium.make(name, disable_env_checker=True, **arguments).unwrapped


def drive(env: Any, action: Any, **options: Any) -> tuple[np.ndarray, str, int]:
    """The return of an episode of one action, why it ended, and its decisions."""
    env.reset(seed=0, options=options)
    total, over, decisions = np.zeros(env.reward_dim), False, 0
    while not over:
        _, reward, terminated, truncated, info = env.step(action)
        assert env.reward_space.contains(reward)
        total += reward
        decisions += 1
        over = terminated or truncated
    return total, info["end"], decisions


@pytest.mark.parametrize("scenario", [name for name, scenario in SCENARIOS.items() if len(scenario.ids) > 1])
def test_version_1_has_time_as_its_last_objective_in_every_interface(scenario: str) -> None:
    env_id = list(SCENARIOS[scenario].ids)[1]
    for env in (
        gymnasium.make(env_id).unwrapped,
        gymnasium.make_vec(env_id, num_envs=2),
        mo_deepdrive.parallel_env(scenario=scenario),
    ):
        assert env.objectives[-1] == "time"
        assert set(env.objectives) == {*SCENARIOS[scenario].objectives, "time"}
        assert env.config.charge_remaining_time
    first = SCENARIOS[scenario].id
    of_v0 = mo_deepdrive.parallel_env(**gymnasium.spec(first).kwargs)
    assert of_v0.config == gymnasium.make(first, disable_env_checker=True).unwrapped.config


@pytest.mark.parametrize(("version", "pays"), [(0, True), (1, False)])
def test_backing_out_of_the_left_turn_pays_only_where_the_rest_of_the_time_is_not_charged(
    version: int, pays: bool
) -> None:
    env = make("left_turn", version, action_type="continuous", objectives=["distance", "destination", "time"])
    utility = make_utility("linear", env.objectives, weights={"distance": 0.5, "destination": 10.0, "time": 0.5})
    backing, end, _ = drive(env, BACKWARDS)
    waiting, _, _ = drive(env, STILL)
    assert end == "backwards"
    assert bool(utility(backing) > utility(waiting)) is pays
    assert waiting[-1] == pytest.approx(-60.0)


def test_an_arrival_is_charged_the_time_that_it_took() -> None:
    env = make("one_waypoint", action_type="continuous")
    x, y, _ = SCENARIOS["one_waypoint"].routes[0].start
    total, end, decisions = drive(env, np.array([0.0, 0.3, -1.0]), destination=(x + 20.0, y))
    assert end == "arrived"
    assert total[-1] == pytest.approx(-0.1 * decisions)


@pytest.mark.parametrize("action_type", FAST_LEFT)
def test_late_actions_are_those_of_a_vehicle_that_idles_first(action_type: str) -> None:
    late = make("one_waypoint", action_type=action_type, action_delay=3)
    plain = make("one_waypoint", action_type=action_type)
    action, idle = FAST_LEFT[action_type], 0 if action_type == "discrete" else STILL
    for _ in range(2):  # nothing is on its way after a reset
        late.reset(seed=1)
        plain.reset(seed=1)
        for t in range(12):
            expected = plain.step(idle if t < 3 else action)
            found = late.step(action)
            np.testing.assert_array_equal(found[0], expected[0])
            np.testing.assert_array_equal(found[1], expected[1])
    assert found[0][11] > 0.5  # m/s


def test_with_more_yaw_friction_a_car_turns_further() -> None:
    turned = []
    for friction in (0.95, 0.96):
        env = make("one_waypoint", action_type="continuous", yaw_friction=friction)
        env.reset(seed=0)
        for _ in range(10):
            env.step(np.array([0.02, 0.5, -1.0]))
        turned.append(env.telemetry()[0]["heading"] - SCENARIOS["one_waypoint"].routes[0].start[2])
    assert turned[1] > 1.1 * turned[0] > 0.0


def test_cars_that_are_not_observed_look_absent() -> None:
    seen = [make("left_turn", observed_cars=cars, traffic="dense").reset(seed=0)[0][15:] for cars in (0, 1, 2)]
    absent = [100.0, 0.0]
    assert seen[0].tolist() == absent * 2
    assert seen[1].tolist() == [*seen[2][:2], *absent]
    assert seen[2][2:].tolist() != absent
