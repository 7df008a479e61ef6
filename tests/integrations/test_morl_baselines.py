"""morl-baselines on the ids: algorithms that are not among those of ``tests/peers``, and other ways to make them."""

from __future__ import annotations

import copy
import functools
import importlib
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from mo_gymnasium.wrappers.vector import MOSyncVectorEnv

from tests.integrations.envs import ONE_WAYPOINT, single, vector

pytestmark = [pytest.mark.filterwarnings("ignore"), pytest.mark.slow]
STEPS = 200
REFERENCE = np.array([-1.0, -1.0, -100.0, -10_000.0], dtype=np.float32)
SEEDED: dict[str, Any] = {"log": False, "seed": 0}
TORCH: dict[str, Any] = {**SEEDED, "device": "cpu"}
SMALL: dict[str, Any] = {"net_arch": [8, 8], "batch_size": 4, "buffer_size": STEPS}
FRONT: dict[str, Any] = {"num_eval_weights_for_front": 4, "num_eval_episodes_for_front": 1}


def discrete() -> Any:
    return single(fixed_destination=True)


def continuous() -> Any:
    return single(fixed_destination=True, action_type="continuous")


def two_objectives() -> Any:
    return single(objectives=("distance", "jerk"))


def of_library(path: str) -> Any:
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(f"morl_baselines.{module}"), name)


@pytest.fixture(autouse=True)
def _seeded() -> None:
    """Some algorithms draw from the global generators."""
    torch = pytest.importorskip("torch")
    torch.manual_seed(0)
    np.random.seed(0)  # noqa: NPY002


@pytest.mark.parametrize(
    ("path", "make"),
    [
        ("multi_policy.gpi_ls_jax.gpi_ls_jax:GPILS", discrete),
        ("multi_policy.gpi_ls_jax.gpi_ls_continuous_action_jax:GPILSContinuousAction", continuous),
    ],
)
def test_gpi_ls_in_jax_trains(path: str, make: Callable[[], Any]) -> None:
    for module in ("jax", "flax", "optax"):
        pytest.importorskip(module)
    agent = of_library(path)(make(), gradient_updates=1, learning_starts=50, **SMALL, **SEEDED)
    agent.train(STEPS, make(), REFERENCE, timesteps_per_iter=100, checkpoints=False, **FRONT)
    assert agent.global_step == STEPS


def make_pgmorl(env_id: Any, **more: Any) -> Any:
    return of_library("multi_policy.pgmorl.pgmorl:PGMORL")(
        env_id=env_id,
        origin=REFERENCE[[0, 3]],
        num_envs=2,
        pop_size=4,
        delta_weight=0.25,
        warmup_iterations=1,
        evolutionary_iterations=2,
        steps_per_iteration=16,
        num_performance_buffer=3,
        num_minibatches=4,
        update_epochs=1,
        net_arch=[8],
        **TORCH,
        **more,
    )


def specification(**arguments: Any) -> Any:
    """An id with arguments: ``mo_gymnasium.make`` takes it, too."""
    spec = copy.deepcopy(gymnasium.spec(ONE_WAYPOINT))
    spec.kwargs = {**spec.kwargs, "time_limit": 2.0, "action_type": "continuous", **arguments}
    return spec


def test_pgmorl_trains_on_a_specification() -> None:
    agent = make_pgmorl(specification(objectives=("distance", "jerk")))
    evaluated = single(objectives=("distance", "jerk"), action_type="continuous")
    agent.train(STEPS, evaluated, REFERENCE[[0, 3]])
    assert len(agent.archive.individuals) >= 1


@pytest.mark.parametrize(
    ("path", "make", "envs"),
    [
        ("ipro:IPRO", discrete, lambda: MOSyncVectorEnv([discrete] * 2)),
        ("ipro:IPRO", discrete, vector),
        ("ipro_2d:IPRO2D", two_objectives, lambda: MOSyncVectorEnv([two_objectives] * 2)),
    ],
    ids=["IPRO", "IPRO on make_vec", "IPRO-2D"],
)
def test_ipro_trains(path: str, make: Callable[[], Any], envs: Callable[[], Any]) -> None:
    env = make()
    chosen = REFERENCE if env.unwrapped.reward_dim == 4 else REFERENCE[[0, 3]]
    small = {"iter_total_timesteps": 64, "num_steps": 16, "num_minibatches": 1, "update_epochs": 1}
    agent = of_library(f"multi_policy.ipro.{path}")(envs(), max_iterations=1, **small, **TORCH)
    # By default it evaluates a hundred episodes after every round.
    agent.agent.policy_evaluate = functools.partial(agent.agent.policy_evaluate, eval_episodes=1)
    assert len(agent.train(env, ref_point=chosen, deterministic=True)) >= 1


@pytest.mark.parametrize("envs", [lambda: MOSyncVectorEnv([discrete] * 2), vector], ids=["MOSyncVectorEnv", "make_vec"])
def test_nlmoppo_trains(envs: Callable[[], Any]) -> None:
    small = {"total_timesteps": STEPS, "num_steps": 16, "num_minibatches": 1, "update_epochs": 1}
    agent = of_library("single_policy.ser.nl_mo_ppo:NLMOPPO")(0, envs(), **small, **TORCH)
    agent.policy_evaluate = functools.partial(agent.policy_evaluate, eval_episodes=1)
    returns = np.asarray(agent.train(discrete(), u_func=lambda returns: returns.sum(-1)))
    assert returns.shape == (4,)
    assert np.isfinite(returns).all()


@pytest.mark.parametrize("name", ["MOSAC", "MOSACDiscrete", "MOPPO"])
def test_single_policies_train(name: str) -> None:
    import torch

    weights = np.full(4, 0.25, dtype=np.float32)
    if name == "MOPPO":
        envs = MOSyncVectorEnv([continuous] * 2)
        shapes = envs.single_observation_space.shape, envs.single_action_space.shape
        networks = of_library("single_policy.ser.mo_ppo:MOPPONet")(*shapes, 4, [8])
        small = {"steps_per_iteration": 16, "num_minibatches": 2, "update_epochs": 1}
        agent = of_library("single_policy.ser.mo_ppo:MOPPO")(0, networks, weights, envs, device="cpu", **small)
        agent.train(time.time(), 0, 1)
        return
    module, make = {
        "MOSAC": ("mosac_continuous_action", continuous),
        "MOSACDiscrete": ("mosac_discrete_action", discrete),
    }[name]
    agent = of_library(f"single_policy.ser.{module}:{name}")(
        make(), weights=weights, scalarization=torch.matmul, learning_starts=50, **SMALL, **TORCH
    )
    agent.train(STEPS, eval_env=make())
    assert agent.global_step == STEPS


def test_tabular_q_learning_trains() -> None:
    def tabular() -> Any:
        env = gymnasium.wrappers.DiscretizeObservation(discrete(), 4, multidiscrete=True)
        env.action_space.seed(0)  # from which the learner explores
        return env

    learner = of_library("single_policy.ser.mo_q_learning:MOQLearning")(tabular(), weights=np.full(4, 0.25), **SEEDED)
    learner.train(time.time(), STEPS, eval_env=tabular(), eval_freq=100)
    assert len(learner.q_table) >= 10
    path = "multi_policy.multi_policy_moqlearning.mp_mo_q_learning:MPMOQLearning"
    agent = of_library(path)(tabular(), **SEEDED)
    agent.train(STEPS, tabular(), REFERENCE, timesteps_per_iteration=100, **FRONT)
