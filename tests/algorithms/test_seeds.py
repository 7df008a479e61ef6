"""Seeds that are trained side by side: each is as if the others were not there."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from algorithms import PCN, PPO, FrontAgent
from algorithms.runs.build import build_trainee
from algorithms.runs.config import make_experiment
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.support.faults import NotFinite
from tests.helpers.agents import INTERSECTION, SEA, make_agent
from tests.helpers.seed_trainers import LEARNERS, TOTAL, trained, trainer, weights
from tests.helpers.short_runs import VALUES

EVERY = pytest.mark.parametrize("name", LEARNERS)
PAIRS: dict[str, dict[str, Any]] = {
    "partners": {"partners": {"vehicle_1": ["rule:straight_6"]}},
    "guides": {"guides": {"vehicle_0": {"driver": "rule:gap_8"}}},
    "a shared policy": {"share_policy": True},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", [*LEARNERS, *PAIRS])
def test_a_seed_ends_with_the_same_weights_and_metrics_whatever_seeds_are_beside_it(name: str) -> None:
    learner, training = (name, {}) if name in LEARNERS else ("ppo, two vehicles", PAIRS[name])
    first, second = (trainer(learner, seeds, **training) for seeds in ([3, 4, 5], [7, 4]))
    rows = trained(first)
    assert rows[1] == trained(second)[1]
    assert torch.equal(weights(first, 1), weights(second, 1))
    assert not torch.equal(weights(first, 0), weights(first, 1))
    assert len(rows[1]) == TOTAL // 128 + TOTAL % 128 // 64


@pytest.mark.slow
@EVERY
def test_the_agent_of_a_seed_acts_on_with_what_it_has_learnt(name: str) -> None:
    several = trainer(name, [3, 4])
    trained(several)
    agent = several.of_seed(1)
    assert (agent.seed, agent.step) == (4, several.step)
    for learner, own in zip(several.learners, agent.learners, strict=True):
        mine, theirs = own.get_weights("actor"), learner.get_weights("actor", 1)
        assert all(torch.equal(mine[part], theirs[part]) for part in mine)
    vehicles = agent.env.vehicles
    observations = np.random.default_rng(0).normal(0.0, 5.0, (20, vehicles, agent.env.observation_size))
    past = AccruedReward.begin(20, vehicles, len(agent.env.objectives))
    policy = agent.policy(agent.conditions()[0]) if isinstance(agent, FrontAgent) else agent
    assert policy.act(observations.astype(np.float32), past, None).shape[:2] == (20, vehicles)


class Recorded(TorchDispatchMode):
    """Counts the operations in its context."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.counts[function.name()] += 1
        return function(*args, **(kwargs or {}))


@pytest.mark.slow
@EVERY
def test_an_update_reads_no_value_of_a_tensor_and_brings_none_to_the_device(name: str) -> None:
    agent = trainer(name, [3, 4])
    trained(agent, after_update=lambda each: each.updates == 2)
    with Recorded() as recorded:
        agent._collect_and_learn()  # what a CUDA graph would capture
    refused = {"aten::_local_scalar_dense", "aten::lift_fresh", "aten::nonzero", "aten::equal", "aten::randperm"}
    assert not refused & recorded.counts.keys()
    assert recorded.counts["aten::bmm"] > 10


@pytest.mark.parametrize("name", ["mo_ppo", "conditioned"])
def test_a_seed_that_diverges_is_named_and_the_others_go_on_as_if_it_were_not_there(name: str) -> None:
    broken, whole = trainer(name, [3, 4]), trainer(name, [5, 4])
    broken.learners[0].vector[0] = torch.nan
    rows, expected = trained(broken), trained(whole)
    assert [*broken.failed] == [0]
    assert "seed 3, in the update after step 0: " in broken.failed[0]
    assert rows[0] == []
    assert rows[1] == expected[1]
    assert torch.equal(weights(broken, 1), weights(whole, 1))
    assert weights(broken, 0).isfinite().all()


def test_training_ends_where_all_seeds_have_diverged() -> None:
    agent = trainer("mo_ppo", [3, 4])
    agent.learners[0].vector[:] = torch.nan
    with pytest.raises(NotFinite, match="seed 4, in the update after step 0: environment 0: an output of the policy's"):
        trained(agent)
    assert [*agent.failed] == [0, 1]


def test_checkpoints_of_different_steps_are_not_resumed_together(tmp_path: Path) -> None:
    agent, paths = trainer("a2c", [3, 4]), [tmp_path / "3", tmp_path / "4"]
    trained(agent, after_update=lambda each: each.updates == 1)
    agent.save(paths[0], 0)
    trained(agent, after_update=lambda each: each.updates == 2)
    agent.save(paths[1], 1)
    with pytest.raises(ValueError, match="the checkpoints are of the steps 64, 128; resume those of the same step"):
        trainer("a2c", [3, 4]).load(*paths)


def test_what_cannot_be_trained_side_by_side_is_refused() -> None:
    for make in (
        lambda: make_agent(PPO, SEA, seed=[1, 2]),
        lambda: make_agent(PCN, SEA, seed=[1, 2]),
        lambda: make_agent(PPO, INTERSECTION, seed=[]),
    ):
        with pytest.raises(ValueError, match=r"seed = \[.*\], device = 'cpu': algorithm '.*' in .* trains one seed"):
            make()


CASES: dict[str, tuple[dict[str, Any], str]] = {
    "pcn": ({"algorithm": {"name": "pcn"}, "utility": None}, "algorithm 'pcn' trains on the CPU; a2c, conditioned_"),
    "another library's environment": (
        {"environment": {"id": SEA}, "utility": {"name": "linear", "arguments": {"weights": [1, 1]}}},
        f"environment {SEA!r} is another library's, on the CPU alone",
    ),
    "the same seed twice": ({"training": {"seeds": [1, 1]}}, "training.seeds = [1, 1] must differ from one another"),
    "another seed": (
        {"training": {"seed": 3, "seeds": [1, 2]}},
        "training.seed = 3 must be one of training.seeds = [1, 2]",
    ),
    "no seed": ({"training": {"seeds": []}}, "'training.seeds'"),
}


@pytest.mark.parametrize("case", CASES)
def test_experiments_that_cannot_be_trained_side_by_side_are_refused(case: str) -> None:
    changes, message = CASES[case]
    training = {**VALUES["training"], "seeds": [0, 1], **changes.get("training", {})}
    values = {name: each for name, each in {**VALUES, **changes, "training": training}.items() if each is not None}
    with pytest.raises(ValueError, match=r".") as refused:
        build_trainee(make_experiment(values).of_seeds())
    assert message in str(refused.value)
