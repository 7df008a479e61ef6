"""The evaluation of plans, compared with a replay in the batch that the environments use."""

from __future__ import annotations

import numpy as np
import pytest

from mo_deepdrive.fronts.reference_fronts import front_config
from mo_deepdrive.world.action_sequences import discounted_sum
from mo_deepdrive.world.action_sequences import replay as replay_sequences
from scripts.bounds.plans import CRITERIA, PlanEvaluator, random_calm_rules


@pytest.mark.parametrize("scenario", ["one_waypoint", "static_obstacle"])
@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
def test_returns_are_those_of_a_replay(scenario: str, action_type: str) -> None:
    evaluator = PlanEvaluator(scenario, action_type)
    rules = random_calm_rules(8, np.random.default_rng(1))
    evaluated = evaluator.evaluate(evaluator.format.idle_plans(8), 3, rules)
    sequences = [evaluator.format.to_sequence(plan) for plan in evaluated.plans]
    for returns, criterion in zip(evaluated.returns, CRITERIA, strict=True):
        objectives = {"objectives": criterion.objectives(scenario)}
        config = front_config(scenario, action_type).model_copy(update=objectives)
        expected = discounted_sum(replay_sequences(config, sequences), criterion.gamma)
        np.testing.assert_allclose(returns, expected, rtol=1e-5, atol=2e-5)
    assert evaluated.sources.tolist() == [3] * 8
    assert evaluator.simulated_decisions == evaluated.lengths.sum()
