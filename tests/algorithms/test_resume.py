"""A training that is interrupted and resumed is the uninterrupted one, to the last bit, of every algorithm."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from algorithms import ALGORITHMS
from algorithms.runs.build import build
from tests.helpers.agents import CONTINUOUS, INTERSECTION, ONE_WAYPOINT, ROUNDABOUT, SEA
from tests.helpers.seed_trainers import LEARNERS, TOTAL, short_experiment, trained

SCHEDULES = {"learning_rate_end": 1e-4, "entropy_start": 0.1, "entropy_end": 0.01}
CENTRAL = {"centralised_critic": True}
PCN = {"warmup_episodes": 4, "gradient_steps": 2}
FIXED = {"fixed_destination": True}
# Algorithm, environment, its arguments, hyperparameters, and settings of the training; beside LEARNERS.
ALONE: dict[str, tuple[str, str, dict[str, Any], dict[str, Any], dict[str, Any]]] = {
    "one world, one step": ("a2c", ONE_WAYPOINT, {}, {"steps": 1}, {"num_envs": 1}),
    "schedules": ("mo_ppo", ONE_WAYPOINT, CONTINUOUS, SCHEDULES, {}),
    "mo_a2c, gradient": ("mo_a2c", INTERSECTION, {}, {"advantage": "utility_gradient"}, {}),
    "mo_a2c, expected utility": ("mo_a2c", INTERSECTION, {}, {"advantage": "expected_utility", **CENTRAL}, {}),
    "mo_a2c, without discount": ("mo_a2c", ONE_WAYPOINT, {}, {"observe_discount": False}, {}),
    "mocac, central": ("mocac", INTERSECTION, {}, CENTRAL, {}),
    "one policy for all": ("ppo", ROUNDABOUT, {}, {}, {"share_policy": True}),
    "mappo, one policy": ("mappo", INTERSECTION, {}, {"joint": "gini"}, {"share_policy": True}),
    "conditioned, switching": ("conditioned_mo_ppo", ONE_WAYPOINT, CONTINUOUS, {"switching": 0.2}, {}),
    "partners": ("mo_ppo", INTERSECTION, {}, {}, {"partners": {"vehicle_1": ["rule:straight_6", "rule:straight_4"]}}),
    "guides": ("mo_ppo", INTERSECTION, {}, {}, {"guides": {"vehicle_0": {"driver": "rule:gap_6", "decisions": 12}}}),
    "conditioned, guides": (
        *("conditioned_mo_ppo", ONE_WAYPOINT, FIXED, {}),
        {"guides": {"vehicle_0": {"driver": "one_waypoint_linear-ppo", "share": 1.0, "decisions": 6}}},
    ),
    "pcn": ("pcn", ONE_WAYPOINT, {}, PCN, {}),
    "pcn, continuous": ("pcn", ONE_WAYPOINT, CONTINUOUS, PCN, {}),
    "pcn, another library's": ("pcn", SEA, {}, {**PCN, "objective_scales": [20, 20]}, {}),
}
FORMS: dict[str, tuple[Any, list[int] | None]] = {
    **{name: (form, None) for name, form in {**LEARNERS, **ALONE}.items()},
    **{f"{name}, several seeds": (form, [3, 4]) for name, form in LEARNERS.items()},
}


def test_no_algorithm_is_left_out() -> None:
    assert {form[0] for form, _ in FORMS.values()} == {*ALGORITHMS}


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMS)
def test_an_interrupted_and_resumed_training_is_the_uninterrupted_one(name: str, tmp_path: Path) -> None:
    (algorithm, env_id, arguments, hyperparameters, *training), seeds = FORMS[name]

    def agent_with(shift: int) -> Any:
        settings = {"seed": 3 + shift, **(training[0] if training else {})}
        experiment = short_experiment(algorithm, env_id, arguments, hyperparameters, **settings)
        return build(experiment, seeds=seeds and [seed + shift for seed in seeds])

    def saved(agent: Any, stage: str) -> list[Path]:
        paths = [tmp_path / f"{stage}-{index}" for index in range(len(agent.seeds))]
        for index, path in enumerate(paths):
            agent.save(path, index)
        return paths

    before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    whole, interrupted, resumed = agent_with(0), agent_with(0), agent_with(90)  # of which nothing is left after loading
    rows = trained(whole)
    first = trained(interrupted, after_update=lambda agent: agent.step >= 0.6 * TOTAL)
    assert 0 < interrupted.step < whole.step
    resumed.load(*saved(interrupted, "middle"))
    assert (resumed.step, resumed.seeds) == (interrupted.step, whole.seeds)
    rest = trained(resumed)
    assert [[*start, *end] for start, end in zip(first, rest, strict=True)] == rows
    for one, other in zip(saved(whole, "whole"), saved(resumed, "resumed"), strict=True):
        assert one.read_bytes() == other.read_bytes()
    assert torch.equal(torch.get_rng_state(), before[0])
    assert np.array_equal(np.random.get_state()[1], before[1])  # noqa: NPY002
