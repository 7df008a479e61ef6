"""Our environment without its Gymnasium interface: what the adapter gives is what it would give with it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium.vector import VectorWrapper

from mo_deepdrive.envs.vector import DrivingVectorEnv
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, Step, make_env
from tests.helpers.agents import CONTINUOUS, INTERSECTION, LEFT_TURN, ONE_WAYPOINT

N = 6


class Unchanged(VectorWrapper):
    """A wrapper that changes nothing, but whose steps have to be taken."""


class Subclass(DrivingVectorEnv):
    """Also an environment whose own step may do more."""


@pytest.mark.parametrize(
    ("env_id", "arguments"),
    [
        (ONE_WAYPOINT, {"time_limit": 1.0}),
        (ONE_WAYPOINT, {"time_limit": 1.0, **CONTINUOUS}),
        (INTERSECTION, {"time_limit": 1.0}),
        (INTERSECTION, {"time_limit": 1.0, "end_together": True}),
        (LEFT_TURN, {"time_limit": 1.0}),
    ],
)
def test_a_step_is_that_of_the_environment_behind_a_wrapper(env_id: str, arguments: dict[str, Any]) -> None:
    bare, wrapped = EnvAdapter(make_env(env_id, N, arguments)), EnvAdapter(Unchanged(make_env(env_id, N, arguments)))
    assert bare.bare is not None
    assert wrapped.bare is None
    np.testing.assert_array_equal(bare.reset(3), wrapped.reset(3))
    rng, ended = np.random.default_rng(0), 0
    for _ in range(60):
        shape = (N, bare.vehicles)
        actions = (
            rng.normal(0.0, 1.5, (*shape, bare.actions)).astype(np.float32)
            if bare.continuous
            else rng.integers(0, bare.actions, shape)
        )
        one, other = bare.step(actions), wrapped.step(actions)
        over = (one.terminated | one.truncated).any(axis=1)
        ended += int(over.sum())
        for name, found, wanted in zip(Step._fields, one, other, strict=True):
            if name == "ends":  # named where an episode is over
                if wanted is not None:
                    said = np.array([end is not None for end in wanted.reshape(-1)])
                    np.testing.assert_array_equal(found.reshape(-1)[said], wanted.reshape(-1)[said])
                continue
            np.testing.assert_array_equal(found, wanted, err_msg=name)
    assert ended > N


def test_a_subclass_is_not_bare() -> None:
    env = Subclass(2, scenario="one_waypoint", autoreset_mode="SameStep")
    assert EnvAdapter(env).bare is None


def test_no_later_step_overwrites_what_a_step_gave() -> None:
    env = make_env(ONE_WAYPOINT, N, {"time_limit": 1.0}).unwrapped
    env.reset(seed=0)
    taken = [env.advance(np.full((N, 1), 3)) for _ in range(12)]
    saved = [{name: array.copy() for name, array in each._asdict().items()} for each in taken]
    for _ in range(12):
        env.advance(np.full((N, 1), 5))
    for each, copies in zip(taken, saved, strict=True):
        for name, array in each._asdict().items():
            np.testing.assert_array_equal(array, copies[name])
