"""SuperSuit: every wrapper on the parallel and the AEC environment, and its vector environments."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from mo_deepdrive.wrappers import ParallelUtilityReward
from tests.integrations.envs import VEHICLES, aec, one_leaves_early, parallel, scalar
from tests.integrations.matrix import Library, row

if TYPE_CHECKING:
    from collections.abc import Callable

LIBRARY = Library("SuperSuit", "supersuit", "supersuit", "`supersuit.dtype_v0(mo_deepdrive.parallel_env(), ...)`")

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


@row("wrappers: " + ", ".join(f"`{name}`" for name in WRAPPERS), how="parallel and AEC, vector rewards")
@pytest.mark.parametrize("api", MAKE)
@pytest.mark.parametrize("name", WRAPPERS)
def test_a_wrapper_runs(name: str, api: str) -> None:
    import supersuit

    assert np.shape(drive(WRAPPERS[name](supersuit, MAKE[api]))) == (6,)


@row(
    "`clip_reward_v0`",
    how="`ParallelUtilityReward`, or `reward_lambda_v0(env, lambda r: np.clip(r, -1, 1))`",
    breaks="ValueError: the truth value of an array is ambiguous",
    whose="SuperSuit: rewards are scalars",
)
def test_clipping_takes_scalar_rewards() -> None:
    import supersuit

    with pytest.raises(ValueError, match="truth value of an array"):
        drive(supersuit.clip_reward_v0(parallel()))
    assert np.shape(drive(supersuit.clip_reward_v0(scalars()))) == ()
    assert np.shape(drive(supersuit.reward_lambda_v0(parallel(), lambda reward: np.clip(reward, -1, 1)))) == (6,)


@row(
    "`frame_skip_v0`",
    how="AEC; or a smaller `decision_frequency`",
    breaks="parallel: AttributeError, it draws from the environment's `np_random`, which PettingZoo's API has not",
    whose="SuperSuit",
)
def test_skipping_frames_needs_a_generator_in_the_parallel_environment() -> None:
    import supersuit

    with pytest.raises(AttributeError, match="no attribute 'np_random'"):
        drive(supersuit.frame_skip_v0(parallel(), 3))
    assert np.shape(drive(supersuit.frame_skip_v0(aec(), 3))) == (6,)


@row(
    "`agent_indicator_v0`",
    how="as it is; MOMAland's MAPPO uses it",
    breaks="observations are outside of its space: the indicator is the largest, its bound the smallest bound of all",
    whose="SuperSuit",
)
def test_the_indicator_is_outside_of_its_space() -> None:
    import supersuit

    env = supersuit.agent_indicator_v0(parallel())
    assert np.shape(drive(env, contained=False)) == (6,)
    observations, _ = env.reset(seed=0)
    for agent, observation in observations.items():
        assert observation.shape == (31,)
        assert observation not in env.observation_space(agent)  # breaks


@row(
    "`black_death_v3`",
    how="`keep_finished=True` instead",
    breaks="at the end of an episode: ResetNeeded; it waits for agents that are terminated and truncated at once, and "
    "steps on without any",
    whose="SuperSuit",
)
def test_black_death_does_not_end_an_episode() -> None:
    import supersuit
    from gymnasium.error import ResetNeeded

    with pytest.raises(ResetNeeded):
        drive(supersuit.black_death_v3(scalars()))


@row(
    "`color_reduction_v0`, `resize_v1`",
    breaks="AssertionError: they need images",
    whose="SuperSuit: made for images",
)
def test_wrappers_of_images_refuse_vectors() -> None:
    import supersuit

    with pytest.raises(AssertionError):
        supersuit.color_reduction_v0(parallel())
    with pytest.raises(AssertionError):
        supersuit.resize_v1(parallel(), 4, 4)


@row(
    "`pettingzoo_env_to_vec_env_v1`, `concat_vec_envs_v1`",
    how="`keep_finished=True`; scalar rewards for Stable-Baselines3",
    breaks="without: AssertionError when one vehicle leaves before the other",
    whose="SuperSuit: the number of agents is constant",
)
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

    with pytest.raises(AssertionError, match="varying numbers of active agents"):
        drive_vector(vehicles(scalars(harmful_g_force=0.1)))
    assert drive_vector(vehicles(scalars(harmful_g_force=0.1, keep_finished=True))).shape == (4,)


@row("`gym_vec_env_v0`, `stable_baselines3_vec_env_v0`", how="`UtilityReward`")
def test_its_vector_environments_of_gymnasium_environments() -> None:
    import supersuit

    env = supersuit.gym_vec_env_v0(scalar(), 2)
    env.reset(seed=0)
    assert env.step(np.array([3, 3]))[1].shape == (2,)
    pytest.importorskip("stable_baselines3")
    env = supersuit.stable_baselines3_vec_env_v0(scalar(), 2)
    env.reset()
    assert env.step(np.array([3, 3]))[1].shape == (2,)


@row("`vectorize_aec_env_v0`")
def test_aec_environments_are_vectorised() -> None:
    import supersuit

    many = supersuit.vectorize_aec_env_v0(aec(), 2)
    many.reset(seed=0)
    for _ in range(10):
        many.step([0, 0])
        assert many.last()[1].shape == (2, 6)


OTHERS = {"agent_indicator_v0", "black_death_v3", "clip_reward_v0", "color_reduction_v0", "concat_vec_envs_v1"}
OTHERS |= {"frame_skip_v0", "gym_vec_env_v0", "pettingzoo_env_to_vec_env_v1", "resize_v1"}
OTHERS |= {"stable_baselines3_vec_env_v0", "vectorize_aec_env_v0"}
OTHERS |= {"stable_baselines_vec_env_v0"}  # of Stable-Baselines 2, which needs TensorFlow 1


def test_every_wrapper_of_supersuit_is_covered() -> None:
    import supersuit

    public = {name for name in dir(supersuit) if name.rpartition("_v")[2].isdigit()}
    assert public == {*WRAPPERS, *OTHERS}
