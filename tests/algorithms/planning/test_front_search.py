"""The evolutionary search for a front."""

from __future__ import annotations

from typing import TYPE_CHECKING

from algorithms.planning import front_search

if TYPE_CHECKING:
    import pytest


def test_offspring_improve_on_what_rules_find(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(front_search, "POPULATION", 512)
    search = front_search.FrontSearch("one_waypoint", "discrete", 0)
    for _ in range(front_search.RULE_GENERATIONS):
        search.evolve(0)
    before = search.hypervolumes(search.archive)
    for _ in range(5):
        search.evolve(0)
    assert all(new > old for new, old in zip(search.hypervolumes(search.archive), before, strict=True))
