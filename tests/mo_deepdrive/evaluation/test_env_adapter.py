"""EnvAdapter: spaces of other libraries' environments in the trainers' shapes, names of objectives."""

from __future__ import annotations

import copy
import re
from typing import Any

import gymnasium
import mo_gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from mo_gymnasium.wrappers.vector import MOSyncVectorEnv

from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from tests.helpers.agents import ONE_WAYPOINT, SEA
from tests.helpers.toy_env import toy_worlds


def test_discrete_actions_begin_at_the_start_of_the_space() -> None:
    adapter = toy_worlds(spaces.Discrete(3, start=4))
    assert (adapter.actions, adapter.continuous) == (3, False)
    adapter.reset(0)
    step = adapter.step(np.array([[0], [2]]))
    assert step.rewards[:, 0, 0].tolist() == [4.0, 6.0]


def test_continuous_actions_are_clipped_and_scaled_to_the_box() -> None:
    box = spaces.Box(np.float32([2.0, -3.0]), np.float32([6.0, -1.0]))
    adapter = toy_worlds(box)
    assert (adapter.actions, adapter.continuous) == (2, True)
    adapter.reset(0)
    step = adapter.step(np.array([[[0.0, -1.0]], [[7.0, 0.5]]], dtype=np.float32))
    np.testing.assert_allclose(step.rewards[:, 0], [[4.0, -3.0], [6.0, -1.5]])


def test_observations_of_other_environments_are_flat_and_scaled_by_their_bounds() -> None:
    low = np.float32([[-2.0, 0.0], [-np.inf, 0.0]])
    adapter = toy_worlds(spaces.Discrete(2), spaces.Box(low, np.float32([[1.0, 5.0], [0.0, 1e9]])))
    assert adapter.observation_size == 4
    np.testing.assert_array_equal(adapter.observation_scales, [2.0, 5.0, 1.0, 1.0])
    observations = adapter.reset(0)
    assert observations.shape == (2, 1, 4)
    assert observations.dtype == np.float32
    assert adapter.objectives == ("objective_0", "objective_1")
    np.testing.assert_array_equal(adapter.objective_scales, [1.0, 1.0])


def test_discrete_observations_become_one_hot() -> None:
    adapter = toy_worlds(spaces.Discrete(2), spaces.Discrete(5, start=-1))
    assert adapter.observation_size == 5
    assert adapter.reset(0)[1, 0].tolist() == [1.0, 0.0, 0.0, 0.0, 0.0]
    step = adapter.step(np.zeros((2, 1), dtype=np.int64))
    assert step.observations[1, 0].tolist() == [0.0, 1.0, 0.0, 0.0, 0.0]


def test_success_and_end_are_read_from_the_info_of_other_environments() -> None:
    adapter = toy_worlds(spaces.Discrete(2))
    adapter.reset(0)
    steps = [adapter.step(np.zeros((2, 1), dtype=np.int64)) for _ in range(3)]
    assert [step.succeeded[:, 0].tolist() for step in steps] == [[False] * 2, [False] * 2, [True] * 2]
    assert steps[-1].ends is not None
    assert steps[-1].ends.tolist() == ["three", "three"]


@pytest.mark.parametrize(
    ("action_space", "observation_space", "message"),
    [
        (spaces.MultiDiscrete([2, 3]), None, "neither Discrete nor Box"),
        (spaces.Box(0.0, np.inf, (1,), dtype=np.float32), None, "must be bounded"),
        (spaces.Discrete(2), spaces.MultiDiscrete([2, 3]), "neither Box nor Discrete"),
    ],
)
def test_spaces_that_the_trainers_do_not_handle_are_refused(
    action_space: spaces.Space[Any], observation_space: spaces.Space[Any] | None, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        toy_worlds(action_space, observation_space)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
def test_native_environments_need_same_step_autoreset(mode: AutoresetMode) -> None:
    with pytest.raises(ValueError, match="SAME_STEP"):
        EnvAdapter(gymnasium.make_vec(ONE_WAYPOINT, num_envs=2, autoreset_mode=mode))


def test_the_vector_entry_point_of_another_library_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its rewards and autoreset are not known; copies of the single environment are."""
    spec = copy.deepcopy(gymnasium.spec(SEA))
    spec.id, spec.name, spec.vector_entry_point = "own-sea-v0", "own-sea", "own_package:OwnVectorEnv"
    monkeypatch.setitem(gymnasium.registry, spec.id, spec)
    env = make_env(spec.id, 2)
    assert isinstance(env, MOSyncVectorEnv)
    assert EnvAdapter(env).name == spec.id


class Named(gymnasium.Wrapper):
    def __init__(self, names: object):
        super().__init__(mo_gymnasium.make(SEA))
        self.objectives = names


def named(names: object) -> EnvAdapter:
    return EnvAdapter(MOSyncVectorEnv([lambda: gymnasium.wrappers.TimeLimit(Named(names), 5)] * 2))


@pytest.mark.parametrize(
    ("names", "objectives"),
    [
        (("treasure", "time"), ("treasure", "time")),
        (["treasure", "time"], ("treasure", "time")),
        (None, ("objective_0", "objective_1")),
        ("treasure, time", ("objective_0", "objective_1")),
    ],
)
def test_an_attribute_of_the_environment_that_is_a_list_names_its_objectives(names: Any, objectives: Any) -> None:
    adapter = named(names)
    assert (adapter.objectives, adapter.named) == (objectives, "treasure" in objectives)


@pytest.mark.parametrize("names", [("a",), ("a", "a"), ("a", 3), ("a", "b/c"), ["a", ["b"]]])
def test_names_that_are_not_one_per_objective_are_refused(names: Any) -> None:
    message = f"environment '{SEA}' has objectives = {names!r}; they must be 2 distinct names"
    with pytest.raises(ValueError, match=re.escape(message)):
        named(names)
