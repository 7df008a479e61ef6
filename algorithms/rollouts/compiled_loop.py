"""The loop of :mod:`algorithms.rollouts.collector`, compiled: policies, sampling, physics and resets in one call."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from algorithms.networks.compiled.distributions import categorical_sample, state_gaussian_sample
from algorithms.networks.compiled.perceptron import BLOCK, forward_rows
from algorithms.rollouts.collector import follow_episodes
from mo_deepdrive.actions import decode_continuous, decode_discrete, delay, find_infinite
from mo_deepdrive.batch import MAX_REDRAWS
from mo_deepdrive.envs.streams import BLOCK as DRAWS_IN_BLOCK
from mo_deepdrive.simulation.jit import separate_jit
from mo_deepdrive.simulation.state import ARRIVED

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from algorithms.rollouts.buffers import Buffers

    Array = NDArray[np.float32]
    Flags = NDArray[np.bool_]
    Records = NDArray[Any]

# Why the loop has stopped before the end of the rollout.
DONE, NEEDS_DRAWS, NO_VALID_SCENARIO, NOT_FINITE = range(4)


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
    """

    rows: tuple[Array, ...]
    weights: tuple[tuple[Array, ...], ...]
    biases: tuple[tuple[Array, ...], ...]
    hidden: tuple[tuple[Array, ...], ...]
    outputs: tuple[Array, ...]
    deviations: Array
    observation_scales: Array
    accrued_scales: Array


class Worlds(NamedTuple):
    """A part of the worlds: fields of :class:`mo_deepdrive.batch.Part` and of its batch, and the worlds' draws.

    Attributes:
        first: index of the part's first world.
        blocks, cursors: of :class:`mo_deepdrive.envs.streams.Streams`.
        attempts: (n,) invalid scenarios that have been drawn in a row.
        draws: (1, draws), scratch of a reset.
        columns, signs: of the measures.
    """

    first: int
    state: NDArray[Any]
    controls: NDArray[np.float64]
    motion: NDArray[Any]
    cars: NDArray[Any]
    path: NDArray[Any]
    sight: NDArray[Any]
    spawn: NDArray[Any]
    observations: Array
    rewards: Array
    terminated: Flags
    truncated: Flags
    params: NDArray[Any]
    pins: NDArray[Any]
    table: NDArray[np.float64]
    blocks: NDArray[np.float64]
    cursors: NDArray[np.int64]
    attempts: NDArray[np.int64]
    draws: NDArray[np.float64]
    columns: NDArray[np.int64]
    signs: NDArray[np.float64]


@separate_jit
def _replace_ended(
    state: Records, draws: NDArray[np.float64], pins: Records, params: Records, spawn: Records, sight: Records,
    observations: Array, terminated: Flags, truncated: Flags, blocks: NDArray[np.float64], cursors: NDArray[np.int64],
    attempts: NDArray[np.int64], reset: Callable[..., None],
) -> int:  # fmt: skip
    """Start new episodes in the worlds without a vehicle on the road, until one has no draws left."""
    row, fair = np.zeros(1, np.int64), np.zeros(1, np.bool_)
    for i in range(len(state)):
        over = True
        for v in range(state.shape[1]):
            over = over and (terminated[i, v] or truncated[i, v])
        while over:
            if attempts[i] == MAX_REDRAWS:
                return NO_VALID_SCENARIO
            if cursors[i] == DRAWS_IN_BLOCK:
                return NEEDS_DRAWS
            for k in range(draws.shape[1]):
                draws[0, k] = blocks[i, cursors[i], k]
            cursors[i] += 1
            row[0] = i
            reset(state, row, draws, pins, params, spawn, fair, sight, observations, terminated, truncated)
            over = not fair[0]
            attempts[i] = attempts[i] + 1 if over else 0
    return DONE


@separate_jit
def _write_inputs(
    v: int, observations: Array, accrued: Array, discounts: Array, scales: Array, accrued_scales: Array, rows: Array
) -> None:
    """What the actor of vehicle ``v`` sees: ``rows`` (n, inputs) from (n, V, o), (n, V, d) and (n, V).

    As :meth:`algorithms.actor_critic.Learner.inputs`; the accrued reward is seen if it has scales, and the discount if
    there is room for it.
    """
    o, d = len(scales), len(accrued_scales)
    for i in range(len(rows)):
        for k in range(o):
            rows[i, k] = observations[i, v, k] / scales[k]
        for k in range(d):
            rows[i, o + k] = accrued[i, v, k] / accrued_scales[k]
        if o + d < rows.shape[1]:
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
def _decode(actions: Any, state: Records, table: NDArray[np.float64], controls: NDArray[np.float64]) -> int:
    """Write the target controls of the actions."""
    late = len(state[0, 0].pending) > 0
    if actions.ndim == 2:
        arriving = actions
        if late:
            n, vehicles = actions.shape
            arriving = np.empty((n, vehicles), np.int64)
            delay(state, actions.reshape(n, vehicles, 1), arriving.reshape(n, vehicles, 1))
        decode_discrete(state, arriving, table, controls)
    else:
        exact = actions.astype(np.float64)
        if find_infinite(exact) >= 0:
            return NOT_FINITE
        decode_continuous(exact, controls)
        if late:
            delay(state, controls, controls)
    return DONE


@separate_jit
def _mark_acting(terminated: Flags, truncated: Flags, acted: Flags) -> None:
    """Write which vehicles (n, V) are on the road."""
    for i in range(len(acted)):
        for v in range(acted.shape[1]):
            acted[i, v] = not (terminated[i, v] or truncated[i, v])


@separate_jit
def _measure(
    measures: Any, state: Records, params: Records, acted: Flags, columns: Any, signs: Any, rewards: Array
) -> None:
    """Write the columns of the rewards that the kernel does not write."""
    if len(measures) > 0:
        for k in range(len(measures)):
            write = measures[k]
            write(state, params, acted, columns[k], signs[k], rewards)


@separate_jit
def _copy(source: NDArray[Any], target: NDArray[Any]) -> None:
    """Copy an array into another of its shape; an assignment takes much longer to compile."""
    read, written = source.reshape(-1), target.reshape(-1)
    for i in range(len(read)):
        written[i] = read[i]


@separate_jit
def _note(
    state: Records, rewards: Array, shares: Array, over: tuple[Flags, Flags], acted: Flags,
    learnt: Array, flags: tuple[Flags, Flags, Flags], ended: Flags, succeeded: Flags,
) -> None:  # fmt: skip
    """Write a step of the rollout: rewards multiplied by shares, flags, and the ends of episodes.

    Args:
        state: (n, V) of VEHICLE, after the step.
        rewards: (n, V, d).
        shares: (V, d).
        over: (n, V) terminated and truncated, which stay True until the world is reset.
        acted: (n, V).
        learnt: (n, V, d), written.
        flags: (n, V) terminated and truncated, in the step of the end alone, and acted; written.
        ended: (n, V), written.
        succeeded: (n, V), written.
    """
    for i in range(rewards.shape[0]):
        for v in range(rewards.shape[1]):
            for k in range(rewards.shape[2]):
                learnt[i, v, k] = rewards[i, v, k] * shares[v, k]
            terminated, truncated = over[0][i, v] and acted[i, v], over[1][i, v] and acted[i, v]
            flags[0][i, v], flags[1][i, v], flags[2][i, v] = terminated, truncated, acted[i, v]
            ended[i, v] = terminated or truncated
            succeeded[i, v] = ended[i, v] and state[i, v].end == ARRIVED


@separate_jit
def collect_part(
    start: int,
    worlds: Worlds,
    policies: Policies,
    noise: Array,
    actions: Any,
    buffers: Buffers,
    step: Callable[..., None],
    reset: Callable[..., None],
    measures: Any,
) -> tuple[int, int]:
    """Collect the steps from ``start`` on in a part of the worlds.

    Args:
        start: the first step that has not been taken.
        worlds: the part.
        policies: of all vehicles.
        noise: (T, V, N, k) random numbers for the actions.
        actions: (T, N, V) or (T, N, V, k), written.
        buffers: the rest of the rollout, written.
        step: ``step_batch`` of the kernel.
        reset: its ``reset_batch``.
        measures: what measures further objectives.

    Returns:
        The step that has not been taken, and why; (T, DONE) at the end.
    """
    (first, state, controls, motion, cars, path, sight, spawn, observations, rewards, terminated, truncated,
     params, pins, table, blocks, cursors, attempts, draws, columns, signs) = worlds  # fmt: skip
    (all_observations, final, all_rewards, accrued, discounts, flags, ended, succeeded, ended_returns, ended_values,
     ended_decisions, value, running_discounts, decisions, returns, accrued_discounts, shares) = buffers  # fmt: skip
    rows, weights, biases, hidden, outputs, deviations, scales, accrued_scales = policies
    steps, count = actions.shape[:2]
    part, acted = slice(first, first + len(state)), np.empty(terminated.shape, np.bool_)
    for t in range(start, steps + 1):
        problem = _replace_ended(
            state,
            draws,
            pins,
            params,
            spawn,
            sight,
            observations,
            terminated,
            truncated,
            blocks,
            cursors,
            attempts,
            reset,
        )
        if problem != DONE:
            return t, problem
        _copy(observations, all_observations[t, part])
        _copy(value[part], accrued[t, part])
        _copy(running_discounts[part], discounts[t, part])
        if t == steps:
            break
        at, end = t * count + first, t * count + first + len(state)
        for v in range(state.shape[1]):
            seen = rows[v][at:end]
            _write_inputs(v, observations, accrued[t, part], discounts[t, part], scales, accrued_scales, seen)
            _run_network(at, end, rows[v], weights[v], biases[v], hidden[v], outputs[v])
            _choose(outputs[v], at, noise[t, v, part], deviations, v, actions[t, part])
        problem = _decode(actions[t, part], state, table, controls)
        if problem != DONE:
            return t, problem
        _mark_acting(terminated, truncated, acted)
        step(state, controls, params, motion, cars, path, sight, observations, rewards, terminated, truncated)
        _measure(measures, state, params, acted, columns, signs, rewards)
        _copy(observations, final[t, part])
        marks = flags[0, t, part], flags[1, t, part], flags[2, t, part]
        learnt = all_rewards[t, part]
        _note(state, rewards, shares, (terminated, truncated), acted, learnt, marks, ended[t, part], succeeded[t, part])
        follow_episodes(
            rewards,
            learnt,
            ended[t, part],
            acted,
            accrued_discounts,
            value[part],
            running_discounts[part],
            decisions[part],
            returns[part],
            ended_returns[t, part],
            ended_values[t, part],
            ended_decisions[t, part],
        )
    return steps, DONE
