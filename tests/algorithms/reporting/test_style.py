"""Colours of curves."""

from __future__ import annotations

from algorithms.reporting.style import COLOURS, SINGLE_GROUP_COLOURS, curve_colour


def test_groups_differ_in_colour_and_a_single_group_by_the_kind_of_curve() -> None:
    colours = {curve_colour(group, len(COLOURS), kind=1) for group in range(len(COLOURS))}
    assert len(colours) == len(COLOURS)
    assert curve_colour(2, 3, kind=1) == curve_colour(2, 3, kind=2)
    assert [curve_colour(0, 1, kind) for kind in range(4)] == list(SINGLE_GROUP_COLOURS)
