"""Stable-Baselines3: scalar rewards, by ``UtilityReward``, and by ``VectorUtilityReward`` in its vector environment."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest

import mo_deepdrive
from mo_deepdrive.wrappers import ParallelUtilityReward, UtilityReward, VectorUtilityReward
from tests.integrations.envs import INTERSECTION, ONE_WAYPOINT, TWO, scalar, single, vector

pytestmark = pytest.mark.filterwarnings("ignore")
PPO_ARGUMENTS = {"n_steps": 64, "batch_size": 32, "n_epochs": 1}
OFF_POLICY = {"learning_starts": 50, "batch_size": 32}
ALGORITHMS: dict[str, tuple[str, dict[str, Any]]] = {
    "A2C": ("discrete", {}),
    "PPO": ("discrete", PPO_ARGUMENTS),
    "DQN": ("discrete", OFF_POLICY),
    "A2C, continuous": ("continuous", {}),
    "PPO, continuous": ("continuous", PPO_ARGUMENTS),
    "SAC": ("continuous", OFF_POLICY),
    "TD3": ("continuous", OFF_POLICY),
    "DDPG": ("continuous", OFF_POLICY),
}


def batch(utility: str = "one_waypoint_nonlinear", num_envs: int = 3, **options: Any) -> Any:
    """The native environments as its vector environment."""
    from mo_deepdrive.envs.sb3 import SB3VecEnv

    envs = VectorUtilityReward(vector(num_envs=num_envs, autoreset_mode="SameStep", **options), utility, of="return")
    return SB3VecEnv(envs)


@pytest.mark.parametrize("end", ["time_limit", "harmful_g_force"])
@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
def test_our_vector_environment_returns_what_theirs_does_over_several_episodes(action_type: str, end: str) -> None:
    from stable_baselines3.common.vec_env import DummyVecEnv

    truncated = end == "time_limit"
    options = {"action_type": action_type, "time_limit": 2.0 if truncated else 30.0}
    options |= {} if truncated else {"harmful_g_force": 0.1}

    def make() -> Any:
        return UtilityReward(single(**options), "one_waypoint_nonlinear", of="return")

    ours, theirs = batch(**options), DummyVecEnv([make] * 3)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    for env in (ours, theirs):
        env.seed(7)
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    ours.action_space.seed(0)
    ends = {True: 0, False: 0}
    for _ in range(80):
        actions = np.array([ours.action_space.sample() for _ in range(3)])
        (*mine, my_infos), (*other, their_infos) = ours.step(actions), theirs.step(actions)
        for one, two in zip(mine, other, strict=True):
            np.testing.assert_array_equal(one, two)
            assert one.dtype == two.dtype
        for i, (info, expected) in enumerate(zip(my_infos, their_infos, strict=True)):
            if not mine[2][i]:
                assert expected.pop("TimeLimit.truncated") is False
            assert info.keys() == expected.keys()
            for name, value in expected.items():
                np.testing.assert_array_equal(info[name], value)
            if mine[2][i]:
                ends[info["TimeLimit.truncated"]] += 1
    assert ends[truncated] >= 3
    assert ends[not truncated] == 0


@pytest.mark.parametrize("name", ["A2C", "PPO", "DQN", "SAC"])
def test_an_algorithm_trains_on_our_vector_environment(name: str) -> None:
    import stable_baselines3
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

    action_type, arguments = ALGORITHMS[name]
    envs = VecNormalize(VecMonitor(batch("one_waypoint_linear", action_type=action_type)))
    model = getattr(stable_baselines3, name)("MlpPolicy", envs, seed=0, device="cpu", **arguments).learn(300)
    assert model.num_timesteps >= 300
    assert len(model.ep_info_buffer) >= 5
    assert np.isfinite(evaluate_policy(model, envs, 2)[0])


def test_our_vector_environment_passes_on_attributes_options_and_frames() -> None:
    envs = batch(render_mode="rgb_array")
    assert envs.get_attr("objectives", [0, 2]) == [envs.envs.unwrapped.objectives] * 2
    assert envs.get_attr("utility")[0] is envs.envs.utility
    assert envs.render().shape[2] == 3
    envs.set_options({"destination": (25.0, 30.0)})
    first = envs.reset()
    np.testing.assert_array_equal(first[0, :2], first[1, :2])
    assert not np.array_equal(envs.reset()[0, :2], envs.reset()[1, :2])
    for call in (envs.set_attr, envs.env_method):
        with pytest.raises(AttributeError, match="'gravity' of single environments is out of reach"):
            call("gravity", 1.0)


def test_what_it_cannot_learn_from_is_refused() -> None:
    from mo_deepdrive.envs.sb3 import SB3VecEnv

    with pytest.raises(ValueError, match=r"autoreset_mode = .*NEXT_STEP must be SAME_STEP"):
        SB3VecEnv(vector())
    for env_id, shape in ((ONE_WAYPOINT, r"\(3, 4\)"), (INTERSECTION, r"\(3, 2, 6\)")):
        envs = SB3VecEnv(vector(env_id, autoreset_mode="SameStep"))
        envs.reset()
        with pytest.raises(ValueError, match=rf"rewards of shape {shape} must be \(3,\): .*VectorUtilityReward"):
            envs.step(envs.envs.action_space.sample())
    envs = batch()
    envs.set_options([{"destination": (25.0, 30.0)}, {}, {}])
    with pytest.raises(ValueError, match="must be the same for all environments"):
        envs.reset()


@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
def test_the_checker_has_no_objections(action_type: str) -> None:
    from stable_baselines3.common.env_checker import check_env

    env = scalar(action_type=action_type)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_an_algorithm_trains(name: str) -> None:
    import stable_baselines3

    action_type, arguments = ALGORITHMS[name]
    env = scalar(action_type=action_type)
    algorithm = getattr(stable_baselines3, name.partition(",")[0])
    model = algorithm("MlpPolicy", env, seed=0, device="cpu", **arguments).learn(200)
    assert model.num_timesteps >= 200
    assert len(model.ep_info_buffer) >= 5
    assert all(math.isfinite(info["r"]) for info in model.ep_info_buffer)


def test_its_vector_environments_and_its_evaluation_run() -> None:
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import VecNormalize

    env = VecNormalize(make_vec_env(scalar, 2))
    model = PPO("MlpPolicy", env, seed=0, device="cpu", n_steps=32, batch_size=32, n_epochs=1).learn(128)
    mean, _ = evaluate_policy(model, Monitor(scalar()), 2)
    assert np.isfinite(mean)


def test_two_vehicles_learn_one_policy() -> None:
    supersuit = pytest.importorskip("supersuit")
    from stable_baselines3 import PPO

    env = ParallelUtilityReward(mo_deepdrive.parallel_env(keep_finished=True, **TWO), "intersection_linear")
    vehicles = supersuit.pettingzoo_env_to_vec_env_v1(env)
    envs = supersuit.concat_vec_envs_v1(vehicles, 2, num_cpus=0, base_class="stable_baselines3")
    model = PPO("MlpPolicy", envs, device="cpu", n_steps=32, batch_size=32, n_epochs=1).learn(256)
    assert envs.num_envs == 4
    assert model.num_timesteps == 256
