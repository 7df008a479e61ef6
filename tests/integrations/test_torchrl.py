"""TorchRL: its Gymnasium and PettingZoo environments."""

from __future__ import annotations

from typing import Any

import pytest

import mo_deepdrive
from mo_deepdrive.wrappers import ParallelUtilityReward
from tests.integrations.envs import ONE_WAYPOINT, SHORT, TWO, scalar, single, vector

pytestmark = pytest.mark.filterwarnings("ignore")


def checked_rewards(env: Any, steps: int = 60) -> tuple[int, ...]:
    """TorchRL's own check of an environment, and the shape of the rewards of a rollout over several episodes."""
    from torchrl.envs.utils import check_env_specs

    check_env_specs(env)
    return tuple(env.rollout(steps, break_when_any_done=False)["next", "reward"].shape)


@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
def test_vector_rewards_of_the_ids(action_type: str) -> None:
    from torchrl.envs.libs.gym import MOGymEnv, MOGymWrapper

    assert checked_rewards(MOGymEnv(ONE_WAYPOINT, action_type=action_type, **SHORT)) == (60, 4)
    assert checked_rewards(MOGymWrapper(single(action_type=action_type))) == (60, 4)


def test_the_wrappers_of_gymnasium_have_the_vector_rewards() -> None:
    from torchrl.envs import GymEnv, GymWrapper

    assert checked_rewards(GymEnv(ONE_WAYPOINT, **SHORT)) == (60, 4)
    assert checked_rewards(GymWrapper(single())) == (60, 4)


@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
def test_scalar_rewards_by_the_utility(action_type: str) -> None:
    from torchrl.envs import GymWrapper

    assert checked_rewards(GymWrapper(scalar(action_type=action_type))) == (60, 1)


def test_environments_are_batched() -> None:
    from torchrl.envs import SerialEnv
    from torchrl.envs.libs.gym import MOGymEnv

    assert checked_rewards(SerialEnv(2, lambda: MOGymEnv(ONE_WAYPOINT, **SHORT))) == (2, 60, 4)


@pytest.mark.parametrize("name", ["GymWrapper", "MOGymWrapper"])
def test_the_native_vector_environment(name: str) -> None:
    from torchrl.envs.libs import gym

    wrap = getattr(gym, name)
    assert checked_rewards(wrap(vector(autoreset_mode="SameStep"))) == (3, 60, 4)


def test_the_parallel_environment_needs_the_utility() -> None:
    from torchrl.envs.libs.pettingzoo import PettingZooWrapper
    from torchrl.envs.utils import check_env_specs

    env = ParallelUtilityReward(mo_deepdrive.parallel_env(**TWO), "intersection_linear")
    wrapped = PettingZooWrapper(env, use_mask=True)
    check_env_specs(wrapped)
    assert tuple(wrapped.rollout(15)["next", "vehicle", "reward"].shape) == (15, 2, 1)
