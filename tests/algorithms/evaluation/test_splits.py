"""No scenario is in two splits, and training, evaluations and final scores each draw from their own."""

from __future__ import annotations

import itertools

import pytest

from algorithms.agent import Agent
from algorithms.evaluation.splits import (
    EVALUATION_SEED_LIMIT,
    FIRST_TRAINING_SEED,
    SPLITS,
    SPLITS_VERSION,
    check_episodes,
    describe_episodes,
)
from algorithms.experiments.config import Experiment, load_experiment, make_experiment
from tests.helpers.short_runs import VALUES


def test_the_splits_are_those_of_version_1() -> None:
    assert SPLITS_VERSION == 1
    assert SPLITS == {"validation": range(2_000_000, 3_000_000), "test": range(3_000_000, 3_001_000)}
    assert FIRST_TRAINING_SEED == 2**32


def test_no_scenario_is_in_two_splits() -> None:
    for first, second in itertools.pairwise(sorted(SPLITS.values(), key=lambda seeds: seeds.start)):
        assert first.stop <= second.start
    assert max(seeds.stop for seeds in SPLITS.values()) <= EVALUATION_SEED_LIMIT <= FIRST_TRAINING_SEED
