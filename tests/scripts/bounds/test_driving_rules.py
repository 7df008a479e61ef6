"""Driving rules arrive."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from scripts.bounds.plans import (
    PlanEvaluator,
    random_calm_rules,
    random_rules,
)


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["one_waypoint", "static_obstacle"])
@pytest.mark.parametrize("action_type", ["discrete", "discrete-16", "continuous"])
@pytest.mark.parametrize("draw", [random_rules, random_calm_rules])
def test_some_random_rules_arrive(scenario: str, action_type: str, draw: Callable[..., NDArray[Any]]) -> None:
    evaluator = PlanEvaluator(scenario, action_type)
    rules = draw(256, np.random.default_rng(0))
    evaluated = evaluator.evaluate(evaluator.format.idle_plans(256), 0, rules)
    destination = evaluator.batch.objectives.index("destination")
    assert (evaluated.returns[1][:, destination] == 1.0).any()
