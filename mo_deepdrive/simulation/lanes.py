"""Lanes: up to 16 worlds that are computed side by side.

A scratch record has an array of one value per lane for every quantity. A loop over the lanes without branches and calls
becomes vector instructions. Each lane is computed as if it were alone, so results do not depend on which worlds share a
block.
"""

from __future__ import annotations

from typing import Any

import numpy as np

LANES = 16  # two vectors of AVX-512, or four of AVX2


def in_lanes(*names: str) -> np.dtype[Any]:
    """A record with an array (LANES,) of float64 for every name."""
    return np.dtype((np.record, [(name, np.float64, (LANES,)) for name in names]))
