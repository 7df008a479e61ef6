"""The search for rules: what it finds scores what it was measured at, and whoever sees more is better."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from algorithms.driving.intersection_rules import MeetingRule, TurningDriver
from mo_deepdrive import suite
from mo_deepdrive.evaluation.episodes import evaluate
from scripts.bounds.rule_search import (
    BLIND,
    SEEING,
    Family,
    Objective,
    Setting,
    objective_of,
    search,
    setting_of,
)
from scripts.bounds.suite import searches


def measured(setting: Setting, family: Family, rule: NDArray[np.float64], objective: Objective, episodes: int) -> float:
    (met,) = setting.drive(family, rule[None], episodes, "test")
    return objective.number(objective.samples(met))


@pytest.mark.parametrize("task_id", ["K3", "V1", "R5"])
def test_what_is_searched_for_is_the_score_of_the_task(task_id: str) -> None:
    task = suite.load().task(task_id)
    setting = setting_of(task)
    kind, family, objective = searches(task_id)[-1]
    assert kind == "rule"
    rule = search(setting, family, objective, ((4, 1), (2, 1)))
    np.testing.assert_array_equal(rule, search(setting, family, objective, ((4, 1), (2, 1))))
    row = suite.score(family.policy(rule, "discrete"), task_id, episodes=3, perturbed=False)[0]
    assert row.value == pytest.approx(measured(setting, family, rule, objective, 3), abs=1e-6)


def test_every_vehicle_is_driven_by_the_rule_of_its_episode() -> None:
    setting = Setting("mo-deepdrive-roundabout-v0", {"vehicles": 2})
    waits = np.array([[0.0, 4.0, 4.0, 4.0], [3.0, 4.0, 4.0, 4.0]])
    early, late = (each.lengths for (each,) in setting.drive(BLIND["roundabout"], waits, 2, "validation"))
    assert (late > early).any()
    (alone,) = setting.drive(BLIND["roundabout"], waits[1:], 2, "validation")[0]
    np.testing.assert_array_equal(alone.lengths, late)


def test_the_best_of_those_who_see_nobody_is_behind_a_rule_that_sees_the_other() -> None:
    setting = Setting("mo-deepdrive-intersection-v1", {}, ("rule:parked_99", "rule:waves_2"))
    objective = objective_of(suite.load().task("V1"))
    blind = search(setting, BLIND["intersection"], objective, ((32, 4), (8, 8)))
    sees = np.array([5.0, 2.8, 6.0, 8.0, 0.73, 0.0, 0.3, 0.0])
    seeing = measured(setting, SEEING["intersection"], sees, objective, 40)
    assert seeing > measured(setting, BLIND["intersection"], blind, objective, 40) + 1.0


def test_an_objective_may_be_any_number_of_evaluations() -> None:
    setting = Setting("mo-deepdrive-roundabout-v0", {"vehicles": 2})
    collided = Objective(lambda met: (met[0].ends == "collision").mean(axis=1), lambda samples: -float(samples.mean()))
    rule = search(setting, SEEING["roundabout"], collided, ((4, 2), (2, 4)))
    assert measured(setting, SEEING["roundabout"], rule, collided, 4) <= 0.0


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
