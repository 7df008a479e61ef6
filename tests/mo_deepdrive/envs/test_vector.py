"""The native vector environment: every row is a single environment, for every autoreset mode and number of threads."""

from __future__ import annotations

import copy
import io
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from mo_gymnasium.wrappers.vector import MOSyncVectorEnv

from tests.helpers.equality import assert_equal

OPEN = ("one_waypoint", "static_obstacle")
ALONE = (*OPEN, "left_turn", "roundabout_solo")
SCENARIOS = (*ALONE, "intersection", "roundabout")
ACTION_TYPES = ("discrete", "discrete-16", "continuous")
ALONE_EVERY = [(scenario, action_type) for scenario in ALONE for action_type in ACTION_TYPES]
EVERY = [(scenario, action_type) for scenario in SCENARIOS for action_type in ACTION_TYPES]

Make = Callable[..., Any]


def sticky_actions(env: VectorEnv, steps: int, seed: int) -> list[np.ndarray]:
    """Random actions of all worlds, each held for a few decisions."""
    env.action_space.seed(seed)
    rng = np.random.default_rng(seed)
    actions = [env.action_space.sample()]
    while len(actions) < steps:
        change = rng.random(env.num_envs) < 0.3
        held = actions[-1].copy()
        held[change] = env.action_space.sample()[change]
        actions.append(held)
    return actions


def rollout(env: Any, actions: list[np.ndarray], seed: int | None = 0) -> list[Any]:
    """The results of a reset and one step per action."""
    return [env.reset(seed=seed), *(env.step(action) for action in actions)]


def unsigned_zeros(steps: list[Any]) -> list[Any]:
    """The same, with zeros instead of minus zeros among the rewards (which have a separate test)."""
    return [step if len(step) == 2 else (step[0], step[1] + np.float32(0.0), *step[2:]) for step in steps]


def episodes(steps: list[Any]) -> int:
    """How many episodes ended in a rollout."""
    return sum(int((terminated | truncated).sum()) for _, _, terminated, truncated, _ in steps[1:])


# ------------------------------------------------------------------------------ rows are single environments


# Short episodes, so that every world draws more than one block of its stream, and whole ones.
@pytest.mark.parametrize(("time_limit", "least"), [(1.2, 4 * 17), (60.0, 2)])
@pytest.mark.parametrize(("scenario", "action_type"), ALONE_EVERY)
def test_next_step_is_bit_for_bit_mo_gymnasiums_vector_of_single_environments(
    make_single: Make, make_vector: Make, scenario: str, action_type: str, time_limit: float, least: int
) -> None:
    options = {"action_type": action_type, "time_limit": time_limit}
    native = make_vector(scenario, 4, **options)
    reference = MOSyncVectorEnv([lambda: make_single(scenario, **options) for _ in range(4)])
    assert native.single_observation_space == reference.single_observation_space
    assert native.single_action_space == reference.single_action_space
    assert native.observation_space == reference.observation_space
    assert native.action_space == reference.action_space
    assert native.reward_space == reference.reward_space
    assert native.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    actions = sticky_actions(native, 300, seed=1)
    ours = unsigned_zeros(rollout(native, actions, seed=42))
    assert_equal(ours, unsigned_zeros(rollout(reference, actions, seed=42)))
    assert episodes(ours) > least
    # A reset without a seed continues the streams.
    ours = unsigned_zeros(rollout(native, actions[:40], seed=None))
    assert_equal(ours, unsigned_zeros(rollout(reference, actions[:40], seed=None)))


@pytest.mark.parametrize(("scenario", "action_type"), ALONE_EVERY)
def test_same_step_gives_the_final_observation_and_the_first_of_the_next_episode(
    make_single: Make, make_vector: Make, scenario: str, action_type: str
) -> None:
    options = {"action_type": action_type, "time_limit": 1.5}
    native = make_vector(scenario, 4, autoreset_mode=AutoresetMode.SAME_STEP, **options)
    singles = [make_single(scenario, **options) for _ in range(4)]
    observations, _ = native.reset(seed=3)
    for i, env in enumerate(singles):
        assert_equal(observations[i], env.reset(seed=3 + i)[0])
    count = 0
    for batch in sticky_actions(native, 320, seed=3):
        observations, rewards, terminated, truncated, infos = native.step(batch)
        over = terminated | truncated
        assert ("final_obs" in infos) == over.any()
        assert infos.keys() in (set(), {"final_obs", "_final_obs", "final_info", "_final_info"})
        for i, env in enumerate(singles):
            observation, reward, done, out_of_time, info = env.step(batch[i])
            assert_equal(rewards[i], reward)
            assert (terminated[i], truncated[i]) == (done, out_of_time)
            if over[i]:
                count += 1
                assert infos["_final_obs"][i]
                assert infos["_final_info"][i]
                assert_equal(infos["final_obs"][i], observation)
                final = infos["final_info"]
                assert final["_end"][i]
                assert final["_success"][i]
                assert (final["end"][i], bool(final["success"][i])) == (info["end"], info["success"])
                observation, _ = env.reset()
            elif over.any():
                assert not infos["_final_obs"][i]
                assert not infos["_final_info"][i]
                assert not infos["final_info"]["_end"][i]
            assert_equal(observations[i], observation)
    assert count > 4 * 17


@pytest.mark.parametrize(("scenario", "action_type"), EVERY)
def test_without_autoreset_finished_worlds_need_a_reset_mask(
    make_vector: Make, scenario: str, action_type: str
) -> None:
    env = make_vector(scenario, 6, action_type=action_type, autoreset_mode="Disabled", time_limit=40.0)
    reference = make_vector(scenario, 6, action_type=action_type, autoreset_mode="SameStep", time_limit=40.0)
    env.reset(seed=5)
    reference.reset(seed=5)
    count = 0
    for batch in sticky_actions(env, 300, seed=5):
        observations, rewards, terminated, truncated, infos = env.step(batch)
        expected = reference.step(batch)
        assert_equal([rewards, terminated, truncated], list(expected[1:4]))
        over = (terminated | truncated).reshape(6, -1).all(axis=1)
        if over.any():
            count += int(over.sum())
            before = env.telemetry()
            with pytest.raises(ResetNeeded, match="first ones"):
                env.step(batch)
            assert env.telemetry() == before
            assert_equal(observations[over], expected[4]["final_obs"][over])
            assert_equal(infos["end"][over], expected[4]["final_info"]["end"][over])
            observations, _ = env.reset(options={"reset_mask": over})
        assert_equal(observations, expected[0])
    assert count > 0


@pytest.mark.parametrize(("scenario", "action_type"), EVERY)
def test_two_threads_give_the_results_of_one(make_vector: Make, scenario: str, action_type: str) -> None:
    options = {"action_type": action_type, "time_limit": 3.0}
    one, two, many = (make_vector(scenario, 7, threads=threads, **options) for threads in (1, 2, 16))
    actions = sticky_actions(one, 120, seed=6)
    expected = rollout(one, actions, seed=6)
    assert_equal(rollout(two, actions, seed=6), expected)
    assert_equal(rollout(many, actions, seed=6), expected)
    assert episodes(expected) > 7


def test_the_first_reset_seeds_all_worlds_whatever_its_options(make_vector: Make) -> None:
    plain, pinned = make_vector("one_waypoint", 3), make_vector("one_waypoint", 3)
    mask = {"reset_mask": np.array([True, False, True])}
    plain.reset(seed=5, options=mask)
    pinned.reset(seed=5, options={**mask, "destination": [0.0, 20.0]})
    assert pinned.np_random_seed == plain.np_random_seed == (5, 6, 7)


@pytest.mark.slow
def test_a_forked_child_steps_with_threads_of_its_own(run_python: Callable[[str], str]) -> None:
    # A child that waits for the threads of its parent is killed by its alarm.
    snippet = """
import os, signal
import gymnasium, mo_deepdrive
env = gymnasium.make_vec("mo-deepdrive-one-waypoint-v0", num_envs=4, threads=2)
env.reset(seed=0)
actions = env.action_space.sample()
env.step(actions)
read, write = os.pipe()
child = os.fork()
if child == 0:
    signal.alarm(10)
    os.write(write, env.step(actions)[1].tobytes())
    env.close()
    os._exit(0)
status = os.waitpid(child, 0)[1]
rewards = env.step(actions)[1].tobytes()
print(status, os.read(read, len(rewards)) == rewards if status == 0 else "killed")
"""
    assert run_python(snippet).split() == ["0", "True"]


# ------------------------------------------------------------------------------------------------------ saved states


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize(("scenario", "action_type"), EVERY)
def test_a_saved_state_resumes_exactly_in_a_new_environment(
    make_vector: Make, scenario: str, action_type: str, mode: str
) -> None:
    options = {"action_type": action_type, "autoreset_mode": mode, "time_limit": 0.5}
    env = make_vector(scenario, 3, **options)
    actions = sticky_actions(env, 260, seed=8)
    env.reset(seed=8)
    pending = 0
    for cut in (0, 3, 4, 5, 6, 7, 40, 100):
        start = 0
        env.reset(seed=8)
        for start in range(cut):
            env.step(actions[start])
        saved = env.get_state()
        assert all(isinstance(array, np.ndarray) for array in saved.values())
        pending += int(saved["over"].any())
        buffer = io.BytesIO()
        np.savez(buffer, **saved)
        buffer.seek(0)
        fresh = make_vector(scenario, 3, **options)
        with np.load(buffer, allow_pickle=False) as loaded:
            fresh.set_state({name: loaded[name] for name in loaded.files})
        assert fresh.telemetry() == env.telemetry()
        rest = [env.step(action) for action in actions[cut : cut + 150]]
        assert_equal([fresh.step(action) for action in actions[cut : cut + 150]], rest)
        # After many resets the random streams are still the same.
        assert_equal(fresh.reset(), env.reset())
        assert_equal(fresh.get_state(), env.get_state())
    assert (pending > 0) == (mode == "NextStep"), "a finished world, which the next step resets, is saved, too"


def raw_flags(*values: int) -> np.ndarray:
    return np.array(values, dtype=np.uint8).view(np.bool_)


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("state", np.zeros((2, 488)), "float64 of shape (2, 488); this environment needs uint8 of shape (2, 488)"),
        ("state", [[0] * 464] * 2, "'list'; this environment needs uint8 of shape (2, 488)"),
        ("over", raw_flags(0, 7), "has 7; it must be 0 or 1"),
        ("begun", raw_flags(255), "has 255; it must be 0 or 1"),
        ("begun", None, "is missing; this environment needs bool of shape (1,)"),
        ("blocks", np.full((2, 16, 5), np.nan), "has nan; it must be in [0, 1)"),
        ("cursors", np.array([0, 10**9]), "has 1000000000; it must be between 0 and 16"),
    ],
)
def test_an_invalid_array_of_a_state_is_refused(make_vector: Make, name: str, array: Any, message: str) -> None:
    env = make_vector("one_waypoint", 2)
    env.reset(seed=0)
    before = env.get_state()
    state = {**before, name: array}
    if array is None:
        del state[name]
    with pytest.raises(ValueError, match=f"^state '{name}' (is )?{re.escape(message.removeprefix('is '))}$"):
        env.set_state(state)
    assert_equal(env.get_state(), before)


# ------------------------------------------------------------------------------------------------------------- seeds


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_an_integer_seed_counts_up_and_a_list_seeds_every_world(make_vector: Make, scenario: str) -> None:
    env = make_vector(scenario, 4)
    counted, _ = env.reset(seed=10)
    assert env.np_random_seed == (10, 11, 12, 13)
    assert len({row.tobytes() for row in counted}) == 4
    assert_equal(env.reset(seed=[10, 11, 12, 13])[0], counted)
    shuffled, _ = env.reset(seed=[13, 10, 10, 12])
    assert_equal(shuffled, counted[[3, 0, 0, 2]])
    assert_equal(env.reset(seed=np.int64(10))[0], counted)
    with pytest.raises(ValueError, match="3 entries"):
        env.reset(seed=[1, 2, 3])


@pytest.mark.parametrize(
    ("seed", "wrong"), [([0, "a"], "seed[1] = 'a'"), (np.array([True]), f"seed[0] = {np.True_!r}")]
)
def test_an_invalid_seed_in_a_list_is_refused_and_no_world_changes(make_vector: Make, seed: Any, wrong: str) -> None:
    env = make_vector("one_waypoint", len(seed))
    env.reset(seed=0)
    before = env.get_state()
    with pytest.raises(ValueError, match=f"^{re.escape(wrong)} must be None or a non-negative integer$"):
        env.reset(seed=seed)
    assert_equal(env.get_state(), before)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_a_masked_reset_does_not_affect_the_other_worlds_and_their_streams(make_vector: Make, scenario: str) -> None:
    env, twin = make_vector(scenario, 3), make_vector(scenario, 3)
    actions = sticky_actions(env, 20, seed=0)
    rollout(env, actions, seed=0)
    rollout(twin, actions, seed=0)
    before = env.telemetry()
    mask = np.array([False, True, False])
    observations, _ = env.reset(seed=99, options={"reset_mask": mask})
    after = env.telemetry()
    assert (after[0], after[2]) == (before[0], before[2])
    assert after[1] != before[1]
    alone, _ = make_vector(scenario, 3).reset(seed=99)
    assert_equal(observations[1], alone[1])
    ours, theirs = env.reset()[0], twin.reset()[0]
    assert_equal(ours[[0, 2]], theirs[[0, 2]])
    assert (ours[1] != theirs[1]).any()


# --------------------------------------------------------------------------------------------- what comes back, limits


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_max_episode_steps_is_the_time_limit_in_decisions(make_vector: Make, scenario: str) -> None:
    env = make_vector(scenario, 2, max_episode_steps=7, autoreset_mode="Disabled")
    env.reset(seed=0)
    idle = np.zeros(env.action_space.shape, dtype=np.int64)
    for step in range(1, 8):
        _, _, terminated, truncated, _ = env.step(idle)
        assert not terminated.any()
        assert truncated.all() == truncated.any() == (step == 7)


def test_a_vehicle_that_was_never_placed_has_not_acted(make_vector: Make) -> None:
    env = make_vector("intersection", 2)
    env.reset(seed=0, options={"reset_mask": np.array([True, False])})
    idle = np.zeros((2, 2), dtype=np.int64)
    assert env.step(idle)[4]["acted"].tolist() == [[True, True], [False, False]]
    assert env.step(idle)[4]["acted"].all()


BAD_RESETS: dict[str, tuple[str, dict[str, Any], str]] = {
    "a mask of numbers": ("one_waypoint", {"reset_mask": np.array([1, 0])}, "reset_mask"),
    "a mask of another size": ("one_waypoint", {"reset_mask": np.array([True])}, "reset_mask"),
    "an empty mask": ("one_waypoint", {"reset_mask": np.array([False, False])}, "at least one True"),
    "an invalid bicycle": (
        "static_obstacle",
        {"start": (0.0, 0.0, 0.0), "obstacle": ((0.0, 0.0), (0.1, 0.0))},
        "no valid scenario",
    ),
}


@pytest.mark.parametrize("what", BAD_RESETS)
def test_an_invalid_reset_is_refused_and_no_world_changes(make_vector: Make, what: str) -> None:
    scenario, options, message = BAD_RESETS[what]
    env = make_vector(scenario, 2)
    env.reset(seed=0)
    action = env.action_space.sample()
    env.step(action)
    twin = copy.deepcopy(env)
    for seed in (None, 7):
        with pytest.raises(ValueError, match=message):
            env.reset(seed=seed, options=options)
        assert_equal(env.get_state(), twin.get_state())
        assert env.np_random_seed == twin.np_random_seed == (0, 1)
    assert env.telemetry() == twin.telemetry()
    assert_equal(env.step(action), twin.step(action))
