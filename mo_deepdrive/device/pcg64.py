"""The random numbers of ``numpy.random.default_rng(seed)``, compiled: those from which ``env.reset(seed=seed)`` draws.

``numpy.random.SeedSequence`` makes 256 bits of a seed, from which PCG64 starts (M. E. O'Neill, "PCG: a family of simple
fast space-efficient statistically good algorithms for random number generation", HMC-CS-2014-0905, 2014).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.philox import HALF, ONE, STEP, UNUSED, WORD

if TYPE_CHECKING:
    from numpy.typing import NDArray

STREAM = 8  # words of a stream: state and increment, of each the higher half first, and a pool of four
HASH_A, TIMES_A = np.uint64(0x43B0D7E5), np.uint64(0x931E8875)
HASH_B, TIMES_B = np.uint64(0x8B51F9DD), np.uint64(0x58F38DED)
MIX_LEFT, MIX_RIGHT, SHIFT = np.uint64(0xCA01F9DD), np.uint64(0x4973F715), np.uint64(16)
TIMES_HIGH, TIMES_LOW = np.uint64(0x2360ED051FC65DA4), np.uint64(0x4385DF649FCCF645)
ROTATION, BITS, LAST = np.uint64(58), np.uint64(64), np.uint64(63)


@jit
def _hashed(word: np.uint64, constant: np.uint64, times: np.uint64) -> tuple[np.uint64, np.uint64]:
    """A word of 32 bits that is hashed with a constant, and the next constant."""
    constant, word = (constant * times) & WORD, word ^ constant
    word = (word * constant) & WORD
    return word ^ (word >> SHIFT), constant


@jit
def _advance(stream: NDArray[np.uint64]) -> None:
    """The next state: the state times TIMES, plus the increment."""
    high, low = stream[0], stream[1]
    # The product of the lower halves has 128 bits: it is made of halves of theirs.
    a, b, c, d = low & WORD, low >> HALF, TIMES_LOW & WORD, TIMES_LOW >> HALF
    middle = b * c + ((a * c) >> HALF)
    carried = b * d + (middle >> HALF) + ((a * d + (middle & WORD)) >> HALF)
    stream[1] = low * TIMES_LOW + stream[3]
    stream[0] = high * TIMES_LOW + low * TIMES_HIGH + carried + stream[2] + np.uint64(stream[1] < stream[3])


@jit
def seed_stream(seed: np.uint64, stream: NDArray[np.uint64]) -> None:
    """Start a ``stream`` (STREAM,)."""
    pool = stream[4:]
    constant, words = HASH_A, (seed & WORD, seed >> HALF, np.uint64(0), np.uint64(0))
    for k in range(4):
        pool[k], constant = _hashed(words[k], constant, TIMES_A)
    for source in range(4):
        for k in range(4):
            if k != source:
                word, constant = _hashed(pool[source], constant, TIMES_A)
                word = (MIX_LEFT * pool[k] - MIX_RIGHT * word) & WORD
                pool[k] = word ^ (word >> SHIFT)
    constant = HASH_B
    for k in range(4):
        low, constant = _hashed(pool[2 * k % 4], constant, TIMES_B)
        high, constant = _hashed(pool[2 * k % 4 + 1], constant, TIMES_B)
        stream[k] = high << HALF | low
    # The increment is odd, and the first state is what follows the increment plus the state that was hashed.
    stream[2], stream[3] = stream[2] << ONE | stream[3] >> LAST, stream[3] << ONE | ONE
    stream[1] += stream[3]
    stream[0] += stream[2] + np.uint64(stream[1] < stream[3])
    _advance(stream)


@jit
def draw(stream: NDArray[np.uint64], _cursors: NDArray[np.int64], _i: int, drawn: NDArray[np.float64]) -> bool:
    """Write the next uniforms in [0, 1) into ``drawn`` (1, draws), as ``autoreset.resetting`` calls it."""
    for k in range(drawn.shape[1]):
        _advance(stream)
        word, turn = stream[0] ^ stream[1], stream[0] >> ROTATION
        drawn[0, k] = np.float64((word >> turn | word << ((BITS - turn) & LAST)) >> UNUSED) * STEP
    return True
