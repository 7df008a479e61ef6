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

# Numbers of 128 bits are four words of 32, the lowest first, each in an integer of 64.
WORDS = 4
STATE, INCREMENT, NEXT = range(0, 3 * WORDS, WORDS)  # where they are in a stream
HASH_A, TIMES_A = np.uint64(0x43B0D7E5), np.uint64(0x931E8875)
HASH_B, TIMES_B = np.uint64(0x8B51F9DD), np.uint64(0x58F38DED)
MIX_LEFT, MIX_RIGHT, SHIFT = np.uint64(0xCA01F9DD), np.uint64(0x4973F715), np.uint64(16)
TIMES = tuple(np.uint64(word) for word in (0x9FCCF645, 0x4385DF64, 0x1FC65DA4, 0x2360ED05))
ROTATION, BITS, LAST = np.uint64(58), np.uint64(64), np.uint64(63)


@jit
def _hashed(word: np.uint64, constant: np.uint64, times: np.uint64) -> tuple[np.uint64, np.uint64]:
    """A word that is hashed with a constant, and the next constant."""
    constant, word = (constant * times) & WORD, word ^ constant
    word = (word * constant) & WORD
    return word ^ (word >> SHIFT), constant


@jit
def _advance(stream: NDArray[np.uint64]) -> None:
    """The next state: the state times TIMES, plus the increment."""
    for k in range(WORDS):
        stream[NEXT + k] = stream[INCREMENT + k]
    for k in range(WORDS):
        carry = np.uint64(0)
        for j in range(WORDS - k):
            total = stream[STATE + k] * TIMES[j] + stream[NEXT + k + j] + carry
            stream[NEXT + k + j], carry = total & WORD, total >> HALF
    for k in range(WORDS):
        stream[STATE + k] = stream[NEXT + k]


@jit
def seed_stream(seed: np.uint64, stream: NDArray[np.uint64]) -> None:
    """Start a ``stream`` (12,): state, increment, and room for the next state."""
    pool = stream[NEXT:]
    constant, words = HASH_A, (seed & WORD, seed >> HALF, np.uint64(0), np.uint64(0))
    for k in range(WORDS):
        pool[k], constant = _hashed(words[k], constant, TIMES_A)
    for source in range(WORDS):
        for k in range(WORDS):
            if k != source:
                word, constant = _hashed(pool[source], constant, TIMES_A)
                word = (MIX_LEFT * pool[k] - MIX_RIGHT * word) & WORD
                pool[k] = word ^ (word >> SHIFT)
    constant = HASH_B
    for k in range(2 * WORDS):  # of both the higher half comes first
        stream[k ^ 2], constant = _hashed(pool[k % WORDS], constant, TIMES_B)
    # The increment is odd, and the first state is what follows the increment plus the state that was hashed.
    carry = ONE
    for k in range(WORDS):
        total = (stream[INCREMENT + k] << ONE) + carry
        stream[INCREMENT + k], carry = total & WORD, total >> HALF
    carry = np.uint64(0)
    for k in range(WORDS):
        total = stream[STATE + k] + stream[INCREMENT + k] + carry
        stream[STATE + k], carry = total & WORD, total >> HALF
    _advance(stream)


@jit
def uniform(stream: NDArray[np.uint64]) -> float:
    """The next number in [0, 1)."""
    _advance(stream)
    low, high = stream[1] << HALF | stream[0], stream[3] << HALF | stream[2]
    word, turn = high ^ low, high >> ROTATION
    word = word >> turn | word << ((BITS - turn) & LAST)
    return float(np.float64(word >> UNUSED) * STEP)


@jit
def draw(stream: NDArray[np.uint64], _cursors: NDArray[np.int64], _i: int, drawn: NDArray[np.float64]) -> bool:
    """Write the next uniforms into ``drawn`` (1, draws), as ``autoreset.resetting`` calls it."""
    for k in range(drawn.shape[1]):
        drawn[0, k] = uniform(stream)
    return True
