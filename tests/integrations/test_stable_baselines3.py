"""Stable-Baselines3: scalar rewards, by ``UtilityReward``."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest

import mo_deepdrive
from mo_deepdrive.wrappers import ParallelUtilityReward
from tests.integrations.envs import SHORT, scalar
from tests.integrations.matrix import Library, row

LIBRARY = Library(
    "Stable-Baselines3",
    "stable-baselines3",
    "stable_baselines3",
    '`PPO("MlpPolicy", UtilityReward(mo_gymnasium.make(id), utility))`',
)

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


@row("`check_env`", how="on `UtilityReward`: no warning")
@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
def test_the_checker_has_no_objections(action_type: str) -> None:
    from stable_baselines3.common.env_checker import check_env

    env = scalar(action_type=action_type)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env)


@row("A2C, PPO (discrete and continuous actions), DQN, SAC, TD3, DDPG")
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


@row("`evaluate_policy`, `make_vec_env`, `VecNormalize`, `Monitor`", how="the environment is a function: `lambda: ...`")
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


@row(
    "two vehicles that share a policy",
    how="`ParallelUtilityReward`, then SuperSuit's `concat_vec_envs_v1`, and no `seed=` for the algorithm",
)
def test_two_vehicles_learn_one_policy() -> None:
    supersuit = pytest.importorskip("supersuit")
    from stable_baselines3 import PPO

    env = ParallelUtilityReward(mo_deepdrive.parallel_env(keep_finished=True, **SHORT), "intersection_linear")
    vehicles = supersuit.pettingzoo_env_to_vec_env_v1(env)
    envs = supersuit.concat_vec_envs_v1(vehicles, 2, num_cpus=0, base_class="stable_baselines3")
    model = PPO("MlpPolicy", envs, device="cpu", n_steps=32, batch_size=32, n_epochs=1).learn(256)
    assert envs.num_envs == 4
    assert model.num_timesteps == 256
