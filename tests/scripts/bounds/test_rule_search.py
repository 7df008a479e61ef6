"""The search for rules: what it finds scores what it was measured at, and whoever sees more is better."""

from __future__ import annotations

import numpy as np
import pytest

from algorithms.driving.intersection_rules import STRANGERS, MeetingRule, TurningDriver
from mo_deepdrive import suite
from mo_deepdrive.evaluation.episodes import evaluate
from scripts.bounds.rule_search import (
    BLIND,
    SEEING,
    Objective,
    Setting,
    mean_utility,
    measure,
    search,
    worst_family,
)


@pytest.mark.parametrize("task_id", ["K4", "V1"])
def test_what_is_measured_of_a_rule_is_its_score(task_id: str) -> None:
    task = suite.load().task(task_id)
    partners = task.partners.names if task.partners else []
    setting = Setting(task.environment.id, task.environment.arguments, tuple(partners))
    family, utility = SEEING[task.config().scenario], task.make_utility()
    rule = search(setting, family, mean_utility(utility), ((4, 1), (2, 1)))
    np.testing.assert_array_equal(rule, search(setting, family, mean_utility(utility), ((4, 1), (2, 1))))
    found = measure(setting, family, rule, mean_utility(utility), 3)
    (row,) = suite.score(family.policy(rule, "discrete"), task_id, episodes=3, perturbed=False)[:1]
    assert row.value == pytest.approx(found.value, abs=1e-6)


def test_every_vehicle_is_driven_by_the_rule_of_its_episode() -> None:
    setting = Setting("mo-deepdrive-roundabout-v0", {"vehicles": 2})
    waits = np.array([[0.0, 4.0, 4.0, 4.0], [3.0, 4.0, 4.0, 4.0]])
    early, late = (each.lengths for (each,) in setting.drive(BLIND["roundabout"], waits, 2, "validation"))
    assert (late > early).any()
    (alone,) = setting.drive(BLIND["roundabout"], waits[1:], 2, "validation")[0]
    np.testing.assert_array_equal(alone.lengths, late)


def test_the_best_of_those_who_see_nobody_is_behind_a_rule_that_sees_the_other() -> None:
    setting = Setting("mo-deepdrive-intersection-v1", {}, ("rule:parked_99", "rule:waves_2"))
    objective = mean_utility(suite.load().task("V1").make_utility())
    blind = search(setting, BLIND["intersection"], objective, ((32, 4), (8, 8)))
    sees = np.array([5.0, 2.8, 6.0, 8.0, 0.73, 0.0, 0.3, 0.0])
    low = measure(setting, SEEING["intersection"], sees, objective, 40).low
    assert low is not None
    assert low > measure(setting, BLIND["intersection"], blind, objective, 40).value


def test_the_worst_family_is_that_of_the_lowest_mean() -> None:
    number = worst_family(None, STRANGERS).number
    samples = np.zeros((2, len(STRANGERS)))
    samples[:, 0], samples[:, 3:6] = -2.0, -1.0
    assert number(samples) == -1.0


def test_an_objective_may_be_any_number_of_evaluations() -> None:
    setting = Setting("mo-deepdrive-roundabout-v0", {"vehicles": 2})
    collided = Objective(lambda met: (met[0].ends == "collision").mean(axis=1), lambda samples: -float(samples.mean()))
    rule = search(setting, SEEING["roundabout"], collided, ((4, 2), (2, 4)))
    assert measure(setting, SEEING["roundabout"], rule, collided, 4).value <= 0.0


def test_who_is_impatient_goes_before_somebody_who_stands() -> None:
    rule = MeetingRule(gap=5.0, least_speed=6.0)
    waits = TurningDriver(rule, "discrete")
    lengths = []
    for impatient in (False, True):
        policy = lambda seen, *_, goes=impatient: np.stack(  # noqa: E731
            [waits.drive(seen[:, 0], goes), np.zeros(len(seen), dtype=np.int64)], axis=1
        )
        lengths.append(evaluate(policy, "mo-deepdrive-intersection-v1", episodes=10).lengths[:, 0].mean())
    assert lengths[1] < lengths[0] - 50
