"""Gymnasium: the checker, every wrapper, the vector environments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import wrappers
from gymnasium.wrappers import vector as vector_wrappers

from mo_deepdrive.wrappers import UtilityReward, VectorUtilityReward
from tests.integrations.envs import INTERSECTION, ONE_WAYPOINT, SHORT, scalar, single, vector

pytestmark = pytest.mark.filterwarnings("ignore")
STEPS = 60
FAST = {"decision_frequency": 60, "time_limit": 0.4}  # of wrappers that wait for the next frame


def pictures() -> Any:
    return wrappers.AddRenderObservation(single(render_mode="rgb_array"), render_only=True)


def rendered() -> Any:
    return single(render_mode="rgb_array")


def continuous() -> Any:
    return single(action_type="continuous")


# Each wraps a new environment with the reward of decisions (d,).
SINGLE: dict[str, Callable[[], Any]] = {
    "AddRenderObservation": pictures,
    "AddWhiteNoise": lambda: wrappers.AddWhiteNoise(pictures(), 0.5, is_noise_grayscale=False),
    "ClipAction": lambda: wrappers.ClipAction(continuous()),
    "ClipReward": lambda: wrappers.ClipReward(single(), -1.0, 1.0),
    "DelayObservation": lambda: wrappers.DelayObservation(single(), 2),
    "DiscretizeAction": lambda: wrappers.DiscretizeAction(continuous(), 3),
    "DiscretizeObservation": lambda: wrappers.DiscretizeObservation(single(), 3),
    "DtypeObservation": lambda: wrappers.DtypeObservation(single(), np.float64),
    "FilterObservation": lambda: wrappers.FilterObservation(
        wrappers.AddRenderObservation(rendered(), render_only=False), ["state"]
    ),
    "FlattenObservation": lambda: wrappers.FlattenObservation(single()),
    "FrameStackObservation": lambda: wrappers.FrameStackObservation(single(), 3),
    "GrayscaleObservation": lambda: wrappers.GrayscaleObservation(pictures()),
    "HumanRendering": lambda: wrappers.HumanRendering(single(render_mode="rgb_array", **FAST)),
    "NormalizeObservation": lambda: wrappers.NormalizeObservation(single()),
    "ObstructView": lambda: wrappers.ObstructView(pictures(), 0.5, 20),
    "OrderEnforcing": lambda: wrappers.OrderEnforcing(single()),
    "PassiveEnvChecker": lambda: wrappers.PassiveEnvChecker(single()),
    "RecordEpisodeStatistics": lambda: wrappers.RecordEpisodeStatistics(single()),
    "RecordVideo": lambda: wrappers.RecordVideo(rendered(), "videos"),
    "RenderCollection": lambda: wrappers.RenderCollection(rendered()),
    "RescaleAction": lambda: wrappers.RescaleAction(continuous(), np.float32(-2), np.float32(2)),
    "RescaleObservation": lambda: wrappers.RescaleObservation(single(), np.float32(0), np.float32(1)),
    "ReshapeObservation": lambda: wrappers.ReshapeObservation(single(), (3, 5)),
    "ResizeObservation": lambda: wrappers.ResizeObservation(pictures(), (32, 32)),
    "StickyAction": lambda: wrappers.StickyAction(single(), 0.5),
    "TimeAwareObservation": lambda: wrappers.TimeAwareObservation(single(max_episode_steps=20)),
    "TimeLimit": lambda: wrappers.TimeLimit(single(), 4),
    "TransformAction": lambda: wrappers.TransformAction(continuous(), lambda action: action / 2, None),
    "TransformObservation": lambda: wrappers.TransformObservation(single(), lambda observation: observation, None),
    "TransformReward": lambda: wrappers.TransformReward(single(), lambda reward: reward * 2),
}
# Wrappers that compute with a float; each is given the function that makes the environment.
SCALAR: dict[str, Callable[[Any], Any]] = {
    "ArrayConversion": lambda env: wrappers.ArrayConversion(env, env_xp=np, target_xp=np),
    "MaxAndSkipObservation": lambda env: wrappers.MaxAndSkipObservation(env, 3),
    "NormalizeReward": lambda env: wrappers.NormalizeReward(env),
    "NumpyToTorch": lambda env: wrappers.NumpyToTorch(env),
    "RepeatAction": lambda env: wrappers.RepeatAction(env, 3),
}
CONVERTERS = ("ArrayConversion", "NumpyToTorch")
NEEDS = {"ResizeObservation": "cv2", "HumanRendering": "cv2", "RecordVideo": "moviepy"}


def require(name: str) -> None:
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    if name in CONVERTERS:
        pytest.importorskip("array_api_compat")


def drive(env: Any, shape: tuple[int, ...]) -> int:
    """A few episodes at random, with rewards of ``shape``; how many have ended."""
    env.action_space.seed(0)
    observation, _ = env.reset(seed=0)
    ends = 0
    for _ in range(STEPS):
        observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        assert np.shape(reward) == shape
        assert np.isfinite(reward).all()
        assert observation in env.observation_space
        if terminated or truncated:
            ends += 1
            observation, _ = env.reset()
    env.close()
    return ends


@pytest.mark.parametrize("name", SINGLE)
def test_a_wrapper_runs(name: str) -> None:
    require(name)
    assert drive(SINGLE[name](), (4,)) >= 2


@pytest.mark.parametrize("name", SCALAR)
def test_a_wrapper_of_scalar_rewards_needs_the_utility(name: str) -> None:
    require(name)
    env = SCALAR[name](scalar())
    action = torch.tensor(3) if name == "NumpyToTorch" else np.array(3)
    env.reset(seed=0)
    for _ in range(5):
        assert np.shape(env.step(action)[1]) == ()


# ------------------------------------------------------------------------------------------------------------- vector

VECTOR: dict[str, Callable[[Callable[..., Any]], Any]] = {
    "ClipAction": lambda make: vector_wrappers.ClipAction(make(action_type="continuous")),
    "ClipReward": lambda make: vector_wrappers.ClipReward(make(), -1.0, 1.0),
    "DictInfoToList": lambda make: vector_wrappers.DictInfoToList(make()),
    "DtypeObservation": lambda make: vector_wrappers.DtypeObservation(make(), np.float64),
    "FlattenObservation": lambda make: vector_wrappers.FlattenObservation(make()),
    "HumanRendering": lambda make: vector_wrappers.HumanRendering(make(render_mode="rgb_array", **FAST)),
    "NormalizeObservation": lambda make: vector_wrappers.NormalizeObservation(make()),
    "RecordVideo": lambda make: vector_wrappers.RecordVideo(make(render_mode="rgb_array"), "videos"),
    "RescaleAction": lambda make: vector_wrappers.RescaleAction(make(action_type="continuous"), -2.0, 2.0),
    "RescaleObservation": lambda make: vector_wrappers.RescaleObservation(make(), 0.0, 1.0),
    "ReshapeObservation": lambda make: vector_wrappers.ReshapeObservation(make(), (3, 5)),
    "TransformAction": lambda make: vector_wrappers.TransformAction(make(action_type="continuous"), lambda a: a / 2),
    "TransformObservation": lambda make: vector_wrappers.TransformObservation(make(), lambda o: o),
    "TransformReward": lambda make: vector_wrappers.TransformReward(make(), lambda r: r * 2),
    "VectorizeTransformAction": lambda make: vector_wrappers.VectorizeTransformAction(
        make(action_type="continuous"), wrappers.ClipAction
    ),
    "VectorizeTransformObservation": lambda make: vector_wrappers.VectorizeTransformObservation(
        make(), wrappers.FlattenObservation
    ),
    "VectorizeTransformReward": lambda make: vector_wrappers.VectorizeTransformReward(
        make(), wrappers.TransformReward, func=lambda reward: reward * 2
    ),
}
# TransformReward computes the utility, as in CleanRL-style loops.
VECTOR_SCALAR: dict[str, Callable[[Any], Any]] = {
    "NormalizeReward": lambda env: vector_wrappers.NormalizeReward(env),
    "RecordEpisodeStatistics": lambda env: vector_wrappers.RecordEpisodeStatistics(env),
}


def drive_vector(env: Any, shape: tuple[int, ...]) -> None:
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(STEPS):
        observations, rewards, *_ = env.step(env.action_space.sample())
        assert rewards.shape == shape
        assert np.isfinite(rewards).all()
        assert observations in env.observation_space
    env.close()


@pytest.mark.parametrize("name", VECTOR)
def test_a_vector_wrapper_runs(name: str) -> None:
    require(name)
    drive_vector(VECTOR[name](vector), (3, 4))


@pytest.mark.parametrize("name", VECTOR_SCALAR)
def test_a_vector_wrapper_of_scalar_rewards_needs_the_utility(name: str) -> None:
    drive_vector(VECTOR_SCALAR[name](vector_wrappers.TransformReward(vector(), lambda r: r @ np.ones(4))), (3,))


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_rewards_are_normalised_by_the_returns_of_decisions_alone(mode: str) -> None:
    gamma, returns = 0.9, []
    envs = VectorUtilityReward(vector(autoreset_mode=mode), "one_waypoint_linear")
    env = vector_wrappers.NormalizeReward(envs, gamma=gamma)
    plain = VectorUtilityReward(vector(autoreset_mode=mode), "one_waypoint_linear")
    env.reset(seed=0)
    plain.reset(seed=0)
    total, over = np.zeros(3), np.zeros(3, dtype=np.bool_)
    for _ in range(STEPS):
        env.step(np.array([3, 6, 0]))
        _, rewards, terminated, truncated, _ = plain.step(np.array([3, 6, 0]))
        decided = ~over
        total[decided] = gamma * total[decided] + rewards[decided]
        returns.extend(total[decided])
        over = terminated | truncated
        if mode == "SameStep":
            total[over], over = 0.0, np.zeros(3, dtype=np.bool_)
    assert len(returns) == 3 * (STEPS if mode == "SameStep" else STEPS - 2)
    assert env.return_rms.count == pytest.approx(len(returns), abs=0.01)
    assert env.return_rms.var == pytest.approx(np.var(returns), rel=0.01)


@pytest.mark.parametrize("name", ["NormalizeObservation", "ClipReward", "RescaleAction", "DictInfoToList"])
def test_a_vector_wrapper_runs_with_two_vehicles(name: str) -> None:
    drive_vector(VECTOR[name](lambda **options: vector(INTERSECTION, **options)), (3, 2, 6))


@pytest.mark.parametrize("kind", [gymnasium.vector.SyncVectorEnv, gymnasium.vector.AsyncVectorEnv])
def test_gymnasiums_vector_environments_take_scalar_rewards(kind: Any) -> None:
    drive_vector(kind([scalar] * 2), (2,))


def test_the_default_of_make_vec_is_the_native_environment() -> None:
    assert type(gymnasium.make_vec(ONE_WAYPOINT, num_envs=2, **SHORT)).__name__ == "DrivingVectorEnv"
    env = gymnasium.make_vec(
        ONE_WAYPOINT,
        num_envs=2,
        vectorization_mode="sync",
        wrappers=[lambda env: UtilityReward(env, "one_waypoint_linear")],
        **SHORT,
    )
    drive_vector(env, (2,))
