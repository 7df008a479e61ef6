"""Offspring of plans."""

from __future__ import annotations

import numpy as np
import pytest

from scripts.bounds.variation import make_offspring


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
