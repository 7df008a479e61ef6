"""The running mean of episode returns against the definition of an exponentially weighted mean."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from algorithms.rollouts.running_mean import MEMORY, RunningMean


def test_the_first_vectors_are_averaged_and_later_ones_weighted_with_the_memory() -> None:
    mean = RunningMean(2, torch.device("cpu"))
    mean.add(np.zeros((0, 2)))
    assert (mean.value.tolist(), mean.count) == ([0.0, 0.0], 0)
    mean.add(np.array([[1.0, 4.0], [3.0, 0.0]]))
    assert (mean.value.tolist(), mean.count) == ([2.0, 2.0], 2)
    mean.add(np.array([[12.0, 2.0], [2.0, 2.0]]))
    expected = MEMORY**2 * 2.0 + (1 - MEMORY**2) * 7.0
    assert mean.value.tolist() == pytest.approx([expected, 2.0])


def test_a_restored_mean_continues_like_the_original() -> None:
    first, second = (RunningMean(3, torch.device("cpu")) for _ in range(2))
    rng = np.random.default_rng(0)
    first.add(rng.normal(size=(5, 3)))
    second.set_state(first.get_state())
    more = rng.normal(size=(2, 3))
    first.add(more)
    second.add(more)
    assert torch.equal(first.value, second.value)
    assert first.count == second.count == 7
