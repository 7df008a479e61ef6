"""PettingZoo: its tests, wrappers and conversions, parallel and AEC."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pettingzoo.utils.conversions as conversions
import pettingzoo.utils.wrappers as pettingzoo_wrappers
import pytest
from pettingzoo.test import api_test

import mo_deepdrive
from mo_deepdrive.wrappers import ParallelUtilityReward
from tests.integrations.envs import TWO, aec, one_leaves_early, parallel

pytestmark = pytest.mark.filterwarnings("ignore")


def drive_parallel(env: Any, shape: tuple[int, ...] = (6,)) -> int:
    """Two episodes in which one vehicle leaves before the other; the steps."""
    steps = 0
    for _ in range(2):
        env.reset(seed=0)
        present = []
        while env.agents:
            present.append(len(env.agents))
            observations, rewards, *_ = env.step(one_leaves_early(env.agents))
            steps += 1
            assert all(observations[agent] in env.observation_space(agent) for agent in observations)
            assert all(np.shape(reward) == shape for reward in rewards.values())
        assert set(present) == {1, 2}
    env.close()
    return steps


def drive_aec(env: Any, turns: int = 60) -> set[tuple[int, ...]]:
    """Random actions: the shapes of the rewards."""
    env.reset(seed=0)
    shapes = set()
    for agent in env.agent_iter(turns):
        _, reward, terminated, truncated, _ = env.last()
        shapes.add(np.shape(reward))
        env.step(None if terminated or truncated else env.action_space(agent).sample())
    env.close()
    return shapes


def test_the_test_of_aec_environments_takes_scalar_rewards() -> None:
    scalars = ParallelUtilityReward(parallel(), "intersection_linear")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        api_test(conversions.parallel_to_aec(scalars), num_cycles=100)


EARLY = {"harmful_g_force": 0.1}
PARALLEL: dict[str, Callable[[], Any]] = {
    "BaseParallelWrapper": lambda: pettingzoo_wrappers.BaseParallelWrapper(parallel(**EARLY)),
    "RecordVideoParallel": lambda: pettingzoo_wrappers.RecordVideoParallel(
        parallel(render_mode="rgb_array", **EARLY), "videos"
    ),
}
AEC: dict[str, Callable[[], Any]] = {
    "AssertOutOfBoundsWrapper": lambda: pettingzoo_wrappers.AssertOutOfBoundsWrapper(aec()),
    "BaseWrapper": lambda: pettingzoo_wrappers.BaseWrapper(aec()),
    "CaptureStdoutWrapper": lambda: pettingzoo_wrappers.CaptureStdoutWrapper(aec(render_mode="human")),
    "ClipOutOfBoundsWrapper": lambda: pettingzoo_wrappers.ClipOutOfBoundsWrapper(aec(action_type="continuous")),
    "MultiEpisodeEnv": lambda: pettingzoo_wrappers.MultiEpisodeEnv(aec(), 3),
    "OrderEnforcingWrapper": lambda: pettingzoo_wrappers.OrderEnforcingWrapper(aec()),
    "RecordVideo": lambda: pettingzoo_wrappers.RecordVideo(aec(render_mode="rgb_array"), "videos"),
}


@pytest.mark.parametrize("name", PARALLEL)
def test_a_parallel_wrapper_runs_if_one_vehicle_leaves(name: str) -> None:
    assert drive_parallel(PARALLEL[name]()) > 20


def test_several_episodes_in_one_run() -> None:
    env = pettingzoo_wrappers.MultiEpisodeParallelEnv(parallel(), 3)
    env.reset(seed=0)
    steps = 0
    while env.agents:
        env.step(dict.fromkeys(env.agents, 0))
        steps += 1
    assert steps == 60


@pytest.mark.parametrize("name", AEC)
def test_an_aec_wrapper_runs(name: str) -> None:
    assert (6,) in drive_aec(AEC[name]())


def test_the_conversions_run() -> None:
    assert (6,) in drive_aec(conversions.parallel_to_aec(parallel()))
    assert (6,) in drive_aec(conversions.aec_wrapper_fn(mo_deepdrive.parallel_env)(**TWO))
    back = conversions.aec_to_parallel(aec(**EARLY))
    assert drive_parallel(back) == drive_parallel(parallel(**EARLY))
    assert drive_parallel(conversions.parallel_wrapper_fn(mo_deepdrive.env)(**TWO, **EARLY)) > 20
    turns = conversions.turn_based_aec_to_parallel(aec())
    turns.reset(seed=0)
    rewards = turns.step(dict.fromkeys(turns.agents, 0))[1]
    assert all(np.shape(reward) == (6,) for reward in rewards.values())
