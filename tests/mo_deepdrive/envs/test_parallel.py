"""The PettingZoo environments: conformance with PettingZoo and MOMAland, agents that leave or stay, invalid input.

``test_interfaces.py`` compares their trajectories with those of the other interfaces.
"""

from __future__ import annotations

import copy
import itertools
import math
import pickle
import re
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from momaland.test.api_test import api_test
from momaland.utils.parallel_wrappers import (
    CentraliseAgent,
    LinearizeReward,
    NormalizeReward,
    RecordEpisodeStatistics,
)
from pettingzoo.test import parallel_api_test, parallel_seed_test, seed_test

import mo_deepdrive
from mo_deepdrive.objectives import INDEX
from tests.helpers.interfaces import ACTION_TYPES, PLANS, record

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

AGENTS = ["vehicle_0", "vehicle_1"]
EVERY = [
    {"action_type": action_type, "end_together": end_together}
    for action_type in ACTION_TYPES
    for end_together in (False, True)
]
OBJECTIVES = ("distance", "destination", "g_force", "collision", "jerk", "lane_violation")


def name_of(arguments: dict[str, Any]) -> str:
    return "-".join(str(value) for value in arguments.values())


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


def assert_same_steps(env: Any, other: Any) -> None:
    """Both continue in the same way, so nothing changed one of them."""
    for agent in env.agents:
        env.action_space(agent).seed(1)
    actions = {agent: env.action_space(agent).sample() for agent in env.agents}
    for one, two in zip(env.step(actions), other.step(actions), strict=True):
        assert one.keys() == two.keys()
        for agent in one:
            np.testing.assert_array_equal(one[agent], two[agent])
    assert env.batch.state.tobytes() == other.batch.state.tobytes()
    first, second = env.reset()[0], other.reset()[0]
    for agent in AGENTS:
        np.testing.assert_array_equal(first[agent], second[agent])


# -------------------------------------------------------------------------------------------------------- conformance


@pytest.mark.parametrize("keep_finished", [False, True])
@pytest.mark.parametrize("arguments", EVERY, ids=name_of)
def test_pettingzoos_tests_of_parallel_environments_pass(arguments: dict[str, Any], keep_finished: bool) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message="unknown reset option 'options' is ignored")
        parallel_api_test(mo_deepdrive.parallel_env(keep_finished=keep_finished, **arguments), num_cycles=700)
        parallel_seed_test(lambda: mo_deepdrive.parallel_env(keep_finished=keep_finished, **arguments), num_cycles=50)


@pytest.mark.slow
@pytest.mark.parametrize("keep_finished", [False, True])
@pytest.mark.parametrize("arguments", EVERY, ids=name_of)
def test_momalands_tests_of_aec_environments_pass(arguments: dict[str, Any], keep_finished: bool) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message="unknown reset option 'options' is ignored")
        api_test(mo_deepdrive.env(keep_finished=keep_finished, **arguments), num_cycles=700)
        seed_test(lambda: mo_deepdrive.env(keep_finished=keep_finished, **arguments), num_cycles=50)


@pytest.mark.parametrize("scenario", ["one_waypoint", "static_obstacle", "left_turn"])
def test_the_other_scenarios_have_one_agent(scenario: str) -> None:
    env = mo_deepdrive.parallel_env(scenario=scenario)
    assert env.possible_agents == ["vehicle_0"]
    assert str(env) == env.metadata["name"] == f"mo_deepdrive_{scenario}_v0"
    with pytest.warns(UserWarning, match="unknown reset option 'options'"):
        parallel_api_test(env)
    with pytest.warns(UserWarning, match="unknown reset option 'options'"):
        api_test(mo_deepdrive.env(scenario=scenario))


def test_agents_spaces_and_metadata_are_those_of_the_documentation() -> None:
    env = mo_deepdrive.parallel_env(decision_frequency=20)
    assert env.possible_agents == AGENTS
    assert env.agents == []
    env.reset(seed=0)
    assert env.agents == AGENTS
    assert env.metadata["name"] == "mo_deepdrive_intersection_v0"
    assert env.metadata["is_parallelizable"]
    assert env.metadata["render_modes"] == ["rgb_array", "human"]
    env.metadata["render_modes"].append("ansi")  # as some of PettingZoo's wrappers do
    assert mo_deepdrive.parallel_env().metadata["render_modes"] == ["rgb_array", "human"]
    assert env.metadata["render_fps"] == 20
    assert env.objectives == OBJECTIVES
    assert env.reward_dim == 6
    for agent in AGENTS:
        assert env.observation_space(agent) is env.observation_space(agent) is env.observation_spaces[agent]
        assert env.action_space(agent) is env.action_space(agent) is env.action_spaces[agent]
        assert env.reward_space(agent) is env.reward_space(agent) is env.reward_spaces[agent]
        assert env.observation_space(agent).shape == (29,)
        assert env.reward_space(agent).shape == (6,)
    assert env.action_space(AGENTS[0]) is not env.action_space(AGENTS[1]), "each has its own random stream"
    assert type(mo_deepdrive.raw_env()) is type(env)
    aec = mo_deepdrive.env(decision_frequency=20)
    assert aec.possible_agents == AGENTS
    assert aec.reward_space(AGENTS[0]) == env.reward_space(AGENTS[0])
    assert aec.reward_spaces == env.reward_spaces


@pytest.mark.parametrize("action_type", ACTION_TYPES)
def test_results_are_in_their_spaces_and_may_be_changed_by_the_caller(action_type: str) -> None:
    env, modified = (mo_deepdrive.parallel_env(action_type=action_type) for _ in range(2))
    kept = list(env.reset(seed=0)[0].values())
    for observation in modified.reset(seed=0)[0].values():
        observation[:] = np.nan
    modified.agents.clear()
    modified.reset(seed=0)
    while env.agents:
        actions = {agent: env.action_space(agent).sample() for agent in env.agents}
        steps, other = env.step(actions), modified.step(actions)
        for agent in actions:
            observation, reward, terminated, truncated, info = (each[agent] for each in steps)
            assert observation in env.observation_space(agent)
            assert reward in env.reward_space(agent)
            assert type(terminated) is type(truncated) is bool
            assert info.keys() == ({"end", "success"} if terminated or truncated else set())
            for array in (other[0][agent], other[1][agent]):
                array[:] = np.nan
            kept += [observation, reward]
            np.testing.assert_array_equal(env.state(), modified.state())
    assert not any(np.shares_memory(one, two) for one, two in itertools.combinations(kept[-40:], 2))
    assert all(np.isfinite(array).all() for array in kept)


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


def test_rewards_have_the_selected_objectives() -> None:
    full, some = (mo_deepdrive.parallel_env(objectives=names) for names in (None, ("jerk", "distance")))
    assert some.reward_dim == 2
    full.reset(seed=0)
    some.reset(seed=0)
    for _ in range(10):
        everything = full.step(dict.fromkeys(AGENTS, 3))[1]
        for agent, reward in some.step(dict.fromkeys(AGENTS, 3))[1].items():
            np.testing.assert_array_equal(reward, everything[agent][[INDEX["jerk"], INDEX["distance"]]])


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("make", [mo_deepdrive.parallel_env, mo_deepdrive.env])
def test_a_copy_continues_exactly_from_the_state_of_the_original(make: Any, copied: Any) -> None:
    env = make(render_mode="rgb_array")
    env.reset(seed=0)
    env.render()
    steps = []
    for one in (copied(env), env):
        if make is mo_deepdrive.env:
            for _ in range(9):
                one.step(3)
            steps.append(one.last()[:2])
        else:
            steps.append([one.step(dict.fromkeys(AGENTS, 3))[k]["vehicle_1"] for k in (0, 1)])
        one.reset()
        steps[-1] += type(steps[-1])([one.state()])
        assert one.render().shape == env.render().shape
    for mine, copys in zip(*steps, strict=True):
        np.testing.assert_array_equal(mine, copys)
    env.close()


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


# ----------------------------------------------------------------------------------------------- MOMAland's wrappers


@pytest.mark.parametrize("keep_finished", [False, True])
def test_momalands_linear_reward_is_the_weighted_sum(keep_finished: bool) -> None:
    weights = {agent: np.arange(1.0, 7.0) * (v + 1) for v, agent in enumerate(AGENTS)}
    _, steps = drive_plan("both arrive", lambda env: LinearizeReward(env, weights), keep_finished=keep_finished)
    _, vectors = drive_plan("both arrive", keep_finished=keep_finished)
    for (_, rewards, *_), (_, expected, *_) in zip(steps, vectors, strict=True):
        assert rewards.keys() == expected.keys()
        for agent, reward in rewards.items():
            assert reward == pytest.approx(float(weights[agent] @ expected[agent]))


def test_momalands_normalised_reward_rescales_one_objective_of_one_agent() -> None:
    def wrap(env: Any) -> Any:
        return NormalizeReward(env, "vehicle_0", INDEX["distance"])

    _, steps = drive_plan("both arrive", wrap, keep_finished=True)
    _, vectors = drive_plan("both arrive", keep_finished=True)
    ours, plain = (np.array([rewards["vehicle_0"] for _, rewards, *_ in each]) for each in (steps, vectors))
    others = np.arange(len(OBJECTIVES)) != INDEX["distance"]
    np.testing.assert_array_equal(ours[:, others], plain[:, others])
    moved = plain[:, INDEX["distance"]] != 0.0
    ratios = ours[moved, INDEX["distance"]] / plain[moved, INDEX["distance"]]
    assert np.isfinite(ours).all()
    assert len(np.unique(ratios.round(3))) > 5


@pytest.mark.parametrize("end_together", [False, True])
def test_momalands_episode_statistics_are_right_with_keep_finished(end_together: bool) -> None:
    _, steps = drive_plan("both arrive", RecordEpisodeStatistics, keep_finished=True, end_together=end_together)
    _, vectors = drive_plan("both arrive", end_together=end_together)
    assert not any("episode" in infos for *_, infos in steps[:-1])
    statistics = steps[-1][4]["episode"]
    for agent in AGENTS:
        assert statistics["l"][agent] == len(steps)
        total = np.sum([rewards[agent] for _, rewards, *_ in vectors if agent in rewards], axis=0, dtype=np.float64)
        np.testing.assert_allclose(statistics["r"][agent], total, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("action_type", ACTION_TYPES)
def test_momalands_central_agent_drives_both_vehicles_with_keep_finished(action_type: str) -> None:
    recording = record(action_type, False)
    plain = mo_deepdrive.parallel_env(keep_finished=True, action_type=action_type)
    env = CentraliseAgent(mo_deepdrive.parallel_env(keep_finished=True, action_type=action_type))
    plain.reset(seed=7)
    observation, _ = env.reset(seed=7)
    assert observation in env.observation_space
    for joint in recording.actions[0]:
        assert np.reshape(joint, env.action_space.shape).astype(env.action_space.dtype) in env.action_space
        observation, reward, terminated, truncated, _ = env.step(joint.ravel())
        _, rewards, *_ = plain.step(dict(zip(AGENTS, joint, strict=True)))
        np.testing.assert_array_equal(observation, plain.state())
        assert observation in env.observation_space
        np.testing.assert_allclose(reward, rewards["vehicle_0"] + rewards["vehicle_1"], rtol=1e-6)
        assert terminated == (not plain.agents)
        assert not truncated
    assert plain.agents == []


# ---------------------------------------------------------------------------------------------------------- bad input


def assert_refuses(env: Any, actions: Any, message: str) -> None:
    """A step with ``actions`` is refused and changes nothing."""
    before = copy.deepcopy(env)
    with pytest.raises(ValueError, match=message):
        env.step(actions)
    assert env.agents == before.agents
    assert_same_steps(env, before)


@pytest.mark.parametrize("seed", [1.5, "a", -1, True])
@pytest.mark.parametrize("make", [mo_deepdrive.parallel_env, mo_deepdrive.env])
def test_a_bad_seed_is_refused(make: Callable[[], Any], seed: Any) -> None:
    env = make()
    env.reset(seed=0)
    before = env.unwrapped.state().tobytes()
    with pytest.raises(ValueError, match=f"^{re.escape(f'seed = {seed!r} must be None or a non-negative integer')}$"):
        env.reset(seed=seed)
    assert env.unwrapped.state().tobytes() == before


BAD_DISCRETE = {
    "an agent is missing": (
        {"vehicle_0": 3},
        r"are missing for \['vehicle_1'\]; expected one for each of .*vehicle_0.*vehicle_1",
    ),
    "no agents": ({}, r"are missing for \['vehicle_0', 'vehicle_1'\]"),
    "an additional agent": (
        {"vehicle_0": 3, "vehicle_1": 3, "vehicle_2": 3},
        r"are given for \['vehicle_2'\]; expected one for each",
    ),
    "agents by number": ({0: 3, 1: 3}, r"are missing for \['vehicle_0', 'vehicle_1'\] and are given for \[0, 1\]"),
    "not a dict": ([3, 3], r"\[3, 3\] must be a dict"),
    "an action that is too large": ({"vehicle_0": 3, "vehicle_1": 22}, r"22 of vehicle_1 .*integers in \[0, 22\)"),
    "a negative action": ({"vehicle_0": -1, "vehicle_1": 3}, "-1 of vehicle_0 is not allowed"),
    "a float": ({"vehicle_0": 3.0, "vehicle_1": 3}, "of vehicle_0 has dtype float64"),
    "a bool": ({"vehicle_0": 3, "vehicle_1": True}, "of vehicle_1 has dtype bool"),
    "None": ({"vehicle_0": 3, "vehicle_1": None}, "None of vehicle_1 has dtype object"),
    "a list": ({"vehicle_0": 3, "vehicle_1": [3]}, r"of vehicle_1 has shape \(1,\); expected \(\)"),
    "a ragged list": ({"vehicle_0": [[1], [1, 2]], "vehicle_1": 3}, "of vehicle_0 is not an array"),
    "huge": ({"vehicle_0": 3, "vehicle_1": np.uint64(2**64 - 1)}, "of vehicle_1 is not allowed"),
}
FINE = np.array([0.1, 0.5, -1.0], dtype=np.float32)
BAD_CONTINUOUS = {
    "NaN": (np.array([0.0, math.nan, 0.0]), "of vehicle_1 is not allowed; expected finite numbers"),
    "infinite": ([0.0, 0.0, math.inf], "of vehicle_1 is not allowed"),
    "too short": ([0.0, 0.0], r"of vehicle_1 has shape \(2,\); expected \(3,\)"),
    "a scalar": (0.0, "of vehicle_1 has shape"),
    "strings": (["left", "fast", "no"], "of vehicle_1 has dtype"),
    "bools": ([True, False, True], "of vehicle_1 has dtype bool"),
}


@pytest.mark.parametrize("what", BAD_DISCRETE)
def test_bad_discrete_joint_actions_are_refused(what: str) -> None:
    actions, message = BAD_DISCRETE[what]
    env = mo_deepdrive.parallel_env()
    env.reset(seed=0)
    env.step({"vehicle_0": 6, "vehicle_1": 3})
    assert_refuses(env, actions, message)


@pytest.mark.parametrize("what", BAD_CONTINUOUS)
def test_bad_continuous_joint_actions_are_refused(what: str) -> None:
    action, message = BAD_CONTINUOUS[what]
    env = mo_deepdrive.parallel_env(action_type="continuous")
    env.reset(seed=0)
    env.step(dict.fromkeys(AGENTS, FINE))
    assert_refuses(env, {"vehicle_0": FINE, "vehicle_1": action}, message)


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


@pytest.mark.parametrize("keep_finished", [False, True])
def test_a_step_before_the_first_reset_or_after_the_end_is_refused(keep_finished: bool) -> None:
    env = mo_deepdrive.parallel_env(time_limit=0.2, keep_finished=keep_finished)
    with pytest.raises(ResetNeeded):
        env.step(dict.fromkeys(AGENTS, 3))
    env.reset(seed=0)
    env.step(dict.fromkeys(AGENTS, 3))
    assert env.step(dict.fromkeys(AGENTS, 3))[3] == dict.fromkeys(AGENTS, True)
    before = env.batch.state.tobytes()
    for actions in (dict.fromkeys(AGENTS, 3), {}):
        with pytest.raises(ResetNeeded):
            env.step(actions)
    assert env.batch.state.tobytes() == before
    env.reset()
    env.step(dict.fromkeys(AGENTS, 3))


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


def test_starts_set_both_vehicles_and_invalid_ones_are_refused() -> None:
    starts = ((27.077, 10.0, 0.0), (24.039, 40.0, math.pi))
    env = mo_deepdrive.parallel_env()
    env.reset(seed=0, options={"starts": starts})
    assert [(car["x"], car["y"], car["heading"]) for car in env.telemetry()] == list(starts)
    before = copy.deepcopy(env)
    with pytest.raises(ValueError, match=r"'starts'.*finite"):
        env.reset(seed=3, options={"starts": ((27.0, math.nan, 0.0), (24.0, 40.0, 3.1))})
    assert_same_steps(env, before)


def test_an_unknown_reset_option_is_ignored_with_a_warning_that_names_the_nearest() -> None:
    env, plain = mo_deepdrive.parallel_env(), mo_deepdrive.parallel_env()
    with pytest.warns(UserWarning, match="unknown reset option 'start' is ignored; did you mean 'starts'"):
        observations, _ = env.reset(seed=0, options={"start": (1.0, 2.0, 0.0)})
    for agent, observation in plain.reset(seed=0)[0].items():
        np.testing.assert_array_equal(observations[agent], observation)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenario": "roundabout"}, "scenario"),
        ({"keep_finished": 1}, "keep_finished = 1 must be True or False"),
        ({"render_mode": "ascii"}, "render_mode = 'ascii'"),
        ({"scenario": "one_waypoint", "end_together": True}, "no effect in OneWaypoint"),
    ],
)
def test_invalid_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    for make in (mo_deepdrive.parallel_env, mo_deepdrive.env, mo_deepdrive.raw_env):
        with pytest.raises(ValueError, match=message):
            make(**arguments)


def test_an_unknown_keyword_is_a_type_error_that_names_the_nearest() -> None:
    with pytest.raises(TypeError, match=r"unexpected keyword argument 'end_togther'.*did you mean 'end_together'"):
        mo_deepdrive.parallel_env(end_togther=True)


def test_the_environments_can_be_made_by_the_name_of_their_version() -> None:
    from mo_deepdrive import parallel_v0

    assert mo_deepdrive.parallel_v0 is parallel_v0
    env = parallel_v0.parallel_env(time_limit=3.0)
    assert type(env) is type(parallel_v0.raw_env()) is type(mo_deepdrive.parallel_env())
    assert env.metadata["name"].endswith("_v0")
    assert env.config.time_limit == 3.0
    aec = parallel_v0.env()
    aec.reset(seed=0)
    assert aec.agent_selection == "vehicle_0"


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


def examples(repository: Path) -> list[tuple[str, str]]:
    """The Python blocks of docs/interfaces.md, each with its heading."""
    text = (repository / "docs" / "interfaces.md").read_text(encoding="utf-8")
    found = re.findall(r"^## ([^\n]+)$|^```python\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
    heading, blocks = "", []
    for title, code in found:
        heading = title or heading
        if code:
            blocks.append((heading, code))
    return blocks


def test_the_examples_of_the_documentation_run(repository: Path) -> None:
    blocks = [(heading, code) for heading, code in examples(repository) if heading not in ("RLlib", "TorchRL")]
    assert len(blocks) >= 6
    for heading, code in blocks:
        exec(compile(code, heading, "exec"), {})
