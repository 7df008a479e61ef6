"""Actors that are conditioned on preferences, as a compiled callback of a rollout.

The twin of :meth:`algorithms.rollouts.preferences.Preferences.features`, with the same numbers, bit for bit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from algorithms.rollouts.compiled_policy import Policies, act
from algorithms.rollouts.preferences import CHEBYSHEV, COMFORT_BUDGET, FURTHEST
from mo_deepdrive.evaluation.accrued_reward import SMALLEST_DISCOUNT
from mo_deepdrive.simulation.jit import separate_jit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from algorithms.rollouts.preferences import Drawn, Preferences

    Array = NDArray[np.float32]

ALWAYS, NEVER = -1, -2  # in place of a family's indicator, where it is the only one or not used


class Conditioned(NamedTuple):
    """What acts, and under which preferences; their numbers are explained in ``Preferences``.

    Attributes:
        policies: of all vehicles.
        candidates: (T, N, V, m) preferences that begin where an episode does, or where they change.
        changes: (T, N, V) whether the preference changes in any case.
        followed: (T, N, V, m) under which the vehicles act, written.
        current: (N, V, m) of the running episodes, changed.
        factors, divisors: (m,) by which the components are multiplied and divided.
        first: of the weights, and of the budgets.
        indicators: of the Chebyshev and comfort-budget families.
        ideal, scales: (d,) z and s.
        budgeted: (b,) objectives.
        largest: (b,) budgets.
    """

    policies: Policies
    candidates: Array
    changes: NDArray[np.bool_]
    followed: Array
    current: Array
    factors: Array
    divisors: Array
    first: tuple[int, int]
    indicators: tuple[int, int]
    ideal: Array
    scales: Array
    budgeted: NDArray[np.int64]
    largest: Array


def conditioned(policies: Policies, preferences: Preferences, current: Array, drawn: Drawn) -> Conditioned:
    """What :func:`act_under_preferences` takes."""

    def indicator(family: int) -> int:
        if family not in preferences.used:
            return NEVER
        return preferences.used.index(family) if len(preferences.used) > 1 else ALWAYS

    return Conditioned(
        policies,
        *drawn,
        current=current,
        factors=preferences.factors.numpy(),
        divisors=preferences.divisors.numpy(),
        first=(preferences.weight_columns.start, preferences.budget_columns.start),
        indicators=(indicator(CHEBYSHEV), indicator(COMFORT_BUDGET)),
        ideal=preferences.ideal.numpy(),
        scales=preferences.scales.numpy(),
        budgeted=np.array(preferences.budgeted, dtype=np.int64),
        largest=preferences.largest.numpy(),
    )


@separate_jit
def _write_features(preference: Array, accrued: Array, discount: np.float32, shared: Any, features: Array) -> None:
    """The ``features`` (width,) of a ``preference`` (m,) after an ``accrued`` reward (d,)."""
    factors, divisors, first, indicators, ideal, scales, budgeted, largest = shared
    m, left = len(preference), max(discount, np.float32(SMALLEST_DISCOUNT))
    furthest, at = np.float32(FURTHEST), m
    for k in range(m):
        features[k] = preference[k] * factors[k] / divisors[k]
    if indicators[0] != NEVER:
        follows = indicators[0] == ALWAYS or preference[indicators[0]] > 0.5
        most = np.float32(-np.inf)
        for k in range(len(scales)):
            features[at + k] = preference[first[0] + k] * (ideal[k] - accrued[k]) / scales[k]
            most = max(most, features[at + k])
        for k in range(len(scales)):
            behind = max((features[at + k] - most) / left, -furthest)
            features[at + k] = behind if follows else np.float32(0.0)
        at += len(scales)
    if indicators[1] != NEVER:
        follows = indicators[1] == ALWAYS or preference[indicators[1]] > 0.5
        for k in range(len(budgeted)):
            unspent = (accrued[budgeted[k]] + preference[first[1] + k]) / left / largest[k]
            features[at + k] = min(max(unspent, -furthest), furthest) if follows else np.float32(0.0)


@separate_jit
def act_under_preferences(
    t: int,
    first: int,
    last: int,
    conditioned: Conditioned,
    observations: Array,
    accrued: Array,
    discounts: Array,
    decisions: NDArray[np.int64],
    actions: Any,
) -> None:
    """As :func:`algorithms.rollouts.compiled_policy.act`, with preferences among what the networks see."""
    policies, candidates, changes, followed, current = conditioned[:5]
    worlds, o, vehicles = actions.shape[1], len(policies.observation_scales), policies.vehicles
    for g in range(len(policies.rows)):
        for j in range(vehicles.shape[1]):
            v = vehicles[g, j]
            for i in range(first, last):
                begins = decisions[i, v] == 0 or changes[t, i, v]
                for k in range(current.shape[2]):
                    if begins:
                        current[i, v, k] = candidates[t, i, v, k]
                    followed[t, i, v, k] = current[i, v, k]
                features = policies.rows[g][(t * worlds + i) * vehicles.shape[1] + j, o:]
                _write_features(current[i, v], accrued[t, i, v], discounts[t, i, v], conditioned[5:], features)
    act(t, first, last, policies, observations, accrued, discounts, decisions, actions)
