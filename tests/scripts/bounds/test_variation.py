"""Mutation and crossover of plans."""

from __future__ import annotations

import numpy as np
import pytest

from scripts.bounds.variation import make_offspring, resize_segment


def test_resizing_a_segment_moves_what_follows() -> None:
    def resized(first: int, last: int, room: int) -> list[int]:
        plan = np.arange(10, dtype=np.int16)[:, None]
        length = resize_segment(plan, 8, first, last, room)
        kept = plan[:length, 0].tolist()
        kept[first : min(first + room, length)] = [-1] * (min(first + room, length) - first)
        return kept

    assert resized(2, 4, 2) == [0, 1, -1, -1, 4, 5, 6, 7]
    assert resized(2, 4, 0) == [0, 1, 4, 5, 6, 7]
    assert resized(2, 2, 1) == [0, 1, -1, 2, 3, 4, 5, 6, 7]
    assert resized(6, 8, 4) == [0, 1, 2, 3, 4, 5, -1, -1, -1, -1]
    assert resized(1, 2, 6) == [0, -1, -1, -1, -1, -1, -1, 2, 3, 4]  # no longer than a plan
    assert resized(0, 8, 0) == []


@pytest.mark.parametrize("n_actions", [0, 16, 22])
def test_offspring_are_valid_plans_and_differ_from_their_parents(n_actions: int) -> None:
    rng = np.random.default_rng(0)
    k = 1 if n_actions else 3
    idle = np.array([0] if n_actions else [0, 0, -1024], dtype=np.int16)
    low, high = (0, n_actions) if n_actions else (-1024, 1025)
    parents = np.repeat(rng.integers(low, high, (300, 12, k)), 5, axis=1).astype(np.int16)
    lengths = rng.integers(0, 61, 300)
    offspring = np.tile(idle, (300, 60, 1))
    make_offspring(parents, lengths, parents[::-1].copy(), lengths[::-1].copy(), offspring, n_actions, idle, rng)
    assert offspring.min() >= low
    assert offspring.max() < high
    same = [np.array_equal(*each) for each in zip(offspring, parents, strict=True)]
    assert sum(same) < 100
