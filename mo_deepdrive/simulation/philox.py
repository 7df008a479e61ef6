"""Random numbers from counters: Philox 4x32-10.

J. K. Salmon, M. A. Moraes, R. O. Dror, D. E. Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011. A block of
four words is a function of a key and a counter, so no state has to be saved, and every world can draw by itself. Here
the key is a seed, and the counter says which block of which episode of which environment.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.state import Record, aligned

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Whose random numbers a world draws, and the number of its next episode.
STREAM = aligned(np.dtype([("seed", np.uint64), ("environment", np.uint64), ("episode", np.uint64)]))

# Words are 32 bits in integers of 64. All operands have this type: of a signed one Numba would make a float.
WORD = np.uint64(0xFFFFFFFF)
HALF = np.uint64(32)
MULTIPLIER_0, MULTIPLIER_1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
WEYL_0, WEYL_1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
ROUNDS = 10
UNUSED = np.uint64(11)  # bits of 64; a float64 in [0, 1) has 53
STEP = 2.0**-53
ONE = np.uint64(1)


@jit
def philox(
    c0: np.uint64, c1: np.uint64, c2: np.uint64, c3: np.uint64, k0: np.uint64, k1: np.uint64
) -> tuple[np.uint64, np.uint64, np.uint64, np.uint64]:
    """Four words from the counter (c0, c1, c2, c3) and the key (k0, k1)."""
    for _ in range(ROUNDS):
        first = MULTIPLIER_0 * c0
        second = MULTIPLIER_1 * c2
        c0, c1, c2, c3 = (second >> HALF) ^ c1 ^ k0, second & WORD, (first >> HALF) ^ c3 ^ k1, first & WORD
        k0 = (k0 + WEYL_0) & WORD
        k1 = (k1 + WEYL_1) & WORD
    return c0, c1, c2, c3


@jit
def draw(stream: Record, attempt: int, draws: NDArray[np.float64], j: int) -> None:
    """Write the uniforms in [0, 1) of the next episode of a stream.

    Args:
        stream: record STREAM, read only.
        attempt: how often these have been drawn already, because what they place is no valid scenario.
        draws: (k, draws); the row ``j`` is written.
        j: which row.
    """
    count = draws.shape[1]
    blocks = (count + 1) // 2
    for block in range(blocks):
        a, b, c, d = philox(
            np.uint64(attempt * blocks + block), stream.environment & WORD,
            stream.episode & WORD, stream.episode >> HALF, stream.seed & WORD, stream.seed >> HALF,
        )  # fmt: skip
        draws[j, 2 * block] = np.float64((a << HALF | b) >> UNUSED) * STEP
        if 2 * block + 1 < count:
            draws[j, 2 * block + 1] = np.float64((c << HALF | d) >> UNUSED) * STEP
