"""What several vehicles are worth together: three ways of adding up their utilities, which MAPPO can maximise, too."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


def total(utilities: Floats) -> Floats:
    """(...) the sum of utilities (..., V): nobody counts for more than another."""
    return np.asarray(np.sum(utilities, axis=-1))


def worst_off(utilities: Floats) -> Floats:
    """(...) the least of utilities (..., V)."""
    return np.asarray(np.min(utilities, axis=-1))


def generalised_gini(utilities: Floats) -> Floats:
    """(...) the sum of 2^-k u_k over the utilities u_1 <= u_2 <= ... (..., V), from the worst-off on.

    A gain counts for more where it goes to somebody worse off (J. A. Weymark, "Generalized Gini inequality indices",
    Mathematical Social Sciences 1, 1981).
    """
    return np.asarray(np.sort(utilities, axis=-1) @ 0.5 ** np.arange(1, np.shape(utilities)[-1] + 1))
