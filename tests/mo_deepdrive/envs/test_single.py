"""The Gymnasium environments: selected objectives, spaces that nothing leaves, and copies.

``test_interfaces.py`` tests what all interfaces have in common.
"""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.equality import assert_equal

OPEN = ("one_waypoint", "static_obstacle")
SCENARIOS = (*OPEN, "intersection", "left_turn", "roundabout_solo")
ACTION_TYPES = ("discrete", "discrete-16", "continuous")
EVERY = [(scenario, action_type) for scenario in SCENARIOS for action_type in ACTION_TYPES]

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


# ------------------------------------------------------------------------------------------------------- objectives


def test_states_of_one_form_and_of_copies_have_one_dtype_object(make_single: Make, make_vector: Make) -> None:
    # Numba compares the fields of two equal dtypes at every call, and every call of a step takes twice as long.
    env = make_single("left_turn")
    first = env.batch.state.dtype
    assert make_vector("left_turn", num_envs=3).batch.state.dtype is first
    assert make_single("static_obstacle").batch.state.dtype is not first
    records = [name for name, value in vars(env.batch).items() if isinstance(value, np.ndarray) and value.dtype.names]
    assert {"state", "params"} <= set(records)
    for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        for name in records:
            assert getattr(twin.batch, name).dtype is getattr(env.batch, name).dtype


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_selected_objectives_are_in_the_given_order(make_single: Make, scenario: str) -> None:
    full = make_single(scenario)
    actions = sample_actions(full, 80, 5)
    everything = [result[1] for result in rollout(full, actions, seed=5) if len(result) == 5]
    for names in (("jerk", "distance"), ("g_force",), tuple(reversed(full.objectives)), ["destination", "jerk"]):
        env = make_single(scenario, objectives=names)
        rewards = [result[1] for result in rollout(env, actions, seed=5) if len(result) == 5]
        assert env.objectives == tuple(names)
        assert env.reward_dim == len(names)
        assert env.reward_space.shape == (len(names),)
        columns = [full.objectives.index(name) for name in names]
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
