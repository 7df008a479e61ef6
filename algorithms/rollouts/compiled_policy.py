"""The actors of all vehicles, as a compiled callback of a rollout: what they see, their networks, and sampling."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from algorithms.networks.compiled.distributions import categorical_sample, state_gaussian_sample
from algorithms.networks.compiled.perceptron import BLOCK, forward_rows
from mo_deepdrive.simulation.jit import separate_jit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float32]


class Policies(NamedTuple):
    """What acts: G networks of k vehicles each; one entry per network where there is a tuple.

    Learning uses the memory again.

    Attributes:
        rows: (T * N * k, inputs) what the networks see, written.
        weights, biases: of the layers.
        hidden: (T * N * k, width) per hidden layer, written.
        outputs: (outputs, T * N * k) written.
        deviations: (G, a) standard deviations of continuous actions, (G, 0) if they depend on the state.
        observation_scales: (o,).
        accrued_scales: (d,) of the accrued reward, or none if it is not observed.
        noise: (T, G, N * k, a) random numbers for the actions.
        vehicles: (G, k) that the networks drive.
    """

    rows: tuple[Array, ...]
    weights: tuple[tuple[Array, ...], ...]
    biases: tuple[tuple[Array, ...], ...]
    hidden: tuple[tuple[Array, ...], ...]
    outputs: tuple[Array, ...]
    deviations: Array
    observation_scales: Array
    accrued_scales: Array
    noise: Array
    vehicles: NDArray[np.int64]


@separate_jit
def _write_inputs(
    vehicles: NDArray[np.int64],
    observations: Array,
    accrued: Array,
    discounts: Array,
    scales: Array,
    accrued_scales: Array,
    rows: Array,
) -> None:
    """What the actor of k vehicles sees: ``rows`` (n * k, inputs) from (n, V, o), (n, V, d) and (n, V).

    As :meth:`algorithms.actor_critic.Learner.inputs`; the accrued reward is seen if it has scales, and the discount if
    there is room for it alone. What is behind more room has been written already.
    """
    o, d = len(scales), len(accrued_scales)
    for row in range(len(rows)):
        i, v = row // len(vehicles), vehicles[row % len(vehicles)]
        for k in range(o):
            rows[row, k] = observations[i, v, k] / scales[k]
        for k in range(d):
            rows[row, o + k] = accrued[i, v, k] / accrued_scales[k]
        if o + d + 1 == rows.shape[1]:
            rows[row, o + d] = discounts[i, v]


@separate_jit
def _run_network(first: int, last: int, rows: Array, weights: Any, biases: Any, hidden: Any, outputs: Array) -> None:
    """:func:`forward_rows`, a block at a time."""
    for start in range(first, last, BLOCK):
        forward_rows(start, min(start + BLOCK, last), rows, weights, biases, hidden, outputs)


@separate_jit
def _choose(
    outputs: Array, at: int, noise: Array, deviations: Array, vehicles: NDArray[np.int64], actions: Any
) -> None:
    """Write the actions of k vehicles from the columns ``at`` on of their network's outputs.

    Args:
        outputs: (k, rows) logits, or means, with what standard deviations are made of if these depend on the state.
        at: the first column.
        noise: (n * k, a) random numbers.
        deviations: (a,) of a Gaussian policy, (0,) if they depend on the state.
        vehicles: (k,).
        actions: (n, V) of softmax policies, (n, V, a) of Gaussian ones, written.
    """
    if actions.ndim == 2:
        uniform, chosen = np.empty(len(noise), np.float32), np.empty(len(noise), np.int64)
        for row in range(len(noise)):
            uniform[row] = noise[row, 0]
        categorical_sample(outputs, at, uniform, chosen)
        for row in range(len(noise)):
            actions[row // len(vehicles), vehicles[row % len(vehicles)]] = chosen[row]
        return
    drawn = np.empty(noise.shape, np.float32)
    if len(deviations) == 0:
        state_gaussian_sample(outputs, at, noise, drawn)
    else:
        for row in range(len(noise)):
            for k in range(len(outputs)):
                drawn[row, k] = outputs[k, at + row] + deviations[k] * noise[row, k]
    for row in range(len(noise)):
        for k in range(noise.shape[1]):
            actions[row // len(vehicles), vehicles[row % len(vehicles)], k] = drawn[row, k]


@separate_jit
def act(
    t: int,
    first: int,
    last: int,
    policies: Policies,
    observations: Array,
    accrued: Array,
    discounts: Array,
    decisions: NDArray[np.int64],  # noqa: ARG001  (the signature of a callback)
    actions: Any,
) -> None:
    """Choose the actions of decision ``t`` in the worlds ``first`` to ``last`` - 1."""
    rows, weights, biases, hidden, outputs, deviations, scales, accrued_scales, noise, vehicles = policies
    k = vehicles.shape[1]
    begin, part = t * actions.shape[1] * k, slice(first, last)
    at, end = begin + first * k, begin + last * k
    for g in range(len(rows)):
        mine, seen = vehicles[g], rows[g][at:end]
        _write_inputs(mine, observations[t, part], accrued[t, part], discounts[t, part], scales, accrued_scales, seen)
        _run_network(at, end, rows[g], weights[g], biases[g], hidden[g], outputs[g])
        _choose(outputs[g], at, noise[t, g, first * k : last * k], deviations[g], mine, actions[t, part])
