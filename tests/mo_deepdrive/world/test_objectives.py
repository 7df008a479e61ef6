"""Objectives that are registered from outside: measured by a function, in every scenario and through every API."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import replace
from types import ModuleType
from typing import Any

import numba
import numpy as np
import pytest

from mo_deepdrive import Objective, register_objective
from mo_deepdrive.world.config import EnvConfig
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES, scales

SCENARIOS = ("one_waypoint", "static_obstacle", "intersection", "left_turn")


@pytest.fixture
def effort(examples: None) -> ModuleType:
    """The example of the documentation."""
    return importlib.import_module("effort")


def gap(vehicles: Any, v: int, params: Any) -> float:
    """Distance between the centres of the two vehicles."""
    own, other = vehicles[v], vehicles[1 - v]
    return ((own.x - other.x) ** 2 + (own.y - other.y) ** 2) ** 0.5


def row(**changes: Any) -> Objective:
    fields = {"name": "gap", "unit": "m", "sign": 1, "scale": 10.0, "description": "distance between the vehicles"}
    return Objective(**{**fields, "bound": 300.0, "measure": gap, **changes})


def spent(vehicle: Any, seconds: float = 0.1) -> float:
    """The effort of the last decision, from the dtype's fields."""
    distance = abs(vehicle["speed"] + vehicle["previous_speed"]) / 2 * seconds
    return float(abs(vehicle["throttle"]) * distance)


def actions(env: Any, steps: int, seed: int = 0) -> list[np.ndarray]:
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(steps)]


# ------------------------------------------------------------------------------------------------------------- rewards


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_a_registered_objective_is_a_column_of_the_reward_and_changes_no_other(
    effort: ModuleType, make_vector: Callable[..., Any], scenario: str, mode: str
) -> None:
    options = {"autoreset_mode": mode, "time_limit": 3.0}
    with_it = make_vector(scenario, 8, objectives=["distance", "effort", "jerk"], **options)
    without = make_vector(scenario, 8, objectives=["distance", "jerk"], **options)
    with_it.reset(seed=3)
    without.reset(seed=3)
    positive = 0
    for action in actions(with_it, 80):
        before = with_it.batch.state.copy()
        _, rewards, *_ = with_it.step(action)
        _, expected, *_ = without.step(action)
        np.testing.assert_array_equal(rewards[..., [0, 2]], expected)
        assert with_it.batch.state.tobytes() == without.batch.state.tobytes()
        assert with_it.reward_space.contains(rewards[0])
        column = rewards[..., 1].reshape(8, -1)
        for i, v in np.ndindex(column.shape):
            if before["end"][i, v]:
                assert column[i, v] == 0.0, "it had ended before"
            elif with_it.batch.state["decisions"][i, v]:  # it has not been placed since
                assert column[i, v] == np.float32(-spent(with_it.batch.state[i, v]))
                positive += column[i, v] < 0.0
    assert positive > 100


@pytest.mark.slow
def test_a_measure_sees_all_vehicles_of_its_world(registries: None, make_vector: Any) -> None:
    register_objective(row())
    env = make_vector("intersection", 4, objectives=["gap"], threads=2)
    env.reset(seed=1)
    for action in actions(env, 5):
        rewards = env.step(action)[1]
        x, y = env.batch.state["x"], env.batch.state["y"]
        between = np.hypot(x[:, 0] - x[:, 1], y[:, 0] - y[:, 1])
        np.testing.assert_allclose(rewards[..., 0], np.stack([between, between], axis=1), rtol=1e-6)
    assert scales(("gap", "jerk")).tolist() == [10.0, 500.0]


@pytest.mark.slow
def test_a_compiled_measure_and_a_signed_one_are_fine(registries: None, make_vector: Any) -> None:
    @numba.njit
    def climb(vehicles: Any, v: int, params: Any) -> float:
        return vehicles[v].vy * params.dt  # type: ignore[no-any-return]

    register_objective(
        row(name="climb", bound=lambda config: 200.0 / config.simulation_frequency, measure=climb, signed=True)
    )
    env = make_vector("one_waypoint", 1, objectives=["climb"])
    env.reset(seed=0)
    for action in actions(env, 20):
        rewards = env.step(action)[1]
        np.testing.assert_allclose(rewards[0, 0], env.batch.state[0, 0].vy / 60, rtol=1e-6)
    np.testing.assert_allclose([*env.reward_space.low, *env.reward_space.high], [-200 / 60, 200 / 60], rtol=1e-6)


# -------------------------------------------------------------------------------------------------------- registration


def test_registering_the_same_objective_again_changes_nothing(effort: ModuleType) -> None:
    before = list(OBJECTIVES)
    importlib.reload(effort)
    assert before == OBJECTIVES
    assert OBJECTIVES[INDEX["effort"]].unit == "J/kg"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "Time to X"}, "objective name = 'Time to X' must be lower case letters, digits and underscores"),
        ({"sign": 0}, "objective 'gap': sign = 0 must be +1 (more is better) or -1 (a cost)"),
        ({"scale": 0.0}, "objective 'gap': scale = 0.0 must be a positive number"),
        ({"bound": float("inf")}, "objective 'gap': bound = inf must be a positive number or a function"),
        ({"bound": "g"}, "objective 'gap': bound = 'g' must be a positive number or a function"),
        ({"reference": float("nan")}, "objective 'gap': reference = nan must be a finite number or None"),
        ({"measure": None}, "objective 'gap': measure = None must be a function of (vehicles, v, params)"),
        ({"measure": spent}, "must be a function of (vehicles, v, params)"),
        ({"name": "jerk"}, "objective 'jerk' is registered already, with other fields; choose another name"),
    ],
)
def test_an_invalid_objective_is_refused_in_one_line(registries: None, changes: dict[str, Any], message: str) -> None:
    before = list(OBJECTIVES)
    with pytest.raises(ValueError, match=r"^[^\n]+$") as caught:
        register_objective(row(**changes))
    assert message in str(caught.value)
    assert before == OBJECTIVES


def test_a_measure_that_cannot_be_compiled_is_refused_when_the_environment_is_made(
    registries: None, make_single: Any
) -> None:
    register_objective(row(measure=lambda vehicles, v, params: vehicles[v].velocity))
    with pytest.raises(
        ValueError, match=r"^objective 'gap': its measure cannot be compiled: [^\n]*'velocity'"
    ) as caught:
        make_single("intersection", objectives=["gap"])
    assert len(str(caught.value)) < 400


def test_a_bound_that_is_no_number_is_refused_when_the_environment_is_made(registries: None, make_single: Any) -> None:
    register_objective(row(bound=lambda config: -config.time_limit))
    with pytest.raises(ValueError, match=r"^objective 'gap': its bound is -60.0; it must be a positive number$"):
        make_single("intersection", objectives=["gap"])


def test_objectives_of_the_kernel_need_a_scenario_that_has_them(effort: ModuleType, make_single: Any) -> None:
    message = "objectives has 'collision', which OneWaypoint does not have; .*known: destination, distance, effort"
    with pytest.raises(ValueError, match=message):
        make_single("one_waypoint", objectives=["effort", "collision"])
    with pytest.raises(ValueError, match="objectives has 'effrot'; did you mean 'effort'"):
        EnvConfig(scenario="one_waypoint", objectives=("effrot",))


# ------------------------------------------------------------------------------------------------------------ measures


@pytest.mark.slow
def test_a_row_may_be_copied(registries: None, make_vector: Any) -> None:
    register_objective(row())
    register_objective(replace(OBJECTIVES[INDEX["gap"]], name="room", sign=-1))
    env = make_vector("intersection", 1, objectives=["gap", "room"])
    env.reset(seed=0)
    rewards = env.step(np.zeros((1, 2), dtype=np.int64))[1]
    np.testing.assert_array_equal(rewards[..., 0], -rewards[..., 1])
