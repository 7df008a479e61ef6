"""Hypervolume subset selection: which of the plans found make up the front.

Greedy selection by hypervolume contribution (Guerreiro, Fonseca and Paquete 2016, "Greedy hypervolume subset selection
in low dimensions"), with lazy updates: a contribution can only shrink as others are selected (Minoux 1978).
"""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING, Any

import moocore
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from scripts.bounds.plans import EvaluatedPlans

# For each of CRITERIA, the most plans that are selected for it and those after it.
FRONT_SIZES = (350, 150, 100)


def dominated_volume(returns: NDArray[Any], reference: NDArray[Any]) -> float:
    """The hypervolume of ``returns`` (n, d) above ``reference`` (d,), maximised; 0 where no return dominates it."""
    return float(moocore.hypervolume(returns, ref=reference, maximise=True))


def greedy_hypervolume_subset(returns: NDArray[Any], reference: NDArray[Any], size: int) -> list[int]:
    """At most ``size`` rows of ``returns`` (n, d), each the one that adds most hypervolume to those before it.

    Rows that add nothing are not selected.
    """
    selected: list[int] = []
    volume = 0.0
    # Minus the contribution, the row, and how many rows were selected when the contribution was computed.
    queue = [(-dominated_volume(returns[[row]], reference), row, 0) for row in range(len(returns))]
    heapq.heapify(queue)
    while queue and len(selected) < size:
        loss, row, selected_then = heapq.heappop(queue)
        if loss >= 0.0:
            break
        if selected_then == len(selected):
            selected.append(row)
            volume -= loss
        else:
            loss = volume - dominated_volume(returns[[*selected, row]], reference)
            heapq.heappush(queue, (loss, row, len(selected)))
    return selected


def select_front(evaluated: EvaluatedPlans, references: Sequence[NDArray[Any]]) -> EvaluatedPlans:
    """The plans of a front.

    For each of CRITERIA, from the last to the first: the best plan of each objective, then those that add most
    hypervolume. Only plans that dominate the reference points of all CRITERIA are selected.

    Args:
        evaluated: n plans.
        references: a reference point (d,) for each of CRITERIA.

    Returns:
        The selected plans, the greatest discounted return of the first objective first.
    """
    pairs = zip(evaluated.returns, references, strict=True)
    dominating = [(returns >= reference).all(axis=1) for returns, reference in pairs]
    evaluated = evaluated.take(np.flatnonzero(np.all(dominating, axis=0)))
    rows: set[int] = set()
    for returns, reference, size in zip(evaluated.returns[::-1], references[::-1], FRONT_SIZES[::-1], strict=True):
        front = np.flatnonzero(moocore.is_nondominated(returns, maximise=True))
        rows |= set(front[returns[front].argmax(axis=0)].tolist())
        for row in front[greedy_hypervolume_subset(returns[front], reference, size)].tolist():
            if len(rows) < size:
                rows.add(row)
    selected = evaluated.take(np.array(sorted(rows)))
    return selected.take(np.lexsort(selected.returns[0].T[::-1])[::-1])
