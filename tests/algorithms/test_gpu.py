"""Training on a GPU repeats with its seeds, resumes bit for bit, and its policies drive on the CPU."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from algorithms import FrontAgent, actor_critic
from algorithms.runs.build import build_trainee
from algorithms.runs.config import make_experiment
from mo_deepdrive.evaluation.policy import AccruedReward
from tests.helpers.agents import ONE_WAYPOINT
from tests.helpers.seed_trainers import LEARNERS, trained, trainer, weights
from tests.helpers.short_runs import VALUES

pytestmark = [pytest.mark.slow, pytest.mark.gpu]
EVERY = pytest.mark.parametrize("name", LEARNERS)


@EVERY
def test_seeds_determine_every_weight_and_a_resumed_training_is_the_uninterrupted_one(
    name: str, tmp_path: Path
) -> None:
    first, second, resumed = (trainer(name, [3, 4], "cuda") for _ in range(3))
    rows = trained(first)
    trained(second, after_update=lambda each: each.updates > actor_critic.WARM_UP)  # of which the last one was captured
    paths = [tmp_path / f"{seed}.safetensors" for seed in range(2)]
    for seed, path in enumerate(paths):
        second.save(path, seed)
    resumed.load(*paths)
    rest = trained(resumed)
    for seed in range(2):
        assert rest[seed][-1] == rows[seed][-1]
        assert weights(first, seed).is_cuda
        assert torch.equal(weights(first, seed), weights(resumed, seed))


@EVERY
def test_a_captured_update_is_the_one_that_is_not_captured(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    captured, eager = trainer(name, [3, 4], "cuda"), trainer(name, [3, 4], "cuda")
    rows = trained(captured)
    monkeypatch.setattr(actor_critic, "WARM_UP", 1_000)
    others = trained(eager)
    for row, other in zip(rows[1], others[1], strict=True):
        assert row == pytest.approx(other, rel=1e-2, abs=1e-3)


@pytest.mark.parametrize("name", ["mo_ppo", "mappo", "conditioned, families"])
def test_a_compiled_update_is_the_one_that_is_not_compiled(name: str) -> None:
    rows, others = (trained(trainer(name, [3, 4], "cuda", compiled=compiled)) for compiled in (True, False))
    for row, other in zip(rows[1], others[1], strict=True):
        assert row == pytest.approx(other, rel=1e-2, abs=1e-3)


@EVERY
def test_the_first_update_of_a_seed_is_the_one_that_it_has_alone_but_for_rounding(name: str) -> None:
    rows = []
    for seeds in ([3, 4, 5], [4]):
        agent = trainer(name, seeds, "cuda")
        found = trained(agent, log_interval=1, after_update=lambda _: True)
        rows.append(found[seeds.index(4)][0])
    assert rows[0] == pytest.approx(rows[1], rel=1e-3, abs=1e-4)


@EVERY
def test_a_policy_drives_on_the_cpu_as_it_does_on_the_gpu(name: str) -> None:
    several = trainer(name, [3, 4], "cuda")
    trained(several)
    agent: Any = several.of_seed(1)
    rng, vehicles = np.random.default_rng(0), agent.env.vehicles
    observations = rng.normal(0.0, 5.0, (200, vehicles, agent.env.observation_size)).astype(np.float32)
    accrued = AccruedReward.begin(len(observations), vehicles, len(agent.env.objectives))
    policy = agent.policy(agent.conditions()[0]) if isinstance(agent, FrontAgent) else agent
    chosen = policy.act(observations, accrued, None)
    assert chosen.shape[:2] == (200, vehicles)
    for learner, own in zip(several.learners, agent.learners, strict=True):
        assert own.vector.device.type == "cpu"
        mine, theirs = own.get_weights("actor"), learner.get_weights("actor", 1)
        assert all(torch.equal(mine[part], theirs[part].cpu()) for part in mine)


def test_ten_seeds_of_mo_ppo_learn() -> None:
    values = {
        **VALUES,
        "environment": {"id": ONE_WAYPOINT},
        "algorithm": {"name": "mo_ppo", "hidden": [64, 32], "accrued_discount": 1.0, "entropy_start": 0.03},
        "training": {"total_timesteps": 400_000, "num_envs": 256, "seeds": [*range(10)], "device": "cuda"},
    }
    trainee = build_trainee(make_experiment(values).of_seeds())
    arrivals = [rows[-1]["train/success"] for rows in trained(trainee, total=400_000, log_interval=20)]
    assert len(arrivals) == 10
    assert min(arrivals) > 0.7
    assert np.mean(arrivals) > 0.85
