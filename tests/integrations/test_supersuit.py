"""SuperSuit: every wrapper on the parallel and the AEC environment, and its vector environments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from mo_deepdrive.wrappers import ParallelUtilityReward
from tests.integrations.envs import VEHICLES, aec, one_leaves_early, parallel, scalar

pytestmark = pytest.mark.filterwarnings("ignore")
CONTINUOUS = {"action_type": "continuous"}


def scalars(**options: Any) -> Any:
    return ParallelUtilityReward(parallel(**options), "intersection_linear")


# Each is given the library and a function that makes the environment.
WRAPPERS: dict[str, Callable[[Any, Callable[..., Any]], Any]] = {
    "action_lambda_v1": lambda s, make: s.action_lambda_v1(make(**CONTINUOUS), lambda a, _: a / 2, lambda space: space),
    "clip_actions_v0": lambda s, make: s.clip_actions_v0(make(**CONTINUOUS)),
    "delay_observations_v0": lambda s, make: s.delay_observations_v0(make(), 2),
    "dtype_v0": lambda s, make: s.dtype_v0(make(), np.float64),
    "flatten_v0": lambda s, make: s.flatten_v0(make()),
    "frame_stack_v1": lambda s, make: s.frame_stack_v1(make(), 3),
    "frame_stack_v2": lambda s, make: s.frame_stack_v2(make(), 3),
    "max_observation_v0": lambda s, make: s.max_observation_v0(make(), 2),
    "nan_noop_v0": lambda s, make: s.nan_noop_v0(make(), 0),
    "nan_random_v0": lambda s, make: s.nan_random_v0(make()),
    "nan_zeros_v0": lambda s, make: s.nan_zeros_v0(make(**CONTINUOUS)),
    "normalize_obs_v0": lambda s, make: s.normalize_obs_v0(make()),
    "observation_lambda_v0": lambda s, make: s.observation_lambda_v0(make(), lambda o, _: o, lambda space: space),
    "pad_action_space_v0": lambda s, make: s.pad_action_space_v0(make()),
    "pad_observations_v0": lambda s, make: s.pad_observations_v0(make()),
    "reshape_v0": lambda s, make: s.reshape_v0(make(), (29, 1)),
    "reward_lambda_v0": lambda s, make: s.reward_lambda_v0(make(), lambda reward: reward * 2),
    "scale_actions_v0": lambda s, make: s.scale_actions_v0(make(**CONTINUOUS), 2.0),
    "sticky_actions_v0": lambda s, make: s.sticky_actions_v0(make(), 0.5),
}
MAKE = {"parallel": parallel, "AEC": aec}


def drive(env: Any, steps: int = 50, contained: bool = True) -> Any:
    """Random actions: the last reward of ``vehicle_0``."""
    reward = None
    env.reset(seed=0)
    if hasattr(env, "agent_iter"):
        for agent in env.agent_iter(steps):
            _, received, terminated, truncated, _ = env.last()
            reward = received if agent == "vehicle_0" else reward
            env.step(None if terminated or truncated else env.action_space(agent).sample())
        return reward
    for _ in range(steps):
        if not env.agents:
            env.reset()
        observations, rewards, *_ = env.step({agent: env.action_space(agent).sample() for agent in env.agents})
        reward = rewards.get("vehicle_0", reward)
        if contained:
            assert all(observations[agent] in env.observation_space(agent) for agent in observations)
    return reward


@pytest.mark.parametrize("api", MAKE)
@pytest.mark.parametrize("name", WRAPPERS)
def test_a_wrapper_runs(name: str, api: str) -> None:
    import supersuit

    assert np.shape(drive(WRAPPERS[name](supersuit, MAKE[api]))) == (6,)


def test_clipping_takes_scalar_rewards() -> None:
    import supersuit

    assert np.shape(drive(supersuit.clip_reward_v0(scalars()))) == ()
    assert np.shape(drive(supersuit.reward_lambda_v0(parallel(), lambda reward: np.clip(reward, -1, 1)))) == (6,)


def test_frames_are_skipped() -> None:
    import supersuit

    assert np.shape(drive(supersuit.frame_skip_v0(aec(), 3))) == (6,)


def test_the_indicator_of_an_agent_is_added() -> None:
    import supersuit

    env = supersuit.agent_indicator_v0(parallel())
    assert np.shape(drive(env, contained=False)) == (6,)
    observations, _ = env.reset(seed=0)
    assert all(observation.shape == (31,) for observation in observations.values())


@pytest.mark.parametrize("base", ["gymnasium", "stable_baselines3"])
def test_vehicles_as_a_vector_environment(base: str) -> None:
    import supersuit

    if base != "gymnasium":
        pytest.importorskip(base)

    def vehicles(env: Any) -> Any:
        return supersuit.concat_vec_envs_v1(supersuit.pettingzoo_env_to_vec_env_v1(env), 2, base_class=base)

    def drive_vector(env: Any) -> Any:
        env.reset()
        for _ in range(45):
            rewards = env.step(np.array([*one_leaves_early(list(VEHICLES)).values()] * 2))[1]
        return rewards

    assert drive_vector(vehicles(scalars(harmful_g_force=0.1, keep_finished=True))).shape == (4,)


def test_its_vector_environments_of_gymnasium_environments() -> None:
    import supersuit

    env = supersuit.gym_vec_env_v0(scalar(), 2)
    env.reset(seed=0)
    assert env.step(np.array([3, 3]))[1].shape == (2,)
    pytest.importorskip("stable_baselines3")
    env = supersuit.stable_baselines3_vec_env_v0(scalar(), 2)
    env.reset()
    assert env.step(np.array([3, 3]))[1].shape == (2,)


def test_aec_environments_are_vectorised() -> None:
    import supersuit

    many = supersuit.vectorize_aec_env_v0(aec(), 2)
    many.reset(seed=0)
    for _ in range(10):
        many.step([0, 0])
        assert many.last()[1].shape == (2, 6)
