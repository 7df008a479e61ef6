"""Random numbers from counters."""

from __future__ import annotations

import numpy as np
import pytest

from mo_deepdrive.simulation.philox import STREAM, draw, philox

ONES = "ffffffff"


# The known answers that Salmon et al. publish with their library (Random123, kat_vectors).
@pytest.mark.parametrize(
    ("counter", "key", "answer"),
    [
        ("0 0 0 0", "0 0", "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
        (f"{ONES} {ONES} {ONES} {ONES}", f"{ONES} {ONES}", "408f276d 41c83b0e a20bc7c6 6d5451fd"),
        ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0", "d16cfe09 94fdcceb 5001e420 24126ea1"),
    ],
)
def test_the_published_answers_are_reproduced(counter: str, key: str, answer: str) -> None:
    words = philox(*(np.uint64(int(word, 16)) for word in f"{counter} {key}".split()))
    assert " ".join(f"{int(word):08x}" for word in words) == answer


def uniforms(seed: int, environment: int, episode: int, attempt: int = 0, count: int = 23) -> np.ndarray:
    stream = np.zeros(1, dtype=STREAM)
    stream["seed"], stream["environment"], stream["episode"] = seed, environment, episode
    draws = np.zeros((1, count))
    draw(stream[0], attempt, draws, 0)
    return draws[0]


def test_every_seed_environment_episode_and_attempt_has_numbers_of_its_own() -> None:
    origins = [(0, 0, 0, 0), (1, 0, 0, 0), (2**40, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 2**40, 0), (0, 0, 0, 1)]
    drawn = np.stack([uniforms(*origin) for origin in origins])
    assert len(np.unique(drawn)) == drawn.size
    assert drawn.min() >= 0.0
    assert drawn.max() < 1.0
    np.testing.assert_array_equal(uniforms(0, 1, 0, count=4), uniforms(0, 1, 0)[:4])
