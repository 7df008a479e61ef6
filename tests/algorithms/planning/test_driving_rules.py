"""Driving rules: what they steer towards, and that they arrive."""

from __future__ import annotations

import numpy as np
import pytest

from algorithms.planning.driving_rules import RULE, follow_rule, random_rules
from algorithms.planning.plan_evaluation import PlanEvaluator
from algorithms.planning.plans import FULL_SCALE


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["one_waypoint", "static_obstacle"])
@pytest.mark.parametrize("action_type", ["discrete", "discrete-16", "continuous"])
def test_some_random_rules_arrive(scenario: str, action_type: str) -> None:
    evaluator = PlanEvaluator(scenario, action_type)
    rules = random_rules(256, np.random.default_rng(0), evaluator.batch)
    evaluated = evaluator.evaluate(evaluator.format.idle_plans(256), 0, rules)
    destination = evaluator.batch.objectives.index("destination")
    assert (evaluated.returns[1][:, destination] == 1.0).any()


@pytest.mark.slow
@pytest.mark.parametrize(("side", "sign"), [(-1.0, 1.0), (1.0, -1.0)])
def test_a_rule_steers_towards_the_point_on_the_way(side: float, sign: float) -> None:
    """A positive steer turns to the left."""
    evaluator = PlanEvaluator("one_waypoint", "continuous")
    vehicle = evaluator.batch.state[0, 0]
    rules = np.zeros(1, dtype=RULE)
    rules["gain"], rules["max_steer"], rules["target_speed"], rules["throttle"] = 1.0, 0.1, 3.0, 1.0
    rules["via_radius"] = 1.0
    ahead = np.array([-vehicle["sin_heading"], vehicle["cos_heading"]])
    right = np.array([vehicle["cos_heading"], vehicle["sin_heading"]])
    rules["via_x"], rules["via_y"] = (vehicle["front_x"], vehicle["front_y"]) + 5.0 * ahead + 5.0 * side * right
    action = np.zeros(3, dtype=np.int16)
    assert not follow_rule(vehicle, rules.view(np.recarray)[0], False, evaluator.format.table, action)
    assert action[0] * sign > 0
    assert action[1] > 0
    assert action[2] == -FULL_SCALE
