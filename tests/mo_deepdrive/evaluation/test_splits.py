"""No scenario is in two splits, and training, learning curves and final scores each draw from their own."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import pytest

from algorithms.runs.config import make_experiment
from algorithms.runs.jobs import Job, perform
from mo_deepdrive.evaluation.env_adapter import EnvAdapter
from mo_deepdrive.evaluation.splits import (
    EVALUATION_SEED_LIMIT,
    FIRST_TRAINING_SEED,
    SPLITS,
    Split,
    check_episodes,
    first_seed,
)
from tests.helpers.short_runs import VALUES


def test_no_scenario_is_in_two_splits() -> None:
    for first, second in itertools.pairwise(sorted(SPLITS.values(), key=lambda seeds: seeds.start)):
        assert first.stop <= second.start
    assert max(seeds.stop for seeds in SPLITS.values()) <= EVALUATION_SEED_LIMIT <= FIRST_TRAINING_SEED


def test_the_episodes_of_an_evaluation_do_not_reach_the_seeds_of_training() -> None:
    last = EVALUATION_SEED_LIMIT - 10
    assert first_seed(None, last, 10) == last
    for seed in (-1, last + 1, FIRST_TRAINING_SEED):
        with pytest.raises(ValueError, match=f"seed = {seed} must be from 0 to {last}"):
            first_seed(None, seed, 10)


@pytest.mark.parametrize("split", ["validation", "test"])
def test_a_run_uses_each_split_for_its_purpose(split: Split, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    resets: list[int | list[int] | None] = []
    original = EnvAdapter.reset

    def reset(self: EnvAdapter, seed: int | list[int] | None = None) -> Any:
        resets.append(seed)
        return original(self, seed)

    monkeypatch.setattr(EnvAdapter, "reset", reset)
    experiment = make_experiment({**VALUES, "evaluation": {"episodes": 2, "final_episodes": 4, "split": split}})
    perform(Job("run", experiment, tmp_path / "run"))
    training = [seed for seed in resets if isinstance(seed, int)]
    *curve, greedy, stochastic = [seed for seed in resets if isinstance(seed, list)]
    assert training
    assert all(seed >= FIRST_TRAINING_SEED for seed in training)
    assert len(curve) > 2
    assert all(seeds == list(SPLITS["validation"][:2]) for seeds in curve)
    assert greedy == stochastic == list(SPLITS[split][:4])
    assert json.loads((tmp_path / "run" / "evaluation.json").read_text())["seed"] == SPLITS[split].start


def test_a_split_has_no_more_scenarios_than_it_has() -> None:
    check_episodes("--episodes", 2000, "test")
    check_episodes("--episodes", 1001, "validation")
    with pytest.raises(ValueError, match="--episodes = 2001 exceeds the 2,000 scenarios of the test split"):
        check_episodes("--episodes", 2001, "test")
    with pytest.raises(ValueError, match=r"evaluation\.final_episodes = 2001 exceeds the 2,000 scenarios of the test"):
        make_experiment({**VALUES, "evaluation": {"final_episodes": 2001}})
    with pytest.raises(ValueError, match=r"evaluation\.episodes = 1000001 exceeds the 1,000,000 scenarios of the val"):
        make_experiment({**VALUES, "evaluation": {"episodes": 1_000_001}})
