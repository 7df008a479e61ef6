"""Training on a GPU repeats with its seed, resumes bit for bit, and its policies drive on the CPU.

Skipped where PyTorch finds no CUDA device.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from algorithms import ALGORITHMS, FrontAgent
from algorithms.experiments.build import build
from algorithms.experiments.config import make_experiment
from mo_deepdrive.evaluation.accrued_reward import AccruedReward
from tests.helpers.agents import CONTINUOUS, INTERSECTION, LEFT_TURN, ONE_WAYPOINT, SEA
from tests.helpers.short_agents import STEPS, check_resumed, trained

pytestmark = [pytest.mark.slow, pytest.mark.gpu]
# Algorithm, environment, its arguments, and what differs from the defaults.
LEARNERS: dict[str, tuple[str, str, dict[str, Any], dict[str, Any]]] = {
    "a2c": ("a2c", ONE_WAYPOINT, {}, {}),
    "ppo, continuous": ("ppo", ONE_WAYPOINT, CONTINUOUS, {}),
    "ppo, two vehicles, central": ("ppo", INTERSECTION, {}, {"centralised_critic": True}),
    "mo_a2c": ("mo_a2c", ONE_WAYPOINT, {}, {}),
    "mo_a2c, gradient": ("mo_a2c", ONE_WAYPOINT, {}, {"advantage": "utility_gradient"}),
    "mo_a2c, deep-sea-treasure": ("mo_a2c", SEA, {}, {}),
    "mo_ppo": ("mo_ppo", LEFT_TURN, {}, {}),
    "mo_ppo, expected utility": ("mo_ppo", ONE_WAYPOINT, CONTINUOUS, {"advantage": "expected_utility"}),
    "mo_ppo, state-dependent": ("mo_ppo", ONE_WAYPOINT, CONTINUOUS, {"state_dependent_std": True}),
    "mocac, particles": ("mocac", ONE_WAYPOINT, {}, {}),
    "mocac, categorical": ("mocac", SEA, {}, {"critic": "categorical"}),
    "mappo": ("mappo", INTERSECTION, {}, {}),
    "conditioned": ("conditioned_mo_ppo", ONE_WAYPOINT, {}, {}),
    "conditioned, continuous": ("conditioned_mo_ppo", ONE_WAYPOINT, CONTINUOUS, {}),
    "conditioned, two vehicles": ("conditioned_mo_ppo", INTERSECTION, {}, {}),
    "pcn": ("pcn", ONE_WAYPOINT, {}, {}),
    "pcn, continuous": ("pcn", ONE_WAYPOINT, CONTINUOUS, {}),
}
EVERY = pytest.mark.parametrize("name", LEARNERS)
UTILITIES: dict[str, dict[str, Any]] = {
    ONE_WAYPOINT: {"name": "one_waypoint_linear"},
    LEFT_TURN: {"name": "left_turn_linear"},
    INTERSECTION: {"name": "intersection_linear"},
    SEA: {"name": "linear", "arguments": {"weights": {"objective_0": 1.0, "objective_1": 0.1}}},
}


def experiment(name: str, device: str = "cuda", num_envs: int = 8) -> Any:
    """That of a learner with small networks and short episodes."""
    algorithm, env_id, arguments, hyperparameters = LEARNERS[name]
    short = {} if env_id == SEA else {"time_limit": 2.0}
    values: dict[str, Any] = {
        "environment": {"id": env_id, "arguments": {**short, **arguments}},
        "algorithm": {"name": algorithm, "hidden": [16, 16], "learning_rate": 1e-2, **hyperparameters},
        "training": {"total_timesteps": STEPS, "num_envs": num_envs, "seed": 3, "device": device},
    }
    if algorithm != "pcn":
        values["algorithm"]["steps"] = 8
    if ALGORITHMS[algorithm].known_utility:
        values["utility"] = UTILITIES[env_id]
    return make_experiment(values)


def greedy_actions(agent: Any) -> Any:
    """What an agent does, under several conditions if it learns a front, for made-up observations."""
    rng, vehicles = np.random.default_rng(0), agent.env.vehicles
    observations = rng.normal(0.0, 5.0, (200, vehicles, agent.env.observation_size)).astype(np.float32)
    accrued = AccruedReward.begin(len(observations), vehicles, len(agent.env.objectives))
    policies = [agent.policy(each) for each in agent.conditions()[:5]] if isinstance(agent, FrontAgent) else [agent]
    return np.stack([policy.act(observations, accrued, None) for policy in policies])


@EVERY
def test_a_resumed_run_is_the_uninterrupted_run_bit_for_bit(name: str, tmp_path: Path) -> None:
    if LEARNERS[name][1] == SEA:
        pytest.skip("environments of Deep Sea Treasure cannot be saved")
    check_resumed(experiment(name), tmp_path / "checkpoint.safetensors")


@EVERY
def test_a_seed_determines_every_weight(name: str) -> None:
    first, second = (trained(experiment(name)).get_state() for _ in range(2))
    assert all(torch.equal(tensor, second[key]) for key, tensor in first.items())
    assert any(tensor.is_cuda for tensor in first.values())


@EVERY
def test_a_policy_drives_on_the_cpu_as_it_does_on_the_gpu(name: str, tmp_path: Path) -> None:
    agent = trained(experiment(name))
    agent.save_policy(tmp_path / "policy.safetensors")
    other = build(experiment(name, "cpu", num_envs=1))
    other.load(tmp_path / "policy.safetensors", policy_only=True)
    actions = [greedy_actions(each) for each in (agent, other)]
    if agent.env.continuous:
        np.testing.assert_allclose(actions[0], actions[1], atol=1e-4)
    else:  # last bits decide between actions of nearly equal probability
        assert np.mean(actions[0] == actions[1]) >= 0.99
        assert LEARNERS[name][1] == SEA or len(np.unique(actions[0])) > 1


@pytest.mark.parametrize(("begun", "resumed"), [("cuda", "cpu"), ("cpu", "cuda")])
@EVERY
def test_training_cannot_be_resumed_on_another_kind_of_device(
    name: str, begun: str, resumed: str, tmp_path: Path
) -> None:
    build(experiment(name, begun)).save(tmp_path / "checkpoint.safetensors")
    with pytest.raises(ValueError, match=r"generator.* training continues on the kind of device"):
        build(experiment(name, resumed)).load(tmp_path / "checkpoint.safetensors")
