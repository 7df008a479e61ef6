"""Driving rules: what they steer towards, and that they arrive."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mo_deepdrive.world.actions import INCREASE, MAINTAIN, action_table
from scripts.bounds.plans import (
    AFTER_DISTANCE,
    NEXT_ANGLE,
    RULE,
    PlanEvaluator,
    follow_rule,
    random_calm_rules,
    random_rules,
)
from scripts.bounds.variation import FULL_SCALE


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


@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
@pytest.mark.parametrize(("detour", "time", "sign"), [(-1.0, 3.0, -1), (1.0, 3.0, 1), (1.0, 9.0, 0), (1.0, 1.0, 1)])
def test_a_rule_waits_heads_to_a_side_and_then_towards_the_waypoint(
    action_type: str, detour: float, time: float, sign: int
) -> None:
    """A positive steer turns to the left."""
    rules = np.zeros(1, dtype=RULE).view(np.recarray)
    rules["wait"], rules["detour"], rules["detour_time"] = 2.0, detour, 5.0
    rules["gain"], rules["max_steer"], rules["target_speed"], rules["throttle"] = 1.0, 0.1, 3.0, 1.0
    seen = np.zeros(15, dtype=np.float32)
    seen[NEXT_ANGLE], seen[AFTER_DISTANCE] = 0.0, 30.0
    if action_type == "discrete":
        table = action_table(action_type)
        action = np.zeros(1, dtype=np.int16)
        follow_rule(seen, rules[0], time, table, action)
        _, steer, curl, change = table[action[0]]
        assert np.sign(steer + curl) == sign
        assert change == (INCREASE if time > 2.0 else MAINTAIN)
    else:
        action = np.zeros(3, dtype=np.int16)
        follow_rule(seen, rules[0], time, np.zeros((0, 4)), action)
        assert np.sign(action[0]) == sign
        assert (action[1] > 0) == (time > 2.0)
        assert action[2] == -FULL_SCALE
