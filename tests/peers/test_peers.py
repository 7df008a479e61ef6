"""Algorithms of other libraries, in a separate virtual environment: `make test-peers`."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import mo_gymnasium
import numpy as np
import pytest
import torch

from algorithms.peers import PEERS, PeerTask
from algorithms.peers.peer_task import PeerPolicies, Recorder
from algorithms.runs.config import make_experiment
from algorithms.runs.jobs import Job, perform
from mo_deepdrive.evaluation.env_adapter import EnvAdapter, make_env
from mo_deepdrive.evaluation.episodes import evaluate, evaluate_each
from mo_deepdrive.utilities import make_utility
from mo_deepdrive.wrappers import UtilityReward
from tests.helpers.short_runs import VALUES, metrics

ONE_WAYPOINT = "mo-deepdrive-one-waypoint-v0"
SEA = "deep-sea-treasure-v0"
STEPS = 300
GAMMA = 0.99

# Minimal networks and batches: these tests check the interfaces, not learning.
CONDITIONED = {
    "arguments": {"hidden_dim": 8, "batch_size": 8},
    "train_arguments": {"num_er_episodes": 3, "num_step_episodes": 1, "num_model_updates": 2},
}
GPI_LS = {
    "policies": 5,
    "arguments": {"net_arch": [8, 8], "batch_size": 4, "gradient_updates": 1},
    "train_arguments": {"timesteps_per_iter": 150},
}
SMALL: dict[str, dict[str, Any]] = {
    "morl_baselines.pcn": CONDITIONED,
    "morl_baselines.lcn": CONDITIONED,
    "morl_baselines.envelope": {
        "policies": 5,
        "arguments": {"net_arch": [8], "batch_size": 4, "num_sample_w": 2},
    },
    "morl_baselines.gpi_ls": GPI_LS,
    "morl_baselines.gpi_ls_continuous": GPI_LS,
    "morl_baselines.capql": {
        "policies": 5,
        "arguments": {"net_arch": [8, 8], "batch_size": 4, "learning_starts": 50},
    },
    "morl_baselines.morld": {
        "arguments": {
            "pop_size": 4,
            "weight_init_method": "random",
            "exchange_every": 100,
            "update_passes": 1,
            "policy_args": {"net_arch": [8, 8], "batch_size": 4, "buffer_size": STEPS, "learning_starts": 50},
        }
    },
    "morl_baselines.pgmorl": {
        "arguments": {
            "pop_size": 4,  # fewer and its predictor finds no neighbours
            "delta_weight": 0.25,
            "warmup_iterations": 1,
            "num_performance_buffer": 3,
            "num_minibatches": 4,
            "update_epochs": 1,
            "net_arch": [8],
        }
    },
    "morl_baselines.ipro": {"arguments": {"num_minibatches": 1, "update_epochs": 1, "max_iterations": 1}},
    "morl_baselines.eupg": {"arguments": {"net_arch": [8]}},
    "morl_baselines.nl_mo_ppo": {"arguments": {"num_minibatches": 1, "update_epochs": 1}},
    "stable_baselines3.a2c": {},
    "stable_baselines3.ppo": {"arguments": {"n_steps": 32, "batch_size": 32, "n_epochs": 1}},
}


def require(name: str) -> None:
    """Skip the test if the library of a peer is not installed."""
    pytest.importorskip(name.partition(".")[0], reason=f"{PEERS[name].package} is not installed: make test-peers")
    assert PEERS[name].unavailable_reason() is None


def make_task(name: str, env_id: str = ONE_WAYPOINT, *, kind: str | None = None, **settings: Any) -> PeerTask:
    """A short task that the peer supports."""
    peer = PEERS[name]
    arguments: dict[str, Any] = {}
    if env_id == ONE_WAYPOINT:
        # Short episodes with a fixed destination.
        arguments = {"fixed_destination": True, "time_limit": 6.0, "action_type": kind or peer.actions[0]}
        if peer.objectives is not None:
            arguments["objectives"] = ("distance", "jerk")
    env = EnvAdapter(make_env(env_id, 2 if peer.parallel else 1, arguments))
    d = len(env.objectives)
    utility = None
    if peer.known_utility:
        linear = "one_waypoint_linear" if d == 4 else "linear"
        utility = make_utility(linear, env.objectives, **({} if d == 4 else {"weights": [1.0] * d}))
    return PeerTask(
        make_single_env=lambda **more: mo_gymnasium.make(env_id, **arguments, **more),
        env=env,
        config=peer.Config(**{**SMALL[name], **settings}),
        utility=utility,
        steps=STEPS,
        seed=0,
        device="cpu",
        reference_point=-100.0 * env.objective_scales,
        recorder=Recorder(env.objectives, utility, 100, lambda step, metrics: None),
    )


def train(name: str, task: PeerTask) -> PeerPolicies:
    """Train a peer without its output."""
    torch.manual_seed(0)
    np.random.seed(0)  # noqa: NPY002
    PEERS[name].check(name, task)
    with contextlib.redirect_stdout(io.StringIO()):
        return PEERS[name].train(task)


def evaluation_env(task: PeerTask, num_envs: int) -> Any:
    own: Any = task.env.vector_env.unwrapped
    if not task.env.native:
        return make_env(own.envs[0].unwrapped.spec.id, num_envs)
    return make_env(ONE_WAYPOINT, num_envs, own.config.model_dump(exclude={"scenario"}))


CASES = [(name, kind) for name, peer in PEERS.items() for kind in peer.actions]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("name", "kind"), CASES)
def test_a_peer_trains_and_its_policies_can_be_evaluated(name: str, kind: str) -> None:
    require(name)
    task = make_task(name, kind=kind)
    policies = train(name, task)
    assert task.recorder.steps >= STEPS // 2
    assert len(policies) >= 1
    assert policies.conditions.shape == (len(policies), len(policies.condition_names))
    env = evaluation_env(task, 4)
    if PEERS[name].known_utility:
        policy = policies.at(np.zeros(1, dtype=np.intp))
        first, second, sampled = (evaluate(policy, env, episodes=3, greedy=greedy) for greedy in (True, True, False))
        np.testing.assert_array_equal(first.returns, second.returns)
        assert np.isfinite(sampled.metrics()["utility_esr"])
    else:
        found = evaluate_each(policies.at, len(policies), env, episodes=2, seed=1_000_000, gamma=GAMMA)
        assert len(found) == len(policies)
        for evaluation in found:
            # All episodes are equal, and so are greedy actions.
            np.testing.assert_allclose(evaluation.returns[0], evaluation.returns[1], rtol=1e-4)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["morl_baselines.pcn", "morl_baselines.envelope", "morl_baselines.nl_mo_ppo"])
def test_a_peer_trains_on_another_environment(name: str) -> None:
    require(name)
    task = make_task(name, SEA)
    policies = train(name, task)
    found = evaluate_each(policies.at, len(policies), evaluation_env(task, 4), episodes=1, seed=0, gamma=GAMMA)
    assert all(np.isfinite(each.returns).all() for each in found)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("scales", [True, False])
def test_the_policies_of_pcn_act_as_in_its_own_evaluation(scales: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "morl_baselines.pcn"
    require(name)
    from morl_baselines.multi_policy.pcn.pcn import PCN

    agents: list[Any] = []
    own_init = PCN.__init__

    def remember(self: Any, *args: Any, **kwargs: Any) -> None:
        own_init(self, *args, **kwargs)
        agents.append(self)

    monkeypatch.setattr(PCN, "__init__", remember)
    task = make_task(name, nominal_scales=scales)
    policies = train(name, task)
    env, max_return = task.make(recorded=False), np.array([100.0, 100.0, 0.0, 0.0], dtype=np.float32)
    expected = []
    for *desired, horizon in policies.conditions:
        wanted = (np.array(desired) / task.reward_scales).astype(np.float32)
        with torch.no_grad():
            episode = agents[0]._run_episode(env, wanted, np.float32(horizon), max_return, eval_mode=True)
        expected.append(np.sum([step.reward for step in episode], axis=0) * task.reward_scales)
    found = evaluate_each(policies.at, len(policies), evaluation_env(task, 3), episodes=1, seed=1_000_000, gamma=GAMMA)
    np.testing.assert_allclose([each.returns[0, 0] for each in found], expected, rtol=1e-3, atol=1e-3)


@pytest.mark.filterwarnings("ignore")
def test_stable_baselines3_accepts_the_wrapped_environment() -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="not installed: make test-peers")
    task = make_task("stable_baselines3.ppo")
    checker.check_env(UtilityReward(task.make(scaled_rewards=False), "one_waypoint_linear"))
    checker.check_env(UtilityReward(mo_gymnasium.make(ONE_WAYPOINT, action_type="continuous"), "one_waypoint_linear"))


@pytest.mark.filterwarnings("ignore")
def test_the_same_seeds_give_the_same_policies() -> None:
    name = "stable_baselines3.a2c"
    require(name)
    returns = []
    for _ in range(2):
        task = make_task(name)
        policy = train(name, task).at(np.zeros(1, dtype=np.intp))
        returns.append(evaluate(policy, evaluation_env(task, 2), episodes=2).returns)
    np.testing.assert_array_equal(*returns)


def test_gpi_ls_evaluates_corner_weights_once_per_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    require("morl_baselines.gpi_ls")
    from morl_baselines.multi_policy.linear_support import linear_support

    evaluated, evaluate_policy = [], linear_support.policy_evaluation_mo

    def counted(agent: Any, env: Any, weight: Any, rep: int) -> Any:
        evaluated.append((agent.global_step, *weight))
        return evaluate_policy(agent, env, weight, rep=rep)

    monkeypatch.setattr(linear_support, "policy_evaluation_mo", counted)
    train("morl_baselines.gpi_ls", make_task("morl_baselines.gpi_ls"))
    assert len(evaluated) > 1
    assert len(set(evaluated)) == len(evaluated)
    assert linear_support.policy_evaluation_mo is counted


def test_a_job_trains_a_peer_and_one_that_was_interrupted_begins_anew(tmp_path: Path) -> None:
    require("stable_baselines3.ppo")
    values = {
        **VALUES,
        "algorithm": {"name": "stable_baselines3.ppo", **SMALL["stable_baselines3.ppo"]},
        "training": {"total_timesteps": 64, "num_envs": 2},
    }
    jobs = [Job(name, make_experiment(values), tmp_path / name, name) for name in ("whole", "interrupted")]
    for job in jobs:
        assert perform(job) == "trained"
    run = jobs[1].open()
    run.set_status("interrupted", 0)
    assert perform(jobs[1]) == "trained"
    assert perform(jobs[1]) == "already there"
    assert metrics(jobs[1].path) == metrics(jobs[0].path)
    assert (jobs[1].path / "evaluation.csv").read_bytes() == (jobs[0].path / "evaluation.csv").read_bytes()
