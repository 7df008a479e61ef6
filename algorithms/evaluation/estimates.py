"""Every metric of an evaluation with its 95% interval over the episodes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from algorithms.evaluation.metrics import (
    ARRIVED,
    COLLISION,
    COMFORT,
    DISCOUNTED_UTILITY_ESR,
    DISCOUNTED_UTILITY_SER,
    LENGTH,
    OUR_ENDS,
    SUCCESS,
    USUAL_FAILURES,
    UTILITY_ESR,
    UTILITY_SER,
    WORST_OFF_UTILITY_ESR,
    discounted_return_of,
    end_by,
    maximum_of,
    mean_of,
    return_of,
    vehicle_prefix,
)
from algorithms.evaluation.statistics import Estimate, mean, rate, utility_of_mean

if TYPE_CHECKING:
    from algorithms.evaluation.episodes import Evaluation


def estimate_metrics(evaluation: Evaluation) -> dict[str, Estimate]:
    """Every metric of an evaluation with its interval; with several vehicles prefixed by ``vehicle_0/`` and so on.

    With several vehicles ``success`` is the share of episodes in which all arrived, ``end/collision`` of those in which
    any collided.

    Means and utilities have bootstrap intervals over episodes, rates have Wilson's; the largest magnitudes in one
    decision have none.
    """
    estimates: dict[str, Estimate] = {}
    vehicles = evaluation.returns.shape[1]
    if vehicles > 1:
        estimates[SUCCESS] = rate(np.asarray(evaluation.succeeded.all(axis=1)))
        estimates[end_by(COLLISION)] = rate(np.array([COLLISION in ends for ends in evaluation.ends.tolist()]))
        if evaluation.utilities:
            estimates[WORST_OFF_UTILITY_ESR] = mean(evaluation.worst_off_utilities())
    for v in range(vehicles):
        prefix = vehicle_prefix(v, vehicles)
        estimates |= {prefix + name: value for name, value in _estimate_vehicle(evaluation, v).items()}
    return estimates


def _estimate_vehicle(evaluation: Evaluation, v: int) -> dict[str, Estimate]:
    returns, discounted = evaluation.returns[:, v], evaluation.discounted[:, v]
    lengths, ends = evaluation.lengths[:, v], evaluation.ends[:, v]
    estimates: dict[str, Estimate] = {}
    if evaluation.utilities:
        utility = evaluation.utilities[v]
        estimates = {
            UTILITY_ESR: mean(np.asarray(utility(returns))),
            UTILITY_SER: utility_of_mean(returns, utility),
            DISCOUNTED_UTILITY_ESR: mean(np.asarray(utility(discounted))),
            DISCOUNTED_UTILITY_SER: utility_of_mean(discounted, utility),
        }
    known = {str(end) for end in ends if end is not None}
    if known or evaluation.succeeded[:, v].any():
        estimates[SUCCESS] = rate(evaluation.succeeded[:, v])
    if known:
        usual = USUAL_FAILURES if known <= OUR_ENDS else ()
        reasons = (*usual, *sorted(known - {ARRIVED, *usual}))
        estimates |= {end_by(reason): rate(np.array([str(end) == reason for end in ends])) for reason in reasons}
    estimates[LENGTH] = mean(lengths.astype(np.float64))
    for i, objective in enumerate(evaluation.objectives):
        estimates[return_of(objective)] = mean(returns[:, i])
        estimates[discounted_return_of(objective)] = mean(discounted[:, i])
    for i, objective in enumerate(evaluation.objectives):
        if objective in COMFORT:
            estimates[mean_of(objective)] = mean(np.abs(returns[:, i]) / np.maximum(lengths, 1))
            estimates[maximum_of(objective)] = Estimate(float(evaluation.largest[:, v, i].max()))
    return estimates
