"""morl-baselines: every algorithm directly on the ids, without the adapters of ``algorithms/peers``."""

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
from tests.integrations.matrix import Library, row

LIBRARY = Library(
    "morl-baselines",
    "morl-baselines",
    "morl_baselines",
    "`PCN(mo_gymnasium.make(id), ...)`; or by name: [peers](peers.md)",
)

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


def train_conditioned(path: str, make: Callable[[], Any]) -> None:
    # Returns of costs are at most zero.
    agent = of_library(path)(
        make(), scaling_factor=np.array([0.1, 1, 0.1, 0.01, 0.1]), hidden_dim=8, batch_size=8, **TORCH
    )
    agent.train(
        STEPS,
        eval_env=make(),
        ref_point=REFERENCE,
        num_er_episodes=3,
        num_step_episodes=1,
        num_model_updates=2,
        max_return=np.array([100.0, 1.0, 0.0, 0.0], dtype=np.float32),
        num_points_pf=1,
    )
    assert len(agent.experience_replay) >= 3


@row("PCN, LCN", how="`max_return=` with 0 for costs; both write files into the working directory")
@pytest.mark.parametrize(
    ("path", "make"),
    [
        ("multi_policy.pcn.pcn:PCN", discrete),
        ("multi_policy.pcn.pcn:PCN", continuous),
        ("multi_policy.lcn.lcn:LCN", discrete),
    ],
)
def test_algorithms_conditioned_on_returns_train(path: str, make: Callable[[], Any]) -> None:
    train_conditioned(path, make)


@row("Envelope")
def test_envelope_trains() -> None:
    agent = of_library("multi_policy.envelope.envelope:Envelope")(discrete(), num_sample_w=2, **SMALL, **TORCH)
    agent.train(STEPS, eval_env=discrete(), ref_point=REFERENCE, **FRONT)
    assert agent.global_step == STEPS


@row("GPI-LS, discrete and continuous actions")
@pytest.mark.parametrize(
    ("path", "make"),
    [
        ("multi_policy.gpi_pd.gpi_pd:GPILS", discrete),
        ("multi_policy.gpi_pd.gpi_pd_continuous_action:GPILSContinuousAction", continuous),
    ],
)
def test_gpi_ls_trains(path: str, make: Callable[[], Any]) -> None:
    agent = of_library(path)(make(), gradient_updates=1, **SMALL, **TORCH)
    agent.train(STEPS, make(), REFERENCE, timesteps_per_iter=100, checkpoints=False, **FRONT)
    assert agent.global_step == STEPS


@row("GPI-LS in JAX, discrete and continuous actions", how='`pip install "morl-baselines[gpi-ls-jax]"`')
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


@row("CAPQL")
def test_capql_trains() -> None:
    agent = of_library("multi_policy.capql.capql:CAPQL")(continuous(), learning_starts=50, **SMALL, **TORCH)
    agent.train(STEPS, continuous(), REFERENCE, **FRONT)
    assert agent.global_step == STEPS


@row("MORL/D with MOSAC and MOSACDiscrete")
@pytest.mark.parametrize(("policy", "make"), [("MOSAC", continuous), ("MOSACDiscrete", discrete)])
def test_morld_trains(policy: str, make: Callable[[], Any]) -> None:
    agent = of_library("multi_policy.morld.morld:MORLD")(
        make(),
        policy_name=policy,
        pop_size=4,
        weight_init_method="random",
        exchange_every=50,
        update_passes=1,
        policy_args={**SMALL, "learning_starts": 20},
        **TORCH,
    )
    agent.train(STEPS, make(), REFERENCE, num_eval_episodes_for_front=1, checkpoints=False)
    assert len(agent.archive.individuals) >= 1


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


@row(
    "PGMORL",
    how="`env_id=spec`: `gymnasium.spec(id)` with `action_type` and two or three `objectives` in its `kwargs`",
)
def test_pgmorl_trains_on_a_specification() -> None:
    agent = make_pgmorl(specification(objectives=("distance", "jerk")))
    evaluated = single(objectives=("distance", "jerk"), action_type="continuous")
    agent.train(STEPS, evaluated, REFERENCE[[0, 3]])
    assert len(agent.archive.individuals) >= 1


@row("IPRO, IPRO-2D", how="`MOSyncVectorEnv` or `make_vec(id)`; IPRO-2D with two `objectives`")
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


@row("NLMOPPO", how="`MOSyncVectorEnv` or `make_vec(id)`")
@pytest.mark.parametrize("envs", [lambda: MOSyncVectorEnv([discrete] * 2), vector], ids=["MOSyncVectorEnv", "make_vec"])
def test_nlmoppo_trains(envs: Callable[[], Any]) -> None:
    small = {"total_timesteps": STEPS, "num_steps": 16, "num_minibatches": 1, "update_epochs": 1}
    agent = of_library("single_policy.ser.nl_mo_ppo:NLMOPPO")(0, envs(), **small, **TORCH)
    agent.policy_evaluate = functools.partial(agent.policy_evaluate, eval_episodes=1)
    agent.train(discrete(), u_func=lambda returns: returns.sum(-1))


@row(
    "EUPG",
    how="a buffer of floats: `agent.buffer = AccruedRewardReplayBuffer(..., obs_dtype=np.float32)`, as in our adapter",
)
def test_eupg_trains() -> None:
    agent = of_library("single_policy.esr.eupg:EUPG")(
        discrete(), scalarization=lambda vector, weights=None: vector.sum(), weights=np.ones(4), net_arch=[8], **TORCH
    )
    agent.train(STEPS)
    assert agent.global_step == STEPS


@row("MOSAC, MOSACDiscrete, MOPPO")
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


@row(
    "MO Q-learning, MPMOQLearning", how="with `DiscretizeObservation(env, bins, multidiscrete=True)`: they are tabular"
)
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
