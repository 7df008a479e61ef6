"""The evolutionary search for a front."""

from __future__ import annotations

import numpy as np
import pytest

from scripts.bounds import front_search


def test_offspring_improve_on_what_rules_find(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(front_search, "POPULATION", 512)
    search = front_search.FrontSearch("one_waypoint", "discrete", 0)
    for _ in range(front_search.RULE_GENERATIONS):
        search.evolve(0)
    before = search.hypervolumes(search.archive)
    for _ in range(5):
        search.evolve(0)
    assert all(new > old for new, old in zip(search.hypervolumes(search.archive), before, strict=True))


def test_a_plan_of_the_front_is_not_lost_when_its_box_keeps_another(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(front_search, "POPULATION", 512)
    search = front_search.FrontSearch("one_waypoint", "discrete", 0)
    for _ in range(front_search.RULE_GENERATIONS + 1):
        search.evolve(0)
    search.front = search.select_front()
    before = search.hypervolumes(search.front)
    search.archive = search.archive.take(np.arange(1))
    assert search.hypervolumes(search.select_front()) == pytest.approx(before, rel=1e-9)
