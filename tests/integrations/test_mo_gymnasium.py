"""MO-Gymnasium: every wrapper, single and vector."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mo_gymnasium.wrappers import (
    LinearReward,
    MOClipReward,
    MOMaxAndSkipObservation,
    MONormalizeReward,
    MORecordEpisodeStatistics,
)
from mo_gymnasium.wrappers.vector import MORecordEpisodeStatistics as VectorStatistics
from mo_gymnasium.wrappers.vector import MOSyncVectorEnv

from mo_deepdrive.wrappers import VectorEpisodeStatistics
from tests.integrations.envs import INTERSECTION, LEFT_TURN, ONE_WAYPOINT, single, vector

pytestmark = pytest.mark.filterwarnings("ignore")
IDS = {ONE_WAYPOINT: 4, INTERSECTION: 6, LEFT_TURN: 7}  # and their objectives


def episode(env: Any) -> list[tuple[Any, Any]]:
    """Rewards and infos of one episode."""
    env.reset(seed=0)
    steps = []
    terminated = truncated = False
    while not (terminated or truncated):
        _, reward, terminated, truncated, info = env.step(3)
        steps.append((reward, info))
    return steps


@pytest.mark.parametrize("env_id", IDS)
def test_the_linear_reward_is_the_weighted_sum(env_id: str) -> None:
    weights = np.linspace(0.1, 1.0, IDS[env_id])
    for reward, info in episode(LinearReward(single(env_id), weight=weights)):
        assert reward == pytest.approx(float(weights @ info["vector_reward"]))


@pytest.mark.parametrize("env_id", IDS)
def test_rewards_are_normalised_and_clipped(env_id: str) -> None:
    jerk = single(env_id).unwrapped.objectives.index("jerk")
    plain = np.array([reward for reward, _ in episode(single(env_id))])
    clipped = np.array([reward for reward, _ in episode(MOClipReward(single(env_id), idx=jerk, min_r=-1.0, max_r=0.0))])
    np.testing.assert_array_equal(clipped[:, jerk], np.maximum(plain[:, jerk], -1.0))
    normal = np.array([reward for reward, _ in episode(MONormalizeReward(single(env_id), idx=jerk))])
    assert len(np.unique((normal[:, jerk] / plain[:, jerk]).round(3))) > 5
    np.testing.assert_array_equal(np.delete(normal, jerk, axis=1), np.delete(plain, jerk, axis=1))


@pytest.mark.parametrize("env_id", IDS)
def test_statistics_are_those_of_the_episode(env_id: str) -> None:
    steps = episode(MORecordEpisodeStatistics(single(env_id), gamma=0.9))
    rewards = np.array([reward for reward, _ in steps], dtype=np.float64)
    found = steps[-1][1]["episode"]
    np.testing.assert_allclose(found["r"], rewards.sum(axis=0), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(found["dr"], 0.9 ** np.arange(len(rewards)) @ rewards, rtol=1e-4, atol=1e-4)


def test_skipped_decisions_add_up() -> None:
    skipped = np.array([reward for reward, _ in episode(MOMaxAndSkipObservation(single(), skip=4))])
    plain = np.array([reward for reward, _ in episode(single())])
    np.testing.assert_allclose(skipped, plain.reshape(-1, 4, 4).sum(axis=1), rtol=1e-4, atol=1e-5)


def recorded(make: Any, mode: str, episodes: int = 3) -> list[tuple[Any, Any]]:
    """What the wrapper and ours say of every episode; all environments end at the time limit."""
    theirs, ours = VectorStatistics(make(mode), gamma=0.9), VectorEpisodeStatistics(make(mode), gamma=0.9)
    theirs.reset(seed=0)
    ours.reset(seed=0)
    found = []
    while len(found) < episodes:
        said, true = (each.step(np.array([3, 6, 0]))[4] for each in (theirs, ours))
        assert ("episode" in said) == ("episode" in true)
        if "episode" in true:
            found.append((said["episode"], true["episode"]))
            if mode == "Disabled":
                for each in (theirs, ours):
                    each.reset(options={"reset_mask": np.ones(3, dtype=np.bool_)})
    return found


def agreement(found: list[tuple[Any, Any]]) -> dict[str, list[bool]]:
    """Of every episode, whether the wrapper's statistic is right."""
    return {name: [np.allclose(t[name], o[name], rtol=1e-3, atol=1e-3) for t, o in found] for name in ("r", "dr", "l")}


def native(mode: str) -> Any:
    return vector(autoreset_mode=mode)


FIRST, ALL = [True, False, False], [True] * 3


@pytest.mark.parametrize(
    ("make", "mode", "right"),
    [
        (native, "NextStep", {"r": ALL, "dr": FIRST, "l": ALL}),
        (lambda _: MOSyncVectorEnv([single] * 3), "", {"r": ALL, "dr": FIRST, "l": ALL}),
        (native, "SameStep", {"r": FIRST, "dr": FIRST, "l": FIRST}),
        (native, "Disabled", {"r": ALL, "dr": ALL, "l": ALL}),
    ],
    ids=["NextStep", "MOSyncVectorEnv", "SameStep", "Disabled"],
)
def test_vector_statistics_are_right_as_far_as_the_page_says(
    make: Any, mode: str, right: dict[str, list[bool]]
) -> None:
    assert agreement(recorded(make, mode)) == right
