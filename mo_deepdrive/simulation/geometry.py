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
def time_to_collision(
    dx: float, dy: float, dvx: float, dvy: float, a_cos: float, a_sin: float, b_cos: float, b_sin: float
) -> float:
    """When two solid boxes that keep their velocities first share a point (s); infinity if they never do.

    Time to collision as defined by J. C. Hayward, "Near-miss determination through use of a scale of danger", Highway
    Research Record 384, 1972, for boxes: both move straight on without turning, and their shadows on every separating
    axis overlap during an interval of time.

    Args:
        dx: x of the centre of b from that of a (m).
        dy: y likewise.
        dvx: x of the velocity of b relative to that of a (m/s).
        dvy: y likewise.
        a_cos: cosine of the heading of a.
        a_sin: its sine.
        b_cos: cosine of the heading of b.
        b_sin: its sine.
    """
    turn_cos = abs(a_cos * b_cos + a_sin * b_sin)
    turn_sin = abs(a_cos * b_sin - a_sin * b_cos)
    wide = HALF_WIDTH + HALF_WIDTH * turn_cos + HALF_LENGTH * turn_sin
    long = HALF_LENGTH + HALF_LENGTH * turn_cos + HALF_WIDTH * turn_sin
    enter = 0.0
    leave = math.inf
    for axis in range(4):
        cos = a_cos if axis < 2 else b_cos
        sin = a_sin if axis < 2 else b_sin
        if axis % 2 == 0:  # to the right of the box
            start, change, half = dx * cos + dy * sin, dvx * cos + dvy * sin, wide
        else:  # ahead of it
            start, change, half = dy * cos - dx * sin, dvy * cos - dvx * sin, long
        if change == 0.0:
            if abs(start) > half:
                return math.inf
        else:
            first = (-half - start) / change
            second = (half - start) / change
            enter = max(enter, min(first, second))
            leave = min(leave, max(first, second))
    return enter if enter <= leave else math.inf


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
