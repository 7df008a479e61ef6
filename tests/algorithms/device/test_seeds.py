"""Seeds that are trained side by side: each is as if the others were not there, and its run is a run like any other."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode

from algorithms.commands import evaluate, table, train
from algorithms.device import compiling
from algorithms.device.networks import linear
from algorithms.experiments.config import make_experiment
from algorithms.experiments.jobs import perform
from algorithms.experiments.run_directory import Run
from algorithms.experiments.side_by_side import build_trainee
from algorithms.experiments.training import reopen, train_and_finish
from algorithms.files.metrics import read_metrics
from algorithms.files.yaml import dump
from mo_deepdrive.faults import NotFinite
from tests.helpers.agents import ONE_WAYPOINT, SEA
from tests.helpers.seed_trainers import LEARNERS, TOTAL, trained, trainer, weights
from tests.helpers.short_runs import VALUES, assert_same_run, job, metrics, quiet

pytestmark = pytest.mark.slow

EVERY = pytest.mark.parametrize("name", LEARNERS)


@EVERY
def test_a_seed_ends_with_the_same_weights_and_metrics_whatever_seeds_are_beside_it(name: str) -> None:
    first, second = trainer(name, [3, 4, 5]), trainer(name, [7, 4])
    rows = trained(first)
    assert rows[1] == trained(second)[1]
    assert torch.equal(weights(first, 1), weights(second, 1))
    assert not torch.equal(weights(first, 0), weights(first, 1))
    assert len(rows[1]) == TOTAL // 128 + TOTAL % 128 // 64


def test_a_seed_of_a_vector_critic_ends_with_the_weights_that_it_has_alone() -> None:
    several, alone = trainer("mo_ppo", [3, 4, 5]), trainer("mo_ppo", [4])
    assert trained(several)[1] == trained(alone)[0]
    assert torch.equal(weights(several, 1), weights(alone, 0))


@EVERY
def test_an_interrupted_training_resumes_bit_for_bit(name: str, tmp_path: Path) -> None:
    whole, part = trainer(name, [3, 4]), trainer(name, [3, 4])
    rows = trained(whole)
    before = trained(part, after_update=lambda each: each.step >= 192)
    paths = [tmp_path / f"{seed}.safetensors" for seed in range(2)]
    for seed, path in enumerate(paths):
        part.save(seed, path)
    resumed = trainer(name, [3, 4])
    resumed.load(paths)
    after = trained(resumed)
    for seed in range(2):
        assert before[seed] + after[seed] == rows[seed]
        assert torch.equal(weights(whole, seed), weights(resumed, seed))


@pytest.mark.parametrize("name", ["mo_ppo", "mappo", "conditioned, families"])
def test_a_traced_update_is_the_one_that_is_not_traced(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling, "BACKEND", "aot_eager")  # without a compiler, which rounds otherwise
    traced, plain = (trainer(name, [3, 4], compiled=compiled) for compiled in (True, False))
    assert trained(traced) == trained(plain)
    assert torch.equal(weights(traced, 1), weights(plain, 1))


@pytest.mark.parametrize("rows", [1024, 960, 1000, 200])
def test_parted_products_are_those_of_a_linear_layer(rows: int) -> None:
    layer, x = nn.Linear(7, 5), torch.linspace(-1.0, 1.0, rows * 7).sin().view(rows, 7)
    parted = linear(layer, 16, x)
    torch.testing.assert_close(parted, layer(x))
    gradients = [torch.autograd.grad(each.square().sum(), [*layer.parameters()]) for each in (parted, layer(x))]
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-4, atol=1e-4)


class Recorded(TorchDispatchMode):
    """Counts the operations in its context."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.counts[function.name()] += 1
        return function(*args, **(kwargs or {}))


@EVERY
def test_an_update_reads_no_value_of_a_tensor_and_brings_none_to_the_device(name: str) -> None:
    trainee = trainer(name, [3, 4])
    trained(trainee, after_update=lambda each: each.updates == 2)
    with Recorded() as recorded:
        trainee._update()  # what a CUDA graph would capture
    refused = {"aten::_local_scalar_dense", "aten::lift_fresh", "aten::nonzero", "aten::equal", "aten::randperm"}
    assert not refused & recorded.counts.keys()
    assert recorded.counts["aten::bmm"] > 10


def test_what_is_not_finite_stops_the_run_and_names_the_seed_and_the_loss() -> None:
    trainee = trainer("mo_ppo", [3, 4])
    trainee.learners[0].networks.vector[1] = torch.nan
    with pytest.raises(NotFinite, match="seed 4, in the update before step 128: loss/policy = nan; it must be finite"):
        trained(trainee)


def test_mo_ppo_learns() -> None:
    values = {
        **VALUES,
        "environment": {"id": ONE_WAYPOINT},
        "algorithm": {"name": "mo_ppo", "hidden": [32, 32], "accrued_gamma": 1.0, "entropy_start": 0.03},
        "training": {"total_timesteps": 100_000, "num_envs": 64, "seeds": [1, 2]},
    }
    rows = trained(build_trainee(make_experiment(values).of_seeds()), total=100_000, log_interval=14)
    for each in rows:
        arrivals = [row["train/success"] for row in each]
        assert arrivals[0] < 0.5
        assert arrivals[-1] > 0.8
        assert each[-1]["train/utility"] > each[0]["train/utility"] + 2.0


def test_the_runs_of_several_seeds_are_resumed_evaluated_and_tabulated_as_any_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "config.yaml"
    config.write_text(dump(job(tmp_path, 5, seeds=[5, 6, 7]).experiment.to_dict()))
    assert train.main([f"--config={config}", f"--output={tmp_path / 'runs'}"]) == 0
    paths = [tmp_path / "runs" / f"seed-{seed}" for seed in (5, 6, 7)]

    # One of them, interrupted and resumed in the queue of another command, next to another seed.
    stopped = [job(tmp_path / "other", seed, seeds=[seed]) for seed in (6, 9)]
    for each in stopped:
        assert perform(each, stop=lambda: True) == "stopped"
    runs, trainee = reopen(*(str(each.path) for each in stopped))
    assert trainee.step > 0
    assert train_and_finish(runs, trainee, quiet(), resumed=True) is None
    for run in runs:
        run.unlock()
    assert_same_run(paths[1], stopped[0].path)
    assert metrics(paths[1]) == metrics(stopped[0].path)

    assert evaluate.main([str(paths[0]), "--episodes=3"]) == 0
    assert table.main([*map(str, paths)]) == 0
    assert "with three seeds" in capsys.readouterr().out
    assert Run.open(paths[2]).experiment.training.seed == 7
    assert read_metrics(paths[2] / "metrics.csv")["step"][-1] == 960


CASES: dict[str, tuple[dict[str, Any], str]] = {
    "mocac": (
        {"algorithm": {"name": "mocac"}},
        "algorithm 'mocac' trains on the CPU, one seed at a time; a2c, conditioned_mo_ppo, mappo,",
    ),
    "another library's environment": (
        {"environment": {"id": SEA}, "utility": {"name": "linear", "arguments": {"weights": [1, 1]}}},
        f"training.seeds = [0]: environment {SEA!r} is another library's, on the CPU alone",
    ),
    "guides": (
        {"training": {"guides": {"vehicle_0": {"driver": "rule:wait"}}}},
        "training.seeds = [0]: training.guides = ['vehicle_0'] drive on the CPU alone; leave them out",
    ),
    "a shared policy": (
        {"training": {"seeds": [0], "share_policy": True}},
        "training.seeds = [0]: training.share_policy = True is for the CPU, one seed at a time; leave one out",
    ),
    "the same seed twice": ({"training": {"seeds": [1, 1]}}, "training.seeds = [1, 1] must differ from one another"),
    "another seed": (
        {"training": {"seed": 3, "seeds": [1, 2]}},
        "training.seed = 3 must be one of training.seeds = [1, 2]",
    ),
    "an own utility that looks at its values": (
        {"utility": {"name": "tests.helpers.seed_trainers:branching"}},
        "utility 'tests.helpers.seed_trainers:branching' cannot be called by torch.func.vmap, as for several seeds",
    ),
    "no seed": ({"training": {"seeds": []}}, "'training.seeds'"),
}


@pytest.mark.parametrize("case", CASES)
def test_what_cannot_be_trained_side_by_side_is_refused(case: str) -> None:
    changes, message = CASES[case]
    training = {**VALUES["training"], "seeds": [0], **changes.get("training", {})}
    with pytest.raises(ValueError, match=r".") as refused:
        build_trainee(make_experiment({**VALUES, **changes, "training": training}).of_seeds())
    assert message in str(refused.value)


def test_a_job_is_one_run(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"training\.seeds = \[0, 1\]: mo-deepdrive train alone trains several"):
        perform(job(tmp_path, seeds=[0, 1]))
