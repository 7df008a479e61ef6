"""The environment as peers see it, and the recorder."""

from __future__ import annotations

from typing import Any

import mo_gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from algorithms.peers import PeerConfig
from algorithms.peers.peer_task import PeerEnv, RecordedEpisodes, Recorder
from mo_deepdrive.utilities import make_utility
from tests.helpers.peers import FIXED, ONE_WAYPOINT, make_task


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("arguments", [{}, {"action_type": "continuous"}])
def test_the_environment_of_peers_passes_gymnasiums_check(arguments: dict[str, Any]) -> None:
    env = make_task(arguments=arguments).make()
    env.unwrapped.spec = None  # otherwise the check would make an unwrapped environment from it
    check_env(env, skip_render_check=True)


@pytest.mark.parametrize("nominal", [True, False])
def test_observations_and_rewards_are_in_nominal_units_unless_disabled(nominal: bool) -> None:
    task = make_task(config=PeerConfig(nominal_scales=nominal))
    wrapped, plain = task.make(), mo_gymnasium.make(ONE_WAYPOINT, **FIXED)
    o, r = task.env.observation_scales, task.env.objective_scales
    unit = (o, r) if nominal else (np.ones_like(o), np.ones_like(r))
    np.testing.assert_allclose(wrapped.reset()[0], plain.reset(seed=5)[0] / unit[0], rtol=1e-6)
    for action in (3, 3, 9, 3):
        first, second = wrapped.step(np.int64(action)), plain.step(action)
        assert first[0].dtype == first[1].dtype == np.float32
        np.testing.assert_allclose(first[0], second[0] / unit[0], rtol=1e-6)
        np.testing.assert_allclose(first[1], second[1] / unit[1], rtol=1e-6)


def test_continuous_actions_outside_the_box_are_clipped() -> None:
    task = make_task(arguments={"action_type": "continuous"})
    episodes = []
    for action in ([0.0, 1.0, -1.0], [0.0, 7.0, -3.0]):
        env = task.make()
        env.reset()
        episodes.append(env.step(np.array(action, dtype=np.float32))[0])
    np.testing.assert_array_equal(*episodes)


def test_discrete_observations_of_other_environments_become_vectors() -> None:
    env = make_task("deep-sea-treasure-v0", {}).make()
    observation, _ = env.reset()
    assert observation.shape == env.observation_space.shape
    assert env.step(env.action_space.sample())[1].shape == (2,)


def test_every_environment_starts_from_a_different_seed_and_does_not_repeat_it() -> None:
    task = make_task(arguments={})
    first, same, second = task.make(0), task.make(0), task.make(1)
    start = first.reset()[0]
    np.testing.assert_array_equal(start, same.reset()[0])
    assert not np.array_equal(start, second.reset()[0])
    assert not np.array_equal(start, first.reset()[0])
    assert first.action_space.sample() == same.action_space.sample()


def test_a_specification_makes_environments_with_different_seeds() -> None:
    spec = make_task(arguments={}).spec()
    starts = [mo_gymnasium.make(spec).reset()[0] for _ in range(2)]
    assert not np.array_equal(*starts)
    assert isinstance(mo_gymnasium.make(spec, render_mode="rgb_array").env, PeerEnv)


def test_steps_are_counted_and_finished_episodes_are_logged() -> None:
    lines: list[tuple[int, dict[str, float]]] = []
    utility = make_utility("one_waypoint_linear", ("distance", "destination", "g_force", "jerk"))
    recorder = Recorder(utility.objectives, utility, 20, lambda step, metrics: lines.append((step, metrics)))
    task = make_task(recorder=recorder)
    env, silent = task.make(), task.make(recorded=False)
    for each in (env, silent):
        each.reset()
    returns = np.zeros(4)
    for _ in range(30):
        _, reward, terminated, truncated, _ = env.step(3)
        silent.step(0)
        returns += reward * task.reward_scales
    assert truncated
    assert not terminated
    for _ in range(30):
        env.reset()
        env.step(0)
    assert recorder.steps == 60
    assert [step for step, _ in lines] == [20, 40, 60]
    assert "train/length" not in lines[0][1]
    assert lines[1][1]["train/length"] == 30
    assert lines[1][1]["train/success"] == 0.0
    assert lines[1][1]["train/return/distance"] == pytest.approx(returns[0], rel=1e-5)
    assert lines[1][1]["train/utility"] == pytest.approx(float(utility(returns)), rel=1e-5)


def test_a_vector_environment_is_recorded_like_single_ones() -> None:
    lines: list[list[tuple[int, dict[str, float]]]] = [[], []]
    tasks = []
    for log in lines:
        recorder = Recorder(
            ("distance", "destination", "g_force", "jerk"), None, 40, lambda *line, log=log: log.append(line)
        )
        tasks.append(make_task(recorder=recorder))
    envs = RecordedEpisodes(tasks[0].env, tasks[0].recorder)
    envs.reset(seed=5)
    singles = [tasks[1].make(i) for i in range(2)]
    for env in singles:
        env.reset()
    for _ in range(70):
        *_, infos = envs.step(np.array([3, 6]))
        assert "episode" not in infos
        for env, action in zip(singles, (3, 6), strict=True):
            if any(env.step(action)[2:4]):
                env.reset()
    assert len(lines[0]) == len(lines[1]) == 3
    for (step, metrics), (expected_step, expected) in zip(*lines, strict=True):
        assert step == expected_step
        for each in (metrics, expected):
            del each["time/steps_per_second"]
        assert metrics == pytest.approx(expected)
