"""The PettingZoo environments: the state, and joint actions while agents leave or stay.

``test_interfaces.py`` tests what they have in common with the other interfaces.
"""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest
from gymnasium.error import ResetNeeded

import mo_deepdrive
from tests.helpers.equality import assert_equal
from tests.helpers.interfaces import record

AGENTS = ["vehicle_0", "vehicle_1"]
FINE = np.array([0.1, 0.5, -1.0], dtype=np.float32)


@pytest.mark.parametrize("keep_finished", [False, True])
def test_the_state_is_the_last_observations_of_all_vehicles(keep_finished: bool) -> None:
    recording = record("continuous", False)
    env = mo_deepdrive.parallel_env(keep_finished=keep_finished, **recording.arguments)
    assert env.state_space.shape == (58,)
    last = env.reset(seed=7)[0]
    for joint in recording.actions[0]:  # both arrive, one after the other
        np.testing.assert_array_equal(env.state(), np.concatenate([last[agent] for agent in AGENTS]))
        last |= env.step({agent: joint[AGENTS.index(agent)] for agent in env.agents})[0]
        assert env.state() in env.state_space
    np.testing.assert_array_equal(env.state(), np.concatenate([last[agent] for agent in AGENTS]))


# ---------------------------------------------------------------------------------------------------------- bad input


def assert_refuses(env: Any, actions: Any, message: str) -> None:
    """A step with ``actions`` is refused and changes nothing."""
    before = copy.deepcopy(env)
    with pytest.raises(ValueError, match=message):
        env.step(actions)
    joint = {agent: record("continuous", False).actions[0][0][0] for agent in env.agents}
    assert_equal(env.step(joint), before.step(joint))
    assert_equal(env.reset(), before.reset())


BAD_JOINT_ACTIONS = {
    "an agent is missing": (
        {"vehicle_0": FINE},
        r"are missing for \['vehicle_1'\]; expected one for each of .*vehicle_0.*vehicle_1",
    ),
    "an additional agent": (
        dict.fromkeys((*AGENTS, "vehicle_2"), FINE),
        r"are given for \['vehicle_2'\]; expected one for each",
    ),
    "agents by number": (
        {0: FINE, 1: FINE},
        r"are missing for \['vehicle_0', 'vehicle_1'\] and are given for \[0, 1\]",
    ),
    "not a dict": ([3, 3], r"\[3, 3\] must be a dict"),
    "a ragged list": ({"vehicle_0": [[1], [1, 2]], "vehicle_1": FINE}, "of vehicle_0 is not an array"),
}


@pytest.mark.parametrize("what", BAD_JOINT_ACTIONS)
def test_bad_joint_actions_are_refused(what: str) -> None:
    actions, message = BAD_JOINT_ACTIONS[what]
    env = mo_deepdrive.parallel_env(action_type="continuous")
    env.reset(seed=0)
    assert_refuses(env, actions, message)


def halfway(keep_finished: bool) -> Any:
    """An environment in which vehicle 1 has arrived and vehicle 0 still drives."""
    recording = record("continuous", False)
    env = mo_deepdrive.parallel_env(keep_finished=keep_finished, **recording.arguments)
    env.reset(seed=7)
    infos: dict[str, Any] = {"vehicle_1": {}}
    for joint in recording.actions[0]:
        if infos["vehicle_1"]:
            break
        infos = env.step(dict(zip(AGENTS, joint, strict=True)))[4]
    assert infos["vehicle_1"]["end"] == "arrived"
    return env


def test_an_action_for_a_vehicle_that_has_left_is_refused() -> None:
    env = halfway(keep_finished=False)
    assert env.agents == ["vehicle_0"]
    assert_refuses(env, dict.fromkeys(AGENTS, FINE), r"are given for \['vehicle_1'\]; expected one .* \['vehicle_0'\]")


def test_the_action_of_a_kept_vehicle_is_required_and_checked_but_ignored() -> None:
    env = halfway(keep_finished=True)
    assert env.agents == AGENTS
    assert_refuses(halfway(keep_finished=True), {"vehicle_0": FINE}, r"are missing for \['vehicle_1'\]")
    assert_refuses(halfway(keep_finished=True), {"vehicle_0": FINE, "vehicle_1": FINE * math.nan}, "of vehicle_1")
    other = copy.deepcopy(env)
    env.step({"vehicle_0": FINE, "vehicle_1": FINE})
    other.step({"vehicle_0": FINE, "vehicle_1": -FINE})
    assert env.batch.state.tobytes() == other.batch.state.tobytes()


def test_the_aec_environment_refuses_an_invalid_action_at_once() -> None:
    recording = record("continuous", False)
    env = mo_deepdrive.env(**recording.arguments)
    with pytest.raises(ResetNeeded):
        env.step(FINE)
    env.reset(seed=7)
    refused = 0
    taken = dict.fromkeys(AGENTS, 0)
    for agent in env.agent_iter():
        _, _, terminated, truncated, _ = env.last()
        if terminated or truncated:
            with pytest.raises(ValueError, match=f"{agent}, which has ended, must be None"):
                env.step(FINE)
            refused += 1
            env.step(None)
        else:
            env.step(recording.actions[0][taken[agent]][AGENTS.index(agent)])
            taken[agent] += 1
    assert refused == 2
    assert taken["vehicle_0"] == len(recording.actions[0])
    with pytest.raises(ResetNeeded):
        env.step(FINE)


def test_the_environments_can_be_made_by_the_name_of_their_version() -> None:
    from mo_deepdrive import parallel_v1

    assert parallel_v1.parallel_env(time_limit=3.0).config == mo_deepdrive.parallel_env(time_limit=3.0).config


def test_the_environments_render() -> None:
    for make in (mo_deepdrive.parallel_env, mo_deepdrive.env):
        env = make(render_mode="rgb_array")
        env.reset(seed=0)
        frame = env.render()
        assert frame.dtype == np.uint8
        assert frame.std() > 10
        env.close()
        env.close()
        assert make().render() is None
