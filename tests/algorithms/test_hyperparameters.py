"""Schedules at their ends and in between."""

from __future__ import annotations

import pytest

from algorithms.hyperparameters import geometric_schedule, linear_schedule


def test_a_linear_schedule_moves_evenly_and_stops_at_its_end() -> None:
    assert [linear_schedule(1.0, 0.0, progress) for progress in (0.0, 0.25, 1.0, 2.0)] == [1.0, 0.75, 0.0, 0.0]
    assert linear_schedule(0.3, None, 0.9) == 0.3


def test_a_geometric_schedule_moves_by_a_constant_factor_and_stops_at_its_end() -> None:
    values = [geometric_schedule(0.1, 0.001, progress) for progress in (0.0, 0.5, 1.0, 3.0)]
    assert values == pytest.approx([0.1, 0.01, 0.001, 0.001])
    assert geometric_schedule(0.0, 0.0, 0.5) == 0.0
