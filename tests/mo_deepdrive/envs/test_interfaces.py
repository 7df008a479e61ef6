"""What all interfaces have in common: checkers of their libraries, the same trajectories bit for bit, and refusals."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from momaland.test.api_test import api_test
from pettingzoo.test import parallel_api_test, parallel_seed_test, seed_test

import mo_deepdrive
from mo_deepdrive.envs.single import DrivingEnv
from mo_deepdrive.envs.vector import DrivingVectorEnv
from mo_deepdrive.world.scenarios import SCENARIOS, VERSIONS
from tests.helpers.equality import assert_equal
from tests.helpers.interfaces import (
    ACTION_TYPES,
    INTERFACES,
    PLANS,
    record,
    record_roundabout,
    replay_vector,
)

WORLDS = 3  # of the interfaces that have several


@dataclass(frozen=True)
class Interface:
    """An interface.

    Attributes:
        make: an environment of a scenario and its arguments.
        joint: what ``step`` takes, where the last vehicle of the last world has an action and all others a valid one.
    """

    make: Callable[..., Any]
    joint: Callable[[Any, Any, Any], Any]

    def step(self, env: Any, action: Any, good: Any = None) -> Any:
        """What a step returns, in the AEC interface what is then received."""
        taken = env.step(self.joint(env, action, action if good is None else good))
        return env.last() if taken is None else taken


def single(scenario: str, **arguments: Any) -> Any:
    return gymnasium.make(SCENARIOS[scenario].id, disable_env_checker=True, **arguments).unwrapped


def vector(scenario: str, **arguments: Any) -> Any:
    return gymnasium.make_vec(SCENARIOS[scenario].id, num_envs=WORLDS, **arguments)


def stacked(env: Any, action: Any, good: Any) -> np.ndarray:
    actions = np.array([[good] * env.vehicles] * (WORLDS - 1) + [[good] * (env.vehicles - 1) + [action]])
    return actions[:, 0] if env.vehicles == 1 else actions


def tensors(env: Any, action: Any, good: Any) -> torch.Tensor:
    return torch.as_tensor(stacked(env, action, good))


def named(env: Any, action: Any, good: Any) -> dict[str, Any]:
    return {agent: action if agent == env.agents[-1] else good for agent in env.agents}


def alone(env: Any, action: Any, good: Any) -> Any:
    return action


KINDS: dict[str, Interface] = {
    "single": Interface(single, alone),
    "vector": Interface(vector, stacked),
    "vector, two threads": Interface(partial(vector, threads=2), stacked),
    "tensor": Interface(partial(vector, device="cpu", check_actions=True), tensors),
    "parallel": Interface(mo_deepdrive.parallel_env, named),
    "parallel, kept": Interface(partial(mo_deepdrive.parallel_env, keep_finished=True), named),
    "AEC": Interface(mo_deepdrive.env, alone),
}
EVERY = pytest.mark.parametrize("kind", KINDS)
FINE = np.array([0.1, 0.5, -1.0], dtype=np.float32)


def valid(arguments: dict[str, Any]) -> Any:
    return FINE if arguments.get("action_type") == "continuous" else 3


def begun(kind: str, scenario: str = "intersection", **arguments: Any) -> Any:
    """An environment after a reset and a step."""
    env = KINDS[kind].make(scenario=scenario, **arguments)
    env.reset(seed=0)
    KINDS[kind].step(env, valid(arguments))
    return env


def assert_refuses(
    kind: str, call: Callable[[Any], Any], message: str, scenario: str = "intersection", **arguments: Any
) -> None:
    """``call`` raises a clear error, and the environment continues as another one, of which nothing was asked."""
    env, twin = begun(kind, scenario, **arguments), begun(kind, scenario, **arguments)
    with pytest.raises(ValueError, match=message):
        call(env)
    for go_on in (lambda each: KINDS[kind].step(each, valid(arguments)), lambda each: each.reset()):
        assert_equal(go_on(env), go_on(twin))
        assert env.unwrapped.telemetry() == twin.unwrapped.telemetry()


# ------------------------------------------------------------------------------------------------- checkers and spaces


@pytest.mark.parametrize("action_type", ACTION_TYPES)
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_gymnasiums_checker_warns_of_the_vector_reward_alone(scenario: str, action_type: str) -> None:
    env = single(scenario, action_type=action_type)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env, skip_render_check=True)
    messages = [str(warning.message) for warning in caught]
    assert [message for message in messages if "The reward returned by `step()` must be a float" not in message] == []


@pytest.mark.parametrize("keep_finished", [False, True])
@pytest.mark.parametrize(
    "arguments",
    [
        *({"action_type": each, "end_together": together} for each in ACTION_TYPES for together in (False, True)),
        {"scenario": "roundabout", "vehicles": 16},
        {"scenario": "roundabout", "vehicles": 3, "cars": 2},
        {"scenario": "roundabout_solo"},
    ],
    ids=lambda arguments: "-".join(map(str, arguments.values())),
)
@pytest.mark.slow
def test_pettingzoos_and_momalands_checkers_pass(arguments: dict[str, Any], keep_finished: bool) -> None:
    options = {"keep_finished": keep_finished, **arguments}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message="unknown reset option 'options' is ignored")
        parallel_api_test(mo_deepdrive.parallel_env(**options), num_cycles=700)
        parallel_seed_test(lambda: mo_deepdrive.parallel_env(**options), num_cycles=50)
        api_test(mo_deepdrive.env(**options), num_cycles=700)
        seed_test(lambda: mo_deepdrive.env(**options), num_cycles=50)


ROUNDABOUT = (
    *("distance", "destination", "time", "g_force", "jerk"),
    *("lane_violation", "collision", "near_miss", "right_of_way", "energy"),
)
# Numbers that a vehicle observes, and its objectives.
DOCUMENTED = {
    "one_waypoint": (15, ("distance", "destination", "g_force", "jerk")),
    "static_obstacle": (19, ("distance", "destination", "g_force", "collision", "jerk")),
    "intersection": (29, ("distance", "destination", "g_force", "collision", "jerk", "lane_violation")),
    "left_turn": (19, ("distance", "destination", "g_force", "collision", "jerk", "lane_violation", "time")),
    "roundabout": (63, ROUNDABOUT),
    "roundabout_solo": (63, ROUNDABOUT),
}


@pytest.mark.parametrize("action_type", ACTION_TYPES)
@pytest.mark.parametrize("scenario", DOCUMENTED)
def test_spaces_and_specs_are_those_of_the_documentation(scenario: str, action_type: str) -> None:
    size, objectives = DOCUMENTED[scenario]
    env, many, agents = (
        KINDS[kind].make(scenario=scenario, action_type=action_type, **VERSIONS[scenario]["v0"])
        for kind in ("single", "vector", "parallel")
    )
    observations, rewards = env.observation_space, env.reward_space
    assert (observations.shape, observations.dtype, rewards.shape, rewards.dtype) == (
        (size,), np.float32, (len(objectives),), np.float32,
    )  # fmt: skip
    assert np.isfinite([observations.low, observations.high]).all()
    expected = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)
    if action_type != "continuous":
        expected = gymnasium.spaces.Discrete({"discrete": 22, "discrete-16": 16}[action_type])
    assert env.action_space == expected
    for agent in agents.possible_agents:
        assert (agents.observation_space(agent), agents.reward_space(agent)) == (observations, rewards)
        assert agents.action_space(agent) == expected
    assert env.objectives == many.objectives == agents.objectives == objectives
    shape = (WORLDS,) if many.vehicles == 1 else (WORLDS, many.vehicles)
    assert many.observation_space.shape == (*shape, size)
    assert many.reward_space.shape == (*shape[1:], len(objectives))
    assert many.action_space.shape == (*shape, *expected.shape)
    spec = gymnasium.spec(SCENARIOS[scenario].id)
    assert spec.kwargs == {"scenario": scenario, **VERSIONS[scenario]["v0"]}
    assert (spec.max_episode_steps, spec.nondeterministic) == (None, False)


def spoil(value: Any) -> None:
    """Overwrite all arrays."""
    if isinstance(value, (np.ndarray, torch.Tensor)):
        value[...] = 1
    elif isinstance(value, (dict, list, tuple)):
        for each in value.values() if isinstance(value, dict) else value:
            spoil(each)


@pytest.mark.parametrize("kind", [name for name in KINDS if name != "AEC"])
@pytest.mark.parametrize("scenario", ["left_turn", "intersection"])
@pytest.mark.parametrize("action_type", ACTION_TYPES)
def test_what_is_returned_is_in_its_spaces_and_may_be_changed_by_the_caller(
    kind: str, scenario: str, action_type: str
) -> None:
    interface = KINDS[kind]
    env, modified = (interface.make(scenario=scenario, action_type=action_type, time_limit=1.0) for _ in range(2))
    space = single(scenario, action_type=action_type).action_space
    space.seed(0)
    over = True
    for _ in range(35):
        if over:
            assert_equal(env.reset(seed=0), first := modified.reset(seed=0))
            spoil(first)
        action = space.sample()
        ours, theirs = interface.step(env, action), interface.step(modified, action)
        assert_equal(ours, theirs)
        spoil(theirs)
        over = False
        if kind.startswith("parallel"):
            np.testing.assert_array_equal(env.state(), modified.state())
            over = not env.agents
            for agent, observation in ours[0].items():
                assert observation in env.observation_space(agent)
                assert ours[1][agent] in env.reward_space(agent)
                assert ours[4][agent].keys() in (set(), {"end", "success"})
        elif kind == "single":
            over = ours[2] or ours[3]
            assert ours[0] in env.observation_space
            assert ours[1] in env.reward_space
            assert type(ours[2]) is type(ours[3]) is bool


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_a_cost_of_zero_is_not_minus_zero(make_vector: Any, scenario: str) -> None:
    # In the step that resets a world the rewards are zeros, as in MO-Gymnasium's vector environment, bit for bit.
    env = make_vector(scenario, 2, time_limit=0.2)
    costs = [name != "time" for name in env.objectives]  # an idle decision takes time
    env.reset(seed=0)
    for _ in range(4):
        rewards = env.step(np.zeros(env.action_space.shape, dtype=np.int64))[1][..., costs]
        assert not rewards.any()
        assert not np.signbit(rewards).any()


# -------------------------------------------------------------------------------------------------------- trajectories


@pytest.mark.slow
@pytest.mark.parametrize("end_together", [False, True])
@pytest.mark.parametrize("action_type", ACTION_TYPES)
def test_the_recorded_episodes_end_as_planned(action_type: str, end_together: bool) -> None:
    episodes = replay_vector(record(action_type, end_together))
    wanted = [plan.ends_together if end_together else plan.ends for plan in PLANS.values()]
    assert [tuple(reports[-1].end for reports in episode) for episode in episodes] == wanted
    lengths = {name: [len(reports) for reports in episode] for name, episode in zip(PLANS, episodes, strict=True)}
    early = [name for name, (left, straight) in lengths.items() if left != straight]
    if end_together:
        assert early == []
    else:
        # One vehicle continues after the other has arrived or failed, whichever it is.
        assert early == ["both arrive", "the straight one fails", "the left turn fails", "one arrives, one stays"]
        assert lengths["both arrive"][0] > lengths["both arrive"][1]
        assert lengths["the left turn fails"][0] < lengths["the left turn fails"][1]


@pytest.mark.slow
@pytest.mark.parametrize("end_together", [False, True])
@pytest.mark.parametrize("action_type", ACTION_TYPES)
@pytest.mark.parametrize("interface", [name for name in INTERFACES if name != "vector"])
def test_every_interface_gives_the_trajectories_of_the_vector_interface(
    interface: str, action_type: str, end_together: bool
) -> None:
    recording = record(action_type, end_together)
    assert_equal(INTERFACES[interface](recording), replay_vector(recording))


@pytest.mark.slow
@pytest.mark.parametrize(("vehicles", "cars"), [(4, 0), (16, 0), (3, 2)])
def test_every_interface_gives_the_same_trajectories_of_many_vehicles(vehicles: int, cars: int) -> None:
    recording = record_roundabout(vehicles, cars)
    episodes = replay_vector(recording)
    for interface in INTERFACES.values():
        assert_equal(interface(recording), episodes)
    ends = {reports[-1].end for episode in episodes for reports in episode}
    assert ends >= {"arrived", "collision"}


@pytest.mark.slow
@pytest.mark.parametrize("end_together", [False, True])
def test_every_interface_delays_actions_and_charges_the_time_that_remains(end_together: bool) -> None:
    recording = record("discrete", end_together, late_v1=True)
    episodes = replay_vector(recording)
    for interface in INTERFACES.values():
        assert_equal(interface(recording), episodes)
    ends = set()
    for reports in (reports for episode in episodes for reports in episode):
        charged = -sum(float(report.reward[-1]) for report in reports)
        driven = 0.1 * (len(reports) - 1)
        assert charged == pytest.approx(driven if reports[-1].end == "arrived" else 60.0, rel=1e-5)
        ends.add(reports[-1].end)
    assert ends >= {"arrived", "collision", "other_vehicle" if end_together else "time_limit"}


@EVERY
def test_scenarios_are_drawn_from_the_seed_alone(kind: str) -> None:
    def first(env: Any, seed: Any = None) -> str:
        given = env.reset(seed=seed)
        return repr(env.last()[0].tolist() if given is None else given[0])

    make, before = KINDS[kind].make, np.random.get_state()[1].copy()  # noqa: NPY002
    with np.printoptions(floatmode="unique"):
        env = make(scenario="intersection")
        seeded = [first(env, seed) for seed in (*range(20), *range(20))]
        assert seeded[:20] == seeded[20:]
        assert first(env, np.int64(3)) == seeded[3]
        later = [first(env) for _ in range(20)]
        assert len({*seeded, *later}) == 40
        assert first(env, 3) == seeded[3]
        assert [first(env) for _ in range(20)] == later
        assert len({first(make(scenario="intersection")) for _ in range(5)}) == 5
    assert (np.random.get_state()[1] == before).all(), "the global generator is not used"  # noqa: NPY002


# ------------------------------------------------------------------------------------------------------------ refusals

BAD_ACTIONS: dict[str, tuple[str, Any, str]] = {
    "too large": ("discrete", 22, "not allowed"),
    "the seventeenth": ("discrete-16", 16, r"not allowed; expected integers in \[0, 16\)"),
    "negative": ("discrete", -1, "not allowed"),
    "huge": ("discrete", 2**40, "not allowed"),
    "a float": ("discrete", 3.0, "dtype"),
    "a pair": ("discrete", [3, 4], "shape"),
    "a string": ("discrete", "left", "dtype"),
    "None": ("discrete", None, "dtype|shape"),
    "NaN": ("continuous", [0.0, math.nan, 0.0], "not allowed"),
    "infinite": ("continuous", [0.0, -math.inf, 0.0], "not allowed"),
    "too short": ("continuous", [0.0, 0.0], "shape"),
    "batched": ("continuous", [[0.0] * 3], "shape"),
    "strings": ("continuous", ["left", "fast", "no"], "dtype"),
    "complex": ("continuous", [1j, 0.0, 0.0], "dtype"),
}


@pytest.mark.parametrize("name", BAD_ACTIONS)
@pytest.mark.parametrize("kind", [name for name in KINDS if name != "tensor"])
def test_one_bad_action_is_refused_and_nothing_moves(kind: str, name: str) -> None:
    action_type, action, message = BAD_ACTIONS[name]
    good = action if message in ("shape", "dtype") else FINE.tolist() if action_type == "continuous" else 3
    assert_refuses(kind, lambda env: KINDS[kind].step(env, action, good), message, action_type=action_type)


@pytest.mark.parametrize("seed", [1.5, "a", -1, True, np.float64(3.0)])
@EVERY
def test_a_bad_seed_is_refused_and_nothing_changes(kind: str, seed: Any) -> None:
    message = r"^seed = .* must be None or a non-negative integer$"
    assert_refuses(kind, lambda env: env.reset(seed=seed), message)


FAR_AWAY, TURNED = (1e6, 0.0, 0.0), (0.0, 0.0, 1e9)
BAD_OPTIONS: dict[str, tuple[str, Any, str]] = {
    **{
        f"not a dict: {each!r}": (
            "intersection",
            each,
            r"options = .* must be a dict of reset options by name, or None",
        )
        for each in (5, [], "starts", {1: 2}, np.zeros(2))
    },
    "a NaN": ("intersection", {"starts": ((0.0, 0.0, 0.0), (0.0, math.nan, 0.0))}, "'starts'.*finite"),
    "one start": ("intersection", {"starts": (0.0, 0.0)}, "'starts'.*x, y, heading"),
    "far away": ("intersection", {"starts": (FAR_AWAY, FAR_AWAY)}, r"must have coordinates in \[-250, 250\] m"),
    "many turns": ("intersection", {"starts": (TURNED, TURNED)}, r"must have headings in \[-250, 250\] rad"),
    "a bicycle with one end": ("static_obstacle", {"obstacle": (1.0, 2.0)}, "'obstacle'"),
    "the destination on the bicycle": (
        "static_obstacle",
        {"destination": (30.0, 0.0), "obstacle": ((30.0, -1.0), (30.0, 1.0))},
        "no valid scenario",
    ),
}


@pytest.mark.parametrize("name", BAD_OPTIONS)
@EVERY
def test_bad_reset_options_are_refused_and_nothing_changes(kind: str, name: str) -> None:
    scenario, options, message = BAD_OPTIONS[name]
    if kind == "AEC" and scenario == "static_obstacle":
        pytest.skip("one vehicle takes no turns")
    for seed in (None, 7):
        assert_refuses(kind, lambda env, seed=seed: env.reset(seed=seed, options=options), message, scenario)


def test_an_unknown_reset_option_is_named_with_the_nearest() -> None:
    for kind in ("single", "vector", "tensor"):
        assert_refuses(kind, lambda env: env.reset(options={"start": 1}), "'start'.*did you mean 'starts'")
    agents = mo_deepdrive.parallel_env()  # where PettingZoo's checks pass one
    with pytest.warns(UserWarning, match="unknown reset option 'start' is ignored; did you mean 'starts'"):
        given = agents.reset(seed=0, options={"start": (1.0, 2.0, 0.0)})
    assert_equal(given, agents.reset(seed=0))


@pytest.mark.parametrize("kind", [name for name in KINDS if name != "AEC"])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_a_step_before_the_first_reset_or_after_the_end_is_refused(kind: str, mode: str) -> None:
    interface, has_worlds = KINDS[kind], kind.startswith(("vector", "tensor"))
    if not has_worlds and mode != "Disabled":
        pytest.skip("there is no autoreset")
    env = interface.make(scenario="intersection", time_limit=0.2, **({"autoreset_mode": mode} if has_worlds else {}))
    with pytest.raises(ResetNeeded):
        env.step({} if kind.startswith("parallel") else interface.joint(env, 0, 0))
    env.reset(seed=0)
    # Of a turn-based episode each of the two vehicles chooses twice, and the first has its last turn before the second.
    for _ in range(5 if kind == "single" else 2):
        truncated = interface.step(env, 0)[3]
    assert np.all(list(truncated.values()) if isinstance(truncated, dict) else np.asarray(truncated))
    if mode == "Disabled":
        before = env.telemetry()
        for _ in range(2):
            with pytest.raises(ResetNeeded):
                env.step({} if kind.startswith("parallel") else interface.joint(env, 0, 0))
        assert env.telemetry() == before
        env.reset()
    interface.step(env, 0)


BAD_ARGUMENTS: dict[str, tuple[str, dict[str, Any], str]] = {
    "an unknown scenario": ("crossroads", {}, "scenario"),
    "an unknown action type": ("one_waypoint", {"action_type": "discreet"}, "action_type.*'discreet'"),
    "an unknown objective": ("one_waypoint", {"objectives": ("jrek",)}, "'jrek'; did you mean 'jerk'"),
    "an objective of another scenario": ("one_waypoint", {"objectives": ("collision",)}, "OneWaypoint does not have"),
    "no objectives": ("one_waypoint", {"objectives": ()}, "one or more distinct names"),
    "a time limit of zero": ("one_waypoint", {"time_limit": 0}, "time_limit.*greater than 0"),
    "a time limit below a decision": ("one_waypoint", {"time_limit": 0.04}, "at least one decision"),
    "a frequency that is not a divisor": ("one_waypoint", {"decision_frequency": 7}, "must be a multiple"),
    "a flag as a number": ("one_waypoint", {"ignore_brake": 1}, "ignore_brake"),
    "a lane margin without lanes": ("one_waypoint", {"lane_margin": 0.5}, "lane_margin.*no effect in OneWaypoint"),
    "vehicles that end together": ("one_waypoint", {"end_together": True}, "no effect in OneWaypoint"),
    "an unknown render mode": ("one_waypoint", {"render_mode": "ascii"}, "render_mode = 'ascii'"),
    "two faults": ("one_waypoint", {"time_limit": -1, "lane_margin": -2.0}, "time_limit.*lane_margin"),
}


@pytest.mark.parametrize("name", BAD_ARGUMENTS)
def test_invalid_arguments_are_refused_by_every_interface(name: str) -> None:
    scenario, arguments, message = BAD_ARGUMENTS[name]
    for make in (DrivingEnv, DrivingVectorEnv, mo_deepdrive.parallel_env, mo_deepdrive.env, mo_deepdrive.raw_env):
        with pytest.raises(ValueError, match=message):
            make(scenario=scenario, **arguments)


@pytest.mark.parametrize(
    ("make", "arguments", "message"),
    [
        (mo_deepdrive.parallel_env, {"keep_finished": 1}, "keep_finished = 1 must be True or False"),
        (DrivingVectorEnv, {"num_envs": 0}, "num_envs = 0"),
        (DrivingVectorEnv, {"num_envs": True}, "num_envs = True must be a positive integer"),
        (DrivingVectorEnv, {"threads": 0}, "threads = 0 must be a positive integer"),
        (DrivingVectorEnv, {"max_episode_steps": 0}, "max_episode_steps"),
        (DrivingVectorEnv, {"autoreset_mode": "Never"}, "Never"),
        (DrivingEnv, {}, r"'intersection' has 2 vehicles.*gymnasium\.make\(.*make_vec.*parallel_env"),
    ],
)
def test_arguments_of_one_interface_are_refused(make: Any, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(scenario="intersection", **arguments)


@pytest.mark.parametrize(("name", "near"), [("time_limits", "time_limit"), ("harmfull_jerk", "harmful_jerk")])
def test_an_unknown_keyword_is_a_type_error_that_names_the_nearest(name: str, near: str) -> None:
    with pytest.raises(TypeError, match=f"unexpected keyword argument '{name}'.*is unknown; did you mean '{near}'"):
        single("one_waypoint", **{name: 3.0})
    with pytest.raises(TypeError, match=rf"^got an unexpected keyword argument '{name}'.*time_limit.*{name}"):
        single("one_waypoint", time_limit=-1, **{name: 3.0})
