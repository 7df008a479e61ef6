"""The Gymnasium environments: conformance with Gymnasium and MO-Gymnasium, determinism, copies,
invalid input. The environments with one vehicle, and the turn-based intersection (see also ``test_turn_based.py``).
"""

from __future__ import annotations

import copy
import math
import pickle
import re
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st

from mo_deepdrive.world.scenarios import VERSIONS
from tests.helpers.equality import assert_equal

OPEN = ("one_waypoint", "static_obstacle")
SCENARIOS = (*OPEN, "intersection", "left_turn", "roundabout_solo")
IDS = {scenario: f"mo-deepdrive-{scenario.replace('_', '-')}-v0" for scenario in SCENARIOS}
ACTION_TYPES = ("discrete", "discrete-16", "continuous")
ROUNDABOUT = (
    *("distance", "destination", "time", "g_force", "jerk"),
    *("lane_violation", "collision", "near_miss", "right_of_way", "energy"),
)
OBJECTIVES = {
    "one_waypoint": ("distance", "destination", "g_force", "jerk"),
    "static_obstacle": ("distance", "destination", "g_force", "collision", "jerk"),
    "intersection": ("distance", "destination", "g_force", "collision", "jerk", "lane_violation"),
    "left_turn": ("distance", "destination", "g_force", "collision", "jerk", "lane_violation", "time"),
    "roundabout": ROUNDABOUT,
    "roundabout_solo": ROUNDABOUT,
}
SIZES = {
    "one_waypoint": 15,
    "static_obstacle": 19,
    "intersection": 29,
    "left_turn": 19,
    "roundabout": 63,
    "roundabout_solo": 63,
}
EVERY = [(scenario, action_type) for scenario in IDS for action_type in ACTION_TYPES]
CHECKED = [*EVERY, ("roundabout", "discrete")]

Env = Any
Make = Callable[..., Any]


def sample_actions(env: Env, count: int, seed: int) -> list[Any]:
    """Random actions, each held for a few decisions."""
    env.action_space.seed(seed)
    rng = np.random.default_rng(seed)
    actions = [env.action_space.sample()]
    while len(actions) < count:
        actions.append(env.action_space.sample() if rng.random() < 0.3 else actions[-1])
    return actions


def rollout(env: Env, actions: list[Any], seed: int | None) -> list[Any]:
    """All results; the environment is reset (without a seed) whenever an episode ends."""
    out: list[Any] = [env.reset(seed=seed)]
    for action in actions:
        out.append(env.step(action))
        if out[-1][2] or out[-1][3]:
            out.append(env.reset())
    return out


# ------------------------------------------------------------------------------------------------------ conformance


@pytest.mark.parametrize(("scenario", "action_type"), CHECKED)
def test_gymnasiums_checker_warns_of_the_vector_reward_alone(
    make_single: Make, scenario: str, action_type: str
) -> None:
    env = make_single(scenario, action_type=action_type)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        check_env(env, skip_render_check=True)
    messages = [str(warning.message) for warning in found]
    assert [message for message in messages if "The reward returned by `step()` must be a float" not in message] == []


@pytest.mark.parametrize(("scenario", "action_type"), CHECKED)
def test_spaces_are_those_of_the_documentation(make_single: Make, scenario: str, action_type: str) -> None:
    env = make_single(scenario, action_type=action_type)
    assert env.observation_space.shape == (SIZES[scenario],)
    assert env.observation_space.dtype == np.float32
    assert np.isfinite(env.observation_space.low).all()
    assert np.isfinite(env.observation_space.high).all()
    assert env.objectives == OBJECTIVES[scenario]
    assert env.reward_space.shape == (env.reward_dim,) == (len(env.objectives),)
    assert env.reward_space.dtype == np.float32
    if action_type == "continuous":
        assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)
    else:
        assert env.action_space == gymnasium.spaces.Discrete({"discrete": 22, "discrete-16": 16}[action_type])


def test_the_spec_names_the_scenario_and_nothing_else_by_default() -> None:
    for scenario, name in IDS.items():
        spec = gymnasium.spec(name)
        assert spec.kwargs == {"scenario": scenario, **VERSIONS[scenario]["v0"]}
        assert spec.max_episode_steps is None
        assert not spec.nondeterministic


# ------------------------------------------------------------------------------------------------------ determinism


@pytest.mark.parametrize("scenario", IDS)
def test_different_seeds_give_different_scenarios(make_single: Make, scenario: str) -> None:
    env = make_single(scenario)
    spawns = {env.reset(seed=seed)[0].tobytes() for seed in range(50)}
    assert len(spawns) == 50
    env.reset(seed=0)
    assert len({env.reset()[0].tobytes() for _ in range(50)}) == 50
    unseeded = {make_single(scenario).reset()[0].tobytes() for _ in range(5)}
    assert len(unseeded) == 5


# ------------------------------------------------------------------------------------------------------- objectives


def test_states_of_one_form_have_one_dtype_object(make_single: Make, make_vector: Make) -> None:
    # Numba compares the fields of two equal dtypes at every call, and every call of a step takes twice as long.
    first, second = (make_single("one_waypoint").unwrapped.batch.state.dtype for _ in range(2))
    assert first is second
    assert make_vector("intersection", num_envs=3).unwrapped.batch.state.dtype is first
    assert make_single("static_obstacle").unwrapped.batch.state.dtype is not first


@pytest.mark.parametrize("how", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_the_records_of_a_copy_have_the_dtype_objects_of_the_original(make_single: Make, how: Any) -> None:
    env = make_single("left_turn")
    batch, twin = (each.unwrapped.batch for each in (env, how(env)))
    records = [name for name, value in vars(batch).items() if isinstance(value, np.ndarray) and value.dtype.names]
    assert {"state", "params"} <= set(records)
    for name in records:
        assert getattr(twin, name).dtype is getattr(batch, name).dtype


@pytest.mark.parametrize("scenario", IDS)
def test_selected_objectives_are_in_the_given_order(make_single: Make, scenario: str) -> None:
    full = make_single(scenario)
    actions = sample_actions(full, 80, 5)
    everything = [result[1] for result in rollout(full, actions, seed=5) if len(result) == 5]
    for names in (("jerk", "distance"), ("g_force",), tuple(reversed(OBJECTIVES[scenario])), ["destination", "jerk"]):
        env = make_single(scenario, objectives=names)
        rewards = [result[1] for result in rollout(env, actions, seed=5) if len(result) == 5]
        assert env.objectives == tuple(names)
        assert env.reward_dim == len(names)
        assert env.reward_space.shape == (len(names),)
        columns = [OBJECTIVES[scenario].index(name) for name in names]
        assert_equal(rewards, [reward[columns] for reward in everything])
        np.testing.assert_array_equal(env.reward_space.low, full.reward_space.low[columns])
        np.testing.assert_array_equal(env.reward_space.high, full.reward_space.high[columns])


# ------------------------------------------------------------------------------------------------------------ spaces


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "action_type"), EVERY)
def test_observations_and_rewards_never_leave_their_spaces(make_single: Make, scenario: str, action_type: str) -> None:
    kinds: dict[str, Env] = {
        "slow": make_single(scenario, action_type=action_type, harmful_g_force=None, decision_frequency=1),
        "usual": make_single(scenario, action_type=action_type, harmful_g_force=None, cost_sign="paper"),
        "coarse": make_single(scenario, action_type=action_type, harmful_g_force=None, simulation_frequency=10),
        "coarsest": make_single(
            scenario, action_type=action_type, harmful_g_force=None, simulation_frequency=1, decision_frequency=1
        ),
    }
    starts = st.sampled_from([(-250.0, -250.0), (250.0, -250.0), (0.0, 250.0)])
    destinations = st.sampled_from([(250.0, 250.0), (-250.0, 0.0), (30.0, 30.0)])
    env = kinds["usual"]
    if action_type == "continuous":
        one = st.tuples(*[st.one_of(st.sampled_from([-1.0, 0.0, 1.0]), st.floats(-1, 1, width=32))] * 3)
        one = one.map(lambda action: np.array(action, dtype=np.float32))
    else:
        one = st.integers(0, int(env.action_space.n) - 1)

    @settings(max_examples=60)
    @given(
        kind=st.sampled_from(sorted(kinds)),
        seed=st.integers(0, 2**32 - 1),
        pins=st.none() | st.tuples(starts, st.floats(-7, 7), destinations),
        plan=st.lists(st.tuples(one, st.integers(1, 200)), min_size=1, max_size=8),
    )
    def check(kind: str, seed: int, pins: Any, plan: list[tuple[Any, int]]) -> None:
        env = kinds[kind]
        options: dict[str, Any] = {}
        if pins is not None and scenario == "intersection":
            options = {"starts": ((*pins[0], pins[1]), (*pins[2], -pins[1]))}
        elif scenario == "roundabout_solo":
            options = {"routes": [seed % 12], "distances": [10.0]}
        elif pins is not None:
            options = {"start": (*pins[0], pins[1]), "destination": pins[2]}
        observation, _ = env.reset(seed=seed, options=options)
        assert observation in env.observation_space
        for action, times in plan:
            for _ in range(times):
                observation, reward, terminated, truncated, _ = env.step(action)
                assert observation in env.observation_space, observation
                assert reward in env.reward_space, reward
                if terminated or truncated:
                    return

    check()


# --------------------------------------------------------------------------------------------------------- bad input


def assert_refuses(env: Env, call: Callable[[], Any], error: type[Exception], message: str) -> None:
    """``call`` raises a clear error, and the environment continues as if it had not been called."""
    before = copy.deepcopy(env)
    with pytest.raises(error, match=message):
        call()
    assert env.telemetry() == before.telemetry()
    assert env.batch.state.tobytes() == before.batch.state.tobytes()
    action = env.action_space.sample()
    assert_equal(env.step(action), before.step(action))
    assert_equal(env.reset(), before.reset())


BAD_CONTINUOUS = {
    "NaN": ([0.0, math.nan, 0.0], "not allowed"),
    "too short": ([0.0, 0.0], "shape"),
    "batched": ([[0.0] * 3], "shape"),
    "strings": (["left", "fast", "no"], "dtype"),
    "complex": ([1j, 0.0, 0.0], "dtype"),
}
BAD_DISCRETE = {
    "too large": (22, "not allowed"),
    "negative": (-1, "not allowed"),
    "huge unsigned": (np.uint64(2**64 - 1), "not allowed"),
    "a float": (3.0, "dtype"),
    "a pair": (np.array([3, 4]), "shape"),
    "a string": ("left", "dtype"),
    "a bool": (True, "dtype"),
    "None": (None, "dtype"),
}


@pytest.mark.parametrize(
    ("action_type", "action", "message"),
    [
        *(("continuous", *row) for row in BAD_CONTINUOUS.values()),
        *(("discrete", *row) for row in BAD_DISCRETE.values()),
        ("discrete-16", 16, r"expected integers in \[0, 16\)"),
    ],
    ids=[*BAD_CONTINUOUS, *BAD_DISCRETE, "the seventeenth"],
)
def test_a_bad_action_is_refused(make_single: Make, action_type: str, action: Any, message: str) -> None:
    env = make_single("static_obstacle", action_type=action_type)
    env.reset(seed=0)
    env.step(np.array([0.1, 0.5, -1.0], dtype=np.float32) if action_type == "continuous" else 15)
    assert_refuses(env, lambda: env.step(action), ValueError, message)


@pytest.mark.parametrize("scenario", IDS)
def test_a_step_before_the_first_reset_or_after_the_end_is_refused(make_single: Make, scenario: str) -> None:
    env = make_single(scenario, time_limit=0.2)
    with pytest.raises(ResetNeeded):
        env.step(0)
    env.reset(seed=0)
    # Each of the two vehicles chooses twice, and the first one has its last turn before the second.
    for _ in range(4 if scenario == "intersection" else 1):
        assert not env.step(0)[3]
    assert env.step(0)[3]
    before = env.telemetry()
    with pytest.raises(ResetNeeded):
        env.step(0)
    assert env.telemetry() == before
    env.reset()
    assert not env.step(0)[3]
    wrapped = gymnasium.make(IDS[scenario], disable_env_checker=True)
    with pytest.raises(ResetNeeded):
        wrapped.step(0)


GOOD = {"start": (0.0, 0.0, -math.pi / 2), "destination": (30.0, 0.0)}
BAD_OPTIONS = {
    "the destination on the bicycle": ({**GOOD, "obstacle": ((30.0, -1.0), (30.0, 1.0))}, "no valid scenario"),
    "the start inside the car": ({**GOOD, "obstacle": ((0.1, 0.0), (0.2, 0.1))}, "no valid scenario"),
    "a NaN in the bicycle": ({"obstacle": ((1.0, math.nan), (2.0, 2.0))}, "'obstacle'.*finite"),
    "a start without heading": ({"start": (0.0, 0.0)}, "'start'.*x, y, heading"),
    "a bicycle with one end": ({"obstacle": (1.0, 2.0)}, "'obstacle'"),
    "a start far away": (
        {"start": (1e6, 0.0, 0.0)},
        r"'start' = \(1000000.0, 0.0, 0.0\) must have coordinates in \[-250, 250\] m",
    ),
    "a heading of many turns": (
        {"start": (0.0, 0.0, 1e9)},
        r"'start' = \(0.0, 0.0, 1000000000.0\) must have headings in \[-250, 250\] rad",
    ),
    "an unknown option": ({"destinatoin": (1.0, 2.0)}, "'destinatoin'.*did you mean 'destination'"),
    "the option of another scenario": ({"starts": ((0, 0, 0), (0, 0, 0))}, "unknown reset option 'starts'"),
}


@pytest.mark.parametrize("what", BAD_OPTIONS)
def test_reset_options_without_a_valid_scenario_are_refused(make_single: Make, what: str) -> None:
    options, message = BAD_OPTIONS[what]
    env = make_single("static_obstacle")
    env.reset(seed=0)
    env.step(3)
    assert_refuses(env, lambda: env.reset(options=options), ValueError, message)


@pytest.mark.parametrize("seed", [1.5, "a", -1, True, np.float64(3.0), [1]])
@pytest.mark.parametrize("scenario", IDS)
def test_a_bad_seed_is_refused_and_does_not_change_the_state(make_single: Make, scenario: str, seed: Any) -> None:
    env = make_single(scenario)
    env.reset(seed=np.int64(0))
    message = f"^{re.escape(f'seed = {seed!r} must be None or a non-negative integer')}$"
    assert_refuses(env, lambda: env.reset(seed=seed), ValueError, message)


BAD_ARGUMENTS: dict[str, tuple[str, dict[str, Any], str]] = {
    "an unknown action type": ("one_waypoint", {"action_type": "discreet"}, "action_type.*'discreet'"),
    "an unknown objective": ("one_waypoint", {"objectives": ("jrek",)}, "'jrek'; did you mean 'jerk'"),
    "an objective of another scenario": ("one_waypoint", {"objectives": ("collision",)}, "OneWaypoint does not have"),
    "no objectives": ("one_waypoint", {"objectives": ()}, "one or more distinct names"),
    "a time limit of zero": ("one_waypoint", {"time_limit": 0}, "time_limit.*greater than 0"),
    "a time limit below a decision": ("one_waypoint", {"time_limit": 0.04}, "at least one decision"),
    "a frequency that is not a divisor": ("one_waypoint", {"decision_frequency": 7}, "must be a multiple"),
    "a flag as a number": ("one_waypoint", {"ignore_brake": 1}, "ignore_brake"),
    "a lane margin without lanes": ("one_waypoint", {"lane_margin": 0.5}, "lane_margin.*no effect in OneWaypoint"),
    "an unknown render mode": ("one_waypoint", {"render_mode": "ascii"}, "render_mode = 'ascii'"),
}


@pytest.mark.parametrize("what", BAD_ARGUMENTS)
@pytest.mark.filterwarnings("ignore:.*render_mode.*")
def test_invalid_environment_arguments_are_refused(make_single: Make, what: str) -> None:
    scenario, options, message = BAD_ARGUMENTS[what]
    with pytest.raises(ValueError, match=message):
        make_single(scenario, **options)


@pytest.mark.parametrize(("name", "near"), [("time_limits", "time_limit"), ("harmfull_jerk", "harmful_jerk")])
def test_an_unknown_keyword_is_a_type_error_that_names_the_nearest(make_single: Make, name: str, near: str) -> None:
    with pytest.raises(TypeError, match=f"unexpected keyword argument '{name}'.*is unknown; did you mean '{near}'"):
        make_single("one_waypoint", **{name: 3.0})


def test_every_invalid_argument_is_named(make_single: Make) -> None:
    with pytest.raises(ValueError, match=r"time_limit.*lane_margin"):
        make_single(time_limit=-1, lane_margin=-2.0)
    with pytest.raises(TypeError, match=r"^got an unexpected keyword argument 'seeed'.*time_limit.*seeed"):
        make_single(time_limit=-1, seeed=1)


def test_the_single_environment_refuses_two_vehicles_and_names_the_alternatives() -> None:
    from mo_deepdrive.envs.single import DrivingEnv

    with pytest.raises(ValueError, match=r"'intersection' has 2 vehicles.*gymnasium\.make\(.*make_vec.*parallel_env"):
        DrivingEnv(scenario="intersection")
    with pytest.raises(ValueError, match="scenario"):
        DrivingEnv(scenario="roundabout")
