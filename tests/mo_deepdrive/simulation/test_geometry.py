"""Boxes that touch exactly, and angles at a point."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mo_deepdrive.simulation.geometry import (
    HALF_LENGTH,
    HALF_WIDTH,
    RADIUS,
    angle_to,
    boxes_overlap,
    corner,
    extent_x,
    extent_y,
    segment_touches_box,
)

UPRIGHT = (0.0, 0.0, 1.0, 0.0)  # at the origin, heading 0


def beyond(value: float) -> float:
    return float(np.nextafter(value, math.inf))


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_segment_on_the_edge_of_a_box_touches_it(side: float) -> None:
    right, ahead = side * HALF_WIDTH, side * HALF_LENGTH
    outside_right, outside_ahead = side * beyond(HALF_WIDTH), side * beyond(HALF_LENGTH)
    touching = {
        "along the side": (right, -1.0, right, 1.0),
        "along the end": (-1.0, ahead, 1.0, ahead),
        "to the side from outside": (3 * right, 0.0, right, 0.0),
        "from the side outwards": (right, 0.0, 3 * right, 0.0),
        "to the end from outside": (0.0, 3 * ahead, 0.0, ahead),
        "a point on the corner": (right, ahead, right, ahead),
        "through": (-3 * right, 0.0, 3 * right, 0.0),
    }
    apart = {
        "along the side": (outside_right, -1.0, outside_right, 1.0),
        "along the end": (-1.0, outside_ahead, 1.0, outside_ahead),
        "before the side": (3 * right, 0.0, 1.001 * right, 0.0),
        "behind the side": (1.001 * right, 0.0, 3 * right, 0.0),
        "past the corner": (2 * right + side, ahead, right, 2 * ahead),
    }
    assert {name: segment_touches_box(*UPRIGHT, *ends) for name, ends in touching.items()} == dict.fromkeys(
        touching, True
    )
    assert {name: segment_touches_box(*UPRIGHT, *ends) for name, ends in apart.items()} == dict.fromkeys(apart, False)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_boxes_that_touch_exactly_overlap(sign: float) -> None:
    wide, long = 2 * HALF_WIDTH, 2 * HALF_LENGTH
    for x, y in ((wide, 0.0), (0.0, long), (wide, long)):
        assert boxes_overlap(*UPRIGHT, sign * x, sign * y, 1.0, 0.0)
    for x, y in ((beyond(wide), 0.0), (0.0, beyond(long))):
        assert not boxes_overlap(*UPRIGHT, sign * x, sign * y, 1.0, 0.0)
    # A box across: half its length and half the other's width.
    across = HALF_WIDTH + HALF_LENGTH
    for x, y in ((across, 0.0), (0.0, across)):
        assert boxes_overlap(*UPRIGHT, sign * x, sign * y, 0.0, 1.0)
        assert not boxes_overlap(*UPRIGHT, sign * beyond(beyond(x)), sign * beyond(beyond(y)), 0.0, 1.0)


def test_the_angle_to_the_point_itself_is_zero_and_grows_to_the_right() -> None:
    assert angle_to(2.0, 3.0, 1.0, 0.0, 2.0, 3.0) == 0.0
    for point, angle in (((2.0, 4.0), 0.0), ((3.0, 3.0), 0.5), ((1.0, 3.0), -0.5), ((3.0, 2.0), 0.75)):
        assert angle_to(2.0, 3.0, 1.0, 0.0, *point) == pytest.approx(angle * math.pi)
    # A heading of a quarter turn looks along -x.
    assert angle_to(0.0, 0.0, 0.0, 1.0, -1.0, 1.0) == pytest.approx(math.pi / 4)


@pytest.mark.parametrize("heading", [0.0, 0.7, math.pi / 2, 2.5, -1.1])
def test_the_extent_of_a_box_is_that_of_its_corners(heading: float) -> None:
    cos, sin = math.cos(heading), math.sin(heading)
    signs = [(a, r) for a in (1, -1) for r in (1, -1)]
    corners = np.array([corner(5.0, -3.0, cos, sin, a * HALF_LENGTH, r * HALF_WIDTH) for a, r in signs])
    assert extent_x(5.0, cos, sin) == pytest.approx((corners[:, 0].min(), corners[:, 0].max()))
    assert extent_y(-3.0, cos, sin) == pytest.approx((corners[:, 1].min(), corners[:, 1].max()))
    assert np.hypot(*(corners - (5.0, -3.0)).T) == pytest.approx(RADIUS)
