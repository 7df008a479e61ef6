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
    """What acts; one entry per vehicle where there is a tuple, with memory that learning uses again.

    Attributes:
        rows: (T * N, inputs) what the networks see, written.
        weights, biases: of the layers.
        hidden: (T * N, width) per hidden layer, written.
        outputs: (outputs, T * N) written.
        deviations: (V, k) standard deviations of continuous actions, (V, 0) if they depend on the state.
        observation_scales: (o,).
        accrued_scales: (d,) of the accrued reward, or none if it is not observed.
        noise: (T, V, N, k) random numbers for the actions.
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


@separate_jit
def _write_inputs(
    v: int, observations: Array, accrued: Array, discounts: Array, scales: Array, accrued_scales: Array, rows: Array
) -> None:
    """What the actor of vehicle ``v`` sees: ``rows`` (n, inputs) from (n, V, o), (n, V, d) and (n, V).

    As :meth:`algorithms.actor_critic.Learner.inputs`; the accrued reward is seen if it has scales, and the discount if
    there is room for it alone. What is behind more room has been written already.
    """
    o, d = len(scales), len(accrued_scales)
    for i in range(len(rows)):
        for k in range(o):
            rows[i, k] = observations[i, v, k] / scales[k]
        for k in range(d):
            rows[i, o + k] = accrued[i, v, k] / accrued_scales[k]
        if o + d + 1 == rows.shape[1]:
            rows[i, o + d] = discounts[i, v]


@separate_jit
def _run_network(first: int, last: int, rows: Array, weights: Any, biases: Any, hidden: Any, outputs: Array) -> None:
    """:func:`forward_rows`, a block at a time."""
    for start in range(first, last, BLOCK):
        forward_rows(start, min(start + BLOCK, last), rows, weights, biases, hidden, outputs)


@separate_jit
def _choose(outputs: Array, at: int, noise: Array, deviations: Array, v: int, actions: Any) -> None:
    """Write the actions of vehicle ``v`` from the columns ``at`` on of its network's outputs.

    Args:
        outputs: (k, rows) logits, or means, with what standard deviations are made of if these depend on the state.
        at: the first column.
        noise: (n, k) random numbers.
        deviations: (V, k) of Gaussian policies, (V, 0) if they depend on the state.
        v: the vehicle.
        actions: (n, V) of softmax policies, (n, V, k) of Gaussian ones, written.
    """
    if actions.ndim == 2:
        uniform, chosen = np.empty(len(actions), np.float32), np.empty(len(actions), np.int64)
        for i in range(len(actions)):
            uniform[i] = noise[i, 0]
        categorical_sample(outputs, at, uniform, chosen)
        for i in range(len(actions)):
            actions[i, v] = chosen[i]
    elif deviations.shape[1] == 0:
        drawn = np.empty(noise.shape, np.float32)
        state_gaussian_sample(outputs, at, noise, drawn)
        for i in range(len(actions)):
            for k in range(noise.shape[1]):
                actions[i, v, k] = drawn[i, k]
    else:
        for i in range(len(actions)):
            for k in range(len(outputs)):
                actions[i, v, k] = outputs[k, at + i] + deviations[v, k] * noise[i, k]


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
    rows, weights, biases, hidden, outputs, deviations, scales, accrued_scales, noise = policies
    at, end = t * actions.shape[1] + first, t * actions.shape[1] + last
    part = slice(first, last)
    for v in range(actions.shape[2]):
        seen = rows[v][at:end]
        _write_inputs(v, observations[t, part], accrued[t, part], discounts[t, part], scales, accrued_scales, seen)
        _run_network(at, end, rows[v], weights[v], biases[v], hidden[v], outputs[v])
        _choose(outputs[v], at, noise[t, v, part], deviations, v, actions[t, part])
