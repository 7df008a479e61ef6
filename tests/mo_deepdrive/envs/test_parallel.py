"""The PettingZoo environments: agents that leave or stay, and joint actions.

``test_interfaces.py`` tests what they have in common with the other interfaces.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from gymnasium.error import ResetNeeded

import mo_deepdrive
from tests.helpers.equality import assert_equal
from tests.helpers.interfaces import PLANS, record

AGENTS = ["vehicle_0", "vehicle_1"]
FINE = np.array([0.1, 0.5, -1.0], dtype=np.float32)


def drive_plan(plan: str, wrap: Callable[[Any], Any] = lambda env: env, **arguments: Any) -> tuple[Any, list[Any]]:
    """Replay a recorded episode (continuous actions): the environment, and the results of its steps."""
    recording = record("continuous", arguments.get("end_together", False))
    number = list(PLANS).index(plan)
    env = wrap(mo_deepdrive.parallel_env(**{**recording.arguments, **arguments}))
    env.reset(seed=7)
    for pins in recording.options[1 : number + 1]:  # an episode continues the random stream of those before it
        env.reset(options=pins)
    steps = []
    for joint in recording.actions[number]:
        steps.append(env.step({agent: joint[AGENTS.index(agent)] for agent in env.agents}))
    return env, steps


# -------------------------------------------------------------------------------------------------------- conformance


def test_the_state_is_the_last_observations_of_all_vehicles() -> None:
    for keep_finished in (False, True):
        env, steps = drive_plan("both arrive", keep_finished=keep_finished)
        env.reset(seed=0)
        last = env.reset(seed=7)[0]
        assert env.state().dtype == np.float32
        np.testing.assert_array_equal(env.state(), np.concatenate([last[agent] for agent in AGENTS]))
        joint_actions = record("continuous", False).actions[0]
        for joint, (observations, *_) in zip(joint_actions, steps, strict=True):
            env.step({agent: joint[AGENTS.index(agent)] for agent in env.agents})
            last = {**last, **observations}
            np.testing.assert_array_equal(env.state(), np.concatenate([last[agent] for agent in AGENTS]))
            assert env.state() in env.state_space
        assert env.state_space.shape == (58,)


# ------------------------------------------------------------------------------------------------- leaving and staying


@pytest.mark.parametrize(("plan", "first"), [("both arrive", 1), ("the left turn fails", 0)])
def test_a_vehicle_that_has_ended_leaves_and_the_other_continues(plan: str, first: int) -> None:
    env, steps = drive_plan(plan)
    leaves, stays = AGENTS[first], AGENTS[1 - first]
    at = next(k for k, (*_, infos) in enumerate(steps) if infos.get(leaves))
    assert at < len(steps) - 1
    for k, (observations, rewards, terminated, truncated, infos) in enumerate(steps):
        present = {leaves, stays} if k <= at else {stays}
        assert observations.keys() == rewards.keys() == terminated.keys() == truncated.keys() == infos.keys() == present
        assert not any(truncated.values())
        assert terminated[stays] == (k == len(steps) - 1)
        if k <= at:
            assert terminated[leaves] == (k == at)
    for agent, infos in ((leaves, steps[at][4]), (stays, steps[-1][4])):
        end = PLANS[plan].ends[AGENTS.index(agent)]
        assert infos[agent] == {"end": end, "success": end == "arrived"}
    assert env.agents == []


def test_with_keep_finished_the_flags_are_false_until_the_last_step() -> None:
    env, steps = drive_plan("one arrives, one stays", keep_finished=True)
    assert len(steps) == 600
    ends = [[infos[agent] for *_, infos in steps if infos[agent]] for agent in AGENTS]
    assert ends == [[{"end": "arrived", "success": True}], [{"end": "time_limit", "success": False}]]
    for _, _, terminated, truncated, _ in steps[:-1]:
        assert terminated == truncated == dict.fromkeys(AGENTS, False)
    assert steps[-1][2] == {"vehicle_0": True, "vehicle_1": False}
    assert steps[-1][3] == {"vehicle_0": False, "vehicle_1": True}
    assert env.agents == []


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
    for action, message in ((FINE * math.nan, "of vehicle_0 is not allowed"), (None, "of vehicle_0 has shape")):
        with pytest.raises(ValueError, match=message):
            env.step(action)
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
    from mo_deepdrive import parallel_v0

    assert parallel_v0.parallel_env(time_limit=3.0).config == mo_deepdrive.parallel_env(time_limit=3.0).config


# ------------------------------------------------------------------------------------------- without MOMAland, and docs


@pytest.mark.slow
def test_only_the_aec_environment_needs_momaland(run_python: Any) -> None:
    printed = run_python(
        "import sys\n"
        "sys.modules['momaland'] = None\n"
        "import mo_deepdrive\n"
        "mo_deepdrive.parallel_env().reset(seed=0)\n"
        "try:\n"
        "    mo_deepdrive.env()\n"
        "except ImportError as error:\n"
        "    print(error)"
    )
    assert printed.strip() == "the AEC environment needs momaland: pip install 'mo-deepdrive[momaland]'"


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
