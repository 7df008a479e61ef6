"""No scenario is both trained on and evaluated on."""

from __future__ import annotations

import pytest

from algorithms.agent import FIRST_TRAINING_SEED as FIRST_SEED_OF_AGENTS
from algorithms.evaluation.splits import EVALUATION_SEED_LIMIT, FIRST_EVALUATION_SEED, FIRST_TRAINING_SEED
from algorithms.experiments.config import EvaluationSettings

MOST_EPISODES = 2**31  # of one evaluation, far more than is practical


def test_the_seeds_of_training_and_evaluation_do_not_overlap() -> None:
    evaluation = range(EVALUATION_SEED_LIMIT - 1 + MOST_EPISODES)
    assert FIRST_EVALUATION_SEED in evaluation
    assert FIRST_TRAINING_SEED not in evaluation
    assert evaluation.stop <= FIRST_TRAINING_SEED


def test_agents_and_experiments_use_these_seeds() -> None:
    assert FIRST_SEED_OF_AGENTS == FIRST_TRAINING_SEED
    assert EvaluationSettings().seed == FIRST_EVALUATION_SEED
    assert EvaluationSettings(seed=EVALUATION_SEED_LIMIT - 1).seed == EVALUATION_SEED_LIMIT - 1
    with pytest.raises(ValueError, match="less than"):
        EvaluationSettings(seed=EVALUATION_SEED_LIMIT)
