"""One random stream per world, drawn in blocks, so that a reset needs no Python call per world."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.utils import seeding

from mo_deepdrive.support.plain_values import whole_number
from mo_deepdrive.world.batch import Draws

if TYPE_CHECKING:
    from numpy.typing import NDArray

BLOCK = 16  # episodes for which a world draws at once, at most
BLOCK_SIZE = 200  # uniforms; an episode of many vehicles takes dozens
_WORD = (1 << 64) - 1


def checked_seed(seed: Any, name: str = "seed") -> int | None:
    """The ``seed`` of a random stream; a ValueError, with its ``name``, unless it is None or not negative."""
    if seed is None:
        return None
    return whole_number(name, seed, 0, allowed="None or a non-negative integer")


class Streams(Draws):
    """Generators, one per world, which draw the same numbers as a single environment with the same seed.

    An episode takes ``draws`` uniforms. Of the ``seeds``, one per world, None stands for a random one.
    """

    def __init__(self, seeds: list[int | None], draws: int):
        pairs = [seeding.np_random(seed) for seed in seeds]
        self._generators: list[np.random.Generator] = [generator for generator, _ in pairs]
        self.seeds: list[int] = [used for _, used in pairs]
        super().__init__(len(seeds), draws, self._generators, max(1, min(BLOCK, BLOCK_SIZE // draws)))

    @property
    def generators(self) -> tuple[np.random.Generator, ...]:
        """The generator of every world."""
        return tuple(self._generators)

    def reseed(self, seeds: list[int | None], mask: NDArray[np.bool_]) -> None:
        """Restart the streams of the worlds in ``mask`` whose seed is not None."""
        for i in np.flatnonzero(mask):
            if seeds[i] is not None:
                self._generators[i], self.seeds[i] = seeding.np_random(seeds[i])
                self.cursors[i] = self.blocks.shape[1]

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Generator states (N, 4) uint64 (PCG64 state and increment, high and low words), blocks and cursors."""
        words = np.zeros((len(self._generators), 4), dtype=np.uint64)
        for row, generator in zip(words, self._generators, strict=True):
            state = generator.bit_generator.state["state"]
            row[:] = [state["state"] >> 64, state["state"] & _WORD, state["inc"] >> 64, state["inc"] & _WORD]
        return {"generators": words, "blocks": self.blocks.copy(), "cursors": self.cursors.copy()}

    @staticmethod
    def check(state: dict[str, NDArray[Any]]) -> None:
        """Refuse blocks and cursors that no drawing leads to, and generators that repeat themselves too soon.

        Raises:
            ValueError: naming the array, its value and its range.
        """
        blocks, cursors = state["blocks"], state["cursors"]
        for name, array, fine, allowed in (
            ("blocks", blocks, (blocks >= 0.0) & (blocks < 1.0), "in [0, 1)"),
            ("cursors", cursors, (cursors >= 0) & (cursors <= blocks.shape[1]), f"between 0 and {blocks.shape[1]}"),
        ):
            if not fine.all():
                raise ValueError(f"state {name!r} has {array[~fine][0]}; it must be {allowed}")
        increments = state["generators"][:, 3]
        if (even := increments % 2 == 0).any():
            raise ValueError(f"state 'generators' has the increment {increments[even][0]}; it must be odd")

    def set_state(self, state: dict[str, NDArray[Any]]) -> None:
        """Resume from the result of :meth:`get_state`."""
        for row, generator in zip(state["generators"], self._generators, strict=True):
            high, low, inc_high, inc_low = (int(word) for word in row)
            bit_generator = generator.bit_generator
            bit_generator.state = {
                **bit_generator.state,
                "state": {"state": high << 64 | low, "inc": inc_high << 64 | inc_low},
            }
        self.blocks[:] = state["blocks"]
        self.cursors[:] = state["cursors"]
