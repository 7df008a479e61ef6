"""Sine and cosine of an angle, computed together, and the angle of a direction, inlined into the kernel.

The compiler can neither reorder nor vectorise calls of the C library's functions, which took half of the time of a
physics step. Here the angle is reduced to [-pi/4, pi/4] by multiples of pi/2 in two parts (Cody and Waite 1980); there,
Taylor polynomials of degree 15 and 16 are accurate to the last bits (error below 3e-16; see the tests). The tangent of
an angle is reduced to [-tan(pi/8), tan(pi/8)], where a polynomial of degree 23 interpolates the arctangent (relative
error below 4e-16). Nothing here branches.
"""

from __future__ import annotations

import math
import sys
from typing import Any

import numpy as np
from numba.extending import overload

from mo_deepdrive.simulation.jit import jit

# pi/2 in two parts: the first has 33 significant bits, so its products with small integers are exact.
HALF_PI_HIGH = 1.57079632673412561417e00
HALF_PI_LOW = 6.07710050650619224932e-11
TWO_OVER_PI = 2 / math.pi
LARGEST = 1.0e6  # rad; beyond it the products are no longer exact

S3, S5, S7, S9 = -1 / 6, 1 / 120, -1 / 5040, 1 / 362880
S11, S13, S15 = -1 / 39916800, 1 / 6227020800, -1 / 1307674368000
C4, C6, C8, C10 = 1 / 24, -1 / 720, 1 / 40320, -1 / 3628800
C12, C14, C16 = 1 / 479001600, -1 / 87178291200, 1 / 20922789888000


SMALLEST = sys.float_info.min
TAN_EIGHTH = math.sqrt(2.0) - 1.0  # tan(pi/8)
# (1 - atan(t) / t) / t^2, interpolated at the 11 Chebyshev nodes of t^2 in [0, tan^2(pi/8)].
A0, A2, A4, A6 = 0.3333333333333333, -0.1999999999999552, 0.14285714284666542, -0.11111111015256361
A8, A10, A12, A14 = 0.09090904578123903, -0.07692183190826087, 0.06664511447381948, -0.0585814891280221
A16, A18, A20 = 0.0508544973794026, -0.03923165829558719, 0.01917688711906226


def floor(x: float) -> float:
    """The greatest whole number of at most ``x``; each target compiles a function of its own for it."""
    return float(np.floor(x))


# Numba's compiler for GPUs does not know np.floor: mo_deepdrive.device.cuda says what it takes instead.
@overload(floor, strict=False, inline="always", target="cpu")
def _floor(x: float) -> Any:  # noqa: ARG001  (a type, by the name of the argument)
    return lambda x: np.floor(x)


@jit
def sine_cosine(angle: float) -> tuple[float, float]:
    """(sin(angle), cos(angle)) of an angle (rad) of at most LARGEST."""
    quarter = floor(angle * TWO_OVER_PI + 0.5)
    r = (angle - quarter * HALF_PI_HIGH) - quarter * HALF_PI_LOW
    z = r * r
    z2 = z * z
    z4 = z2 * z2
    sine = r + r * z * ((S3 + z * S5) + z2 * (S7 + z * S9) + z4 * ((S11 + z * S13) + z2 * S15))
    cosine = (1.0 - 0.5 * z) + z2 * ((C4 + z * C6) + z2 * (C8 + z * C10) + z4 * ((C12 + z * C14) + z2 * C16))
    # Floating-point arithmetic, since AVX2 cannot convert to integers.
    half = floor(0.5 * quarter)
    swapped = quarter != 2.0 * half
    opposite = half != 2.0 * floor(0.5 * half)
    if swapped:
        sine, cosine = cosine, sine
    return -sine if opposite else sine, -cosine if opposite != swapped else cosine


@jit
def angle_of(y: float, x: float) -> float:
    """Angle (rad, in [-pi, pi]) from the axis of x to the direction (x, y), as math.atan2; zero if both are zero."""
    low = min(abs(x), abs(y))
    high = max(abs(x), abs(y))
    # Beyond an eighth turn, atan(t) = pi/4 + atan((t - 1) / (t + 1)).
    steep = low > TAN_EIGHTH * high
    t = (low - (high if steep else 0.0)) / max(high + (low if steep else 0.0), SMALLEST)
    z = t * t
    z2 = z * z
    z4 = z2 * z2
    series = ((A0 + z * A2) + z2 * (A4 + z * A6)) + z4 * ((A8 + z * A10) + z2 * (A12 + z * A14))
    series += z4 * z4 * ((A16 + z * A18) + z2 * A20)
    angle = t - t * z * series
    angle += math.pi / 4 if steep else 0.0
    angle = math.pi / 2 - angle if abs(y) > abs(x) else angle
    return math.copysign(math.pi - angle if x < 0.0 else angle, y)
