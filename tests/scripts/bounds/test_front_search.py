"""The evolutionary search for a front: its archive, compared with a plain loop over boxes, and its selection."""

from __future__ import annotations

import moocore
import numpy as np
import pytest

from mo_deepdrive.fronts.reference_points import reference_point
from mo_deepdrive.world.objectives import scales
from scripts.bounds import front
from scripts.bounds.front import (
    EPSILON,
    RULE_GENERATIONS,
    FrontSearch,
    dominated_volume,
    epsilon_nondominated,
    greedy_hypervolume_subset,
    select_front,
)
from scripts.bounds.plans import CRITERIA, EvaluatedPlans, PlanEvaluator

OBJECTIVES = [criterion.objectives("one_waypoint") for criterion in CRITERIA]


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


def kept_by_a_loop(returns: np.ndarray, lengths: np.ndarray, names: tuple[str, ...]) -> set[int]:
    scaled = returns / scales(names)
    best: dict[tuple[float, ...], int] = {}
    for row, box in enumerate(map(tuple, np.floor(scaled / EPSILON).tolist())):
        if box not in best or (scaled[row].sum(), -lengths[row]) > (scaled[best[box]].sum(), -lengths[best[box]]):
            best[box] = row
    return {
        row
        for box, row in best.items()
        if not any(other != box and all(a >= b for a, b in zip(other, box, strict=True)) for other in best)
    }


def test_one_plan_of_every_nondominated_box_is_kept() -> None:
    rng = np.random.default_rng(0)
    n = 400
    # On a coarse scale, so that many returns are in one box.
    returns = tuple(rng.normal(0.0, 2.0 * EPSILON, (n, len(names))) * scales(names) for names in OBJECTIVES)
    lengths = rng.integers(1, 600, n)
    evaluated = EvaluatedPlans(np.zeros((n, 1, 1), dtype=np.int16), lengths, returns, np.zeros(n, dtype=np.int64))
    rows = epsilon_nondominated(evaluated, OBJECTIVES)
    kept = [kept_by_a_loop(each, lengths, names) for each, names in zip(returns, OBJECTIVES, strict=True)]
    assert set(rows.tolist()) == set().union(*kept)
    assert (np.diff(rows) > 0).all()


def test_of_equal_returns_the_shortest_episode_is_kept() -> None:
    returns = tuple(np.zeros((3, len(names))) for names in OBJECTIVES)
    plans = np.zeros((3, 1, 1), dtype=np.int16)
    evaluated = EvaluatedPlans(plans, np.array([7, 5, 6]), returns, np.zeros(3, np.int64))
    assert epsilon_nondominated(evaluated, OBJECTIVES).tolist() == [1]


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
    evaluator = PlanEvaluator("one_waypoint", "continuous")
    gentle, hard = np.array([[0.0, 0.1, -1.0]] * 30), np.array([[0.0, 1.0, -1.0], [0.0, -0.9, -1.0]] * 30)
    evaluated = evaluator.evaluate(evaluator.format.from_sequences([gentle, hard, np.zeros((0, 3))]), 0)
    references = [
        reference_point("one_waypoint", "continuous", criterion.gamma, criterion.objectives("one_waypoint")).values
        for criterion in CRITERIA
    ]
    assert (evaluated.returns[0][1] < references[0]).any()
    selected = select_front(evaluated, references)
    np.testing.assert_array_equal(selected.plans, evaluated.plans[[0, 2]])
