"""NumPy's numbers are as good as Python's, and what is no number is refused by name."""

from __future__ import annotations

import dataclasses
from typing import Any

import gymnasium
import numpy as np
import pytest

import mo_deepdrive
from algorithms.a2c import A2C
from mo_deepdrive.utilities import make_utility
from mo_deepdrive.world.config import parse
from mo_deepdrive.world.objectives import Objective, register_objective
from mo_deepdrive.world.scenarios import SCENARIOS, register_scenario

LEFT_TURN = SCENARIOS["left_turn"].id
HUGE = 10**400
NO_NUMBERS = (HUGE, np.inf, np.nan, True, np.True_, "1")


def test_numpys_numbers_and_arrays_are_taken_as_arguments() -> None:
    env = gymnasium.make(
        LEFT_TURN,
        decision_frequency=np.int64(5),
        time_limit=np.float32(3.0),
        harmful_g_force=np.array(2.0),
        constrain_controls=np.True_,
        objectives=np.array(["distance", "jerk"]),
    )
    config: Any = env.unwrapped.config  # type: ignore[attr-defined]
    assert (config.decision_frequency, config.time_limit, config.harmful_g_force) == (5, 3.0, 2.0)
    assert (config.constrain_controls, config.objectives) == (True, ("distance", "jerk"))
    env.reset(seed=np.uint8(3), options={"cars": np.int8(2), "headways": np.array([3.0, 4.0], dtype=np.float32)})
    assert mo_deepdrive.parallel_env(keep_finished=np.True_).keep_finished is True
    given = {"learning_rate": np.float64(0.1), "hidden": np.array([8, 4])}
    assert parse(A2C.Config, given, "settings") == A2C.Config(learning_rate=0.1, hidden=(8, 4))
    two = SCENARIOS["one_waypoint"]
    register_scenario(dataclasses.replace(two, lanes=np.False_, obstacles=np.int64(0), cars=np.uint8(0)))


@pytest.mark.parametrize("value", NO_NUMBERS)
@pytest.mark.parametrize(
    ("name", "form"),
    [
        ("start", lambda value: (value, 1.0, 0.0)),
        ("destination", lambda value: [1.0, value]),
        ("headways", lambda value: [value]),
        ("cars", lambda value: value),
    ],
)
def test_reset_options_that_are_no_numbers_are_refused_by_name(name: str, form: Any, value: Any) -> None:
    env = gymnasium.make(LEFT_TURN)
    with pytest.raises(ValueError, match=f"reset option '{name}'"):
        env.reset(seed=0, options={name: form(value)})


@pytest.mark.parametrize("value", NO_NUMBERS)
def test_what_is_no_number_is_refused_wherever_one_is_needed(value: Any) -> None:
    row = Objective(
        "no_number", "1", 1, 1.0, "what is registered here", bound=1.0, measure=lambda vehicles, v, params: 1.0
    )
    for field in ("sign", "scale", "bound", "reference"):
        with pytest.raises(ValueError, match=f"{field} ="):
            register_objective(dataclasses.replace(row, **{field: value}))
    with pytest.raises(ValueError, match="time_limit"):
        gymnasium.make(LEFT_TURN, time_limit=value)
    with pytest.raises(ValueError, match="weights"):
        make_utility("linear", ("distance",), weights=[value])
    with pytest.raises(ValueError, match="rho"):
        make_utility("augmented_chebyshev", ("distance",), weights=[1], ideal=[1], rho=value)
    if value is not HUGE:
        with pytest.raises(ValueError, match=r"seed = .* must be None or a non-negative integer"):
            gymnasium.make(LEFT_TURN).unwrapped.reset(seed=value)


@pytest.mark.parametrize("value", [np.uint64(2**64 - 1), np.int8(-1), np.uint8(22)])
def test_an_action_of_any_integer_type_is_reported_as_it_was_given(value: Any) -> None:
    envs = gymnasium.make_vec(LEFT_TURN, num_envs=2)
    envs.reset(seed=0)
    fine = value.dtype.type(21)
    envs.step(np.array([fine, fine]))
    with pytest.raises(ValueError, match=rf"action \[{value}\] of world 1 is not allowed"):
        envs.step(np.array([fine, value]))
