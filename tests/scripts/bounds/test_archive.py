"""The archive's epsilon-dominance, compared with a plain loop over boxes."""

from __future__ import annotations

import numpy as np

from mo_deepdrive.world.objectives import scales
from scripts.bounds.archive import EPSILON, epsilon_nondominated
from scripts.bounds.plans import CRITERIA, EvaluatedPlans

OBJECTIVES = [criterion.objectives("one_waypoint") for criterion in CRITERIA]


def kept_by_a_loop(returns: np.ndarray, lengths: np.ndarray, names: tuple[str, ...]) -> set[int]:
    scaled = returns / scales(names)
    best: dict[tuple[float, ...], int] = {}
    for row, box in enumerate(map(tuple, np.floor(scaled / EPSILON).tolist())):
        if box not in best or (scaled[row].sum(), -lengths[row]) > (scaled[best[box]].sum(), -lengths[best[box]]):
            best[box] = row
    return {
        row
        for box, row in best.items()
        if not any(other != box and all(a >= b for a, b in zip(other, box, strict=True)) for other in best)
    }


def test_one_plan_of_every_nondominated_box_is_kept() -> None:
    rng = np.random.default_rng(0)
    n = 400
    # On a coarse scale, so that many returns are in one box.
    returns = tuple(rng.normal(0.0, 2.0 * EPSILON, (n, len(names))) * scales(names) for names in OBJECTIVES)
    lengths = rng.integers(1, 600, n)
    evaluated = EvaluatedPlans(np.zeros((n, 1, 1), dtype=np.int16), lengths, returns, np.zeros(n, dtype=np.int64))
    rows = epsilon_nondominated(evaluated, OBJECTIVES)
    kept = [kept_by_a_loop(each, lengths, names) for each, names in zip(returns, OBJECTIVES, strict=True)]
    assert set(rows.tolist()) == set().union(*kept)
    assert (np.diff(rows) > 0).all()


def test_of_equal_returns_the_shortest_episode_is_kept() -> None:
    returns = tuple(np.zeros((3, len(names))) for names in OBJECTIVES)
    plans = np.zeros((3, 1, 1), dtype=np.int16)
    evaluated = EvaluatedPlans(plans, np.array([7, 5, 6]), returns, np.zeros(3, np.int64))
    assert epsilon_nondominated(evaluated, OBJECTIVES).tolist() == [1]
