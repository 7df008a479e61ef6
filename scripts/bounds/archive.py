"""The archive of the front search: one plan per box of the objective space, by epsilon-dominance.

Of the boxes that no other box dominates one plan each is kept (Laumanns et al. 2002, "Combining convergence and
diversity in evolutionary multiobjective optimization"), which bounds the archive and spreads it over the front.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import moocore
import numpy as np

from mo_deepdrive.world.objectives import scales

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from scripts.bounds.plans import EvaluatedPlans

EPSILON = 0.005  # edge of a box, as a share of each objective's nominal scale


def epsilon_nondominated(evaluated: EvaluatedPlans, objectives: Sequence[tuple[str, ...]]) -> NDArray[np.int64]:
    """Rows of the plans that the archive keeps.

    Args:
        evaluated: n plans.
        objectives: names of the d objectives, for each of CRITERIA.

    Returns:
        (m,) sorted rows: for each of CRITERIA, one plan of every box of returns that no other box dominates. In a box
        the greatest sum of scaled returns wins, then the shortest episode.
    """
    kept = []
    for returns, names in zip(evaluated.returns, objectives, strict=True):
        scaled = returns / scales(names)
        boxes = np.floor(scaled / EPSILON)
        order = np.lexsort((evaluated.lengths, -scaled.sum(axis=1)))
        _, best = np.unique(boxes[order], axis=0, return_index=True)
        rows = order[best]
        kept.append(rows[moocore.is_nondominated(boxes[rows], maximise=True)])
    return np.unique(np.concatenate(kept))
