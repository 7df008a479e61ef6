"""Plane geometry of oriented boxes. A box is a vehicle: centre (x, y), cosine and sine of its heading.

Heading 0 points along +y and grows counter-clockwise, so a box looks along (-sin h, cos h) and its right-hand
side lies along (cos h, sin h).
"""

from __future__ import annotations

import math

from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.state import LENGTH, WIDTH
from mo_deepdrive.simulation.trigonometry import angle_of

HALF_LENGTH = LENGTH / 2
HALF_WIDTH = WIDTH / 2
RADIUS = math.hypot(HALF_LENGTH, HALF_WIDTH)


@jit
def corner(x: float, y: float, cos: float, sin: float, ahead: float, right: float) -> tuple[float, float]:
    """World position of the point ``ahead`` m in front and ``right`` m to the right of the centre."""
    return x - sin * ahead + cos * right, y + cos * ahead + sin * right


@jit
def angle_to(front_x: float, front_y: float, cos: float, sin: float, px: float, py: float) -> float:
    """Angle (rad, in [-pi, pi], positive to the right) from the heading to the point (px, py)."""
    dx = px - front_x
    dy = py - front_y
    return angle_of(dx * cos + dy * sin, dy * cos - dx * sin)


@jit
def distance(ax: float, ay: float, bx: float, by: float) -> float:
    """Euclidean distance (m)."""
    return math.sqrt((ax - bx) * (ax - bx) + (ay - by) * (ay - by))


@jit
def segment_touches_box(x: float, y: float, cos: float, sin: float, ax: float, ay: float, bx: float, by: float) -> bool:
    """Whether the segment a-b and the solid box share a point (slab test in the box's own frame)."""
    a_right = (ax - x) * cos + (ay - y) * sin
    a_ahead = (ay - y) * cos - (ax - x) * sin
    b_right = (bx - x) * cos + (by - y) * sin
    b_ahead = (by - y) * cos - (bx - x) * sin
    enter = 0.0
    leave = 1.0
    for axis in range(2):
        if axis == 0:
            start, change, half = a_right, b_right - a_right, HALF_WIDTH
        else:
            start, change, half = a_ahead, b_ahead - a_ahead, HALF_LENGTH
        if change == 0.0:
            if abs(start) > half:
                return False
        else:
            first = (-half - start) / change
            second = (half - start) / change
            enter = max(enter, min(first, second))
            leave = min(leave, max(first, second))
    return enter <= leave


@jit
def boxes_overlap(
    ax: float, ay: float, a_cos: float, a_sin: float, bx: float, by: float, b_cos: float, b_sin: float
) -> bool:
    """Whether two solid vehicle boxes share a point (separating axes: the two sides of each box)."""
    dx = bx - ax
    dy = by - ay
    # |cosine| and |sine| of the angle between the boxes turn one box's half sizes onto the other's axes.
    turn_cos = abs(a_cos * b_cos + a_sin * b_sin)
    turn_sin = abs(a_cos * b_sin - a_sin * b_cos)
    wide = HALF_WIDTH + HALF_WIDTH * turn_cos + HALF_LENGTH * turn_sin
    long = HALF_LENGTH + HALF_LENGTH * turn_cos + HALF_WIDTH * turn_sin
    return (
        abs(dx * a_cos + dy * a_sin) <= wide
        and abs(dy * a_cos - dx * a_sin) <= long
        and abs(dx * b_cos + dy * b_sin) <= wide
        and abs(dy * b_cos - dx * b_sin) <= long
    )


@jit
def extent_x(x: float, cos: float, sin: float) -> tuple[float, float]:
    """Smallest and largest x over the four corners of the box."""
    half = HALF_LENGTH * abs(sin) + HALF_WIDTH * abs(cos)
    return x - half, x + half


@jit
def extent_y(y: float, cos: float, sin: float) -> tuple[float, float]:
    """Smallest and largest y over the four corners of the box."""
    half = HALF_LENGTH * abs(cos) + HALF_WIDTH * abs(sin)
    return y - half, y + half
