"""The evolutionary search for a front: what it improves, and its selection."""

from __future__ import annotations

import moocore
import numpy as np
import pytest

from mo_deepdrive.fronts.reference_fronts import front_config, reference_point
from scripts.bounds import front
from scripts.bounds.front import (
    RULE_GENERATIONS,
    FrontSearch,
    dominated_volume,
    greedy_hypervolume_subset,
    select_front,
)
from scripts.bounds.plans import CRITERIA, PlanEvaluator


@pytest.mark.slow
def test_offspring_improve_on_what_rules_find(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(front, "POPULATION", 512)
    search = FrontSearch("one_waypoint", "discrete", 0)
    for _ in range(RULE_GENERATIONS):
        search.evolve(0)
    before = search.hypervolumes(search.archive)
    for _ in range(5):
        search.evolve(0)
    assert all(new > old for new, old in zip(search.hypervolumes(search.archive), before, strict=True))


def test_a_plan_of_the_front_is_not_lost_when_its_box_keeps_another(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(front, "POPULATION", 512)
    search = FrontSearch("one_waypoint", "discrete", 0)
    for _ in range(RULE_GENERATIONS + 1):
        search.evolve(0)
    search.front = search.select_front()
    before = search.hypervolumes(search.front)
    search.archive = search.archive.take(np.arange(1))
    assert search.hypervolumes(search.select_front()) == pytest.approx(before, rel=1e-9)


def test_the_greedy_subset_is_that_of_a_plain_loop() -> None:
    rng = np.random.default_rng(0)
    returns = rng.random((40, 3))
    reference = np.full(3, -0.1)
    selected = greedy_hypervolume_subset(returns, reference, 6)
    expected: list[int] = []
    for _ in range(6):
        volumes = [dominated_volume(returns[[*expected, row]], reference) for row in range(40)]
        expected.append(int(np.argmax(volumes)))
    assert selected == expected
    full = greedy_hypervolume_subset(returns, reference, 40)
    assert set(full) == set(np.flatnonzero(moocore.is_nondominated(returns, maximise=True)))


def test_plans_that_do_not_dominate_the_reference_points_are_not_selected() -> None:
    evaluator = PlanEvaluator(front_config("one_waypoint", "continuous"))
    gentle, hard = np.array([[0.0, 0.1, -1.0]] * 30), np.array([[0.0, 1.0, -1.0], [0.0, -0.9, -1.0]] * 30)
    evaluated = evaluator.evaluate(evaluator.format.from_sequences([gentle, hard, np.zeros((0, 3))]), 0)
    references = [
        reference_point("one_waypoint", "continuous", criterion.gamma, criterion.objectives("one_waypoint")).values
        for criterion in CRITERIA
    ]
    assert (evaluated.returns[0][1] < references[0]).any()
    selected = select_front(evaluated, references)
    np.testing.assert_array_equal(selected.plans, evaluated.plans[[0, 2]])
