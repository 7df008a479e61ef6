"""A rollout: T decisions of all worlds of a batch in one compiled call, with a policy as a callback.

Worlds are reset in the step in which their episode ends, and the returns of episodes are kept. Several threads share
the worlds.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any, NamedTuple

import numba
import numpy as np

from mo_deepdrive.simulation.actions import find_infinite
from mo_deepdrive.simulation.autoreset import DONE, NEEDS_DRAWS, NO_VALID_SCENARIO, SAME_STEP, reset_batch
from mo_deepdrive.simulation.jit import Pointer, jit, separate_jit
from mo_deepdrive.simulation.state import ARRIVED
from mo_deepdrive.thread_pool import ThreadPool

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from mo_deepdrive.batch import Draws, Part, WorldBatch

    Array = NDArray[np.float32]
    Flags = NDArray[np.bool_]
    Records = NDArray[Any]
    Loop = Callable[..., tuple[int, int]]

NOT_FINITE = 1 + NO_VALID_SCENARIO  # beside what comes of a reset


class Buffers(NamedTuple):
    """What a rollout writes: itself, the episodes that end, and those that go on.

    Attributes:
        observations: (T + 1, N, V, o) before each decision, and after the last.
        final: (T, N, V, o) after each decision; where an episode ended, the last of that episode.
        rewards: (T, N, V, d), multiplied by ``shares``.
        accrued: (T + 1, N, V, d) accrued reward R_t = sum_{i<t} g^i r_i of the running episode.
        discounts: (T + 1, N, V) g^t of the running episode.
        flags: (3, T, N, V) terminated, truncated and acted.
        ended, succeeded: (T, N, V) whether a vehicle's episode ended, and whether it then reached its goal.
        ended_returns, ended_values: (T, N, V, d) undiscounted and accrued return of an episode, where one ended.
        ended_decisions: (T, N, V) its decisions.
        value, running_discounts, decisions: of the AccruedReward of the running episodes.
        returns: (N, V, d) their undiscounted returns.
        accrued_discounts: (V,) g.
        shares: (V, d) by which rewards are multiplied.
    """

    observations: NDArray[np.float32]
    final: NDArray[np.float32]
    rewards: NDArray[np.float32]
    accrued: NDArray[np.float32]
    discounts: NDArray[np.float32]
    flags: NDArray[np.bool_]
    ended: NDArray[np.bool_]
    succeeded: NDArray[np.bool_]
    ended_returns: NDArray[np.float64]
    ended_values: NDArray[np.float64]
    ended_decisions: NDArray[np.int64]
    value: NDArray[np.float32]
    running_discounts: NDArray[np.float32]
    decisions: NDArray[np.int64]
    returns: NDArray[np.float64]
    accrued_discounts: NDArray[np.float32]
    shares: NDArray[np.float32]


class Worlds(NamedTuple):
    """A part of the worlds of a batch.

    Attributes:
        first: index of the part's first world.
        state, ..., truncated: see :func:`mo_deepdrive.simulation.kernel.deciding`.
        waiting, ..., spawn: see :func:`mo_deepdrive.simulation.autoreset.resetting`.
    """

    first: int
    state: NDArray[Any]
    table: NDArray[np.float64]
    params: NDArray[Any]
    controls: NDArray[np.float64]
    motion: NDArray[Any]
    cars: NDArray[Any]
    path: NDArray[Any]
    sight: NDArray[Any]
    observations: Array
    rewards: Array
    acted: Flags
    terminated: Flags
    truncated: Flags
    waiting: Flags
    blocks: NDArray[np.float64]
    cursors: NDArray[np.int64]
    attempts: NDArray[np.int64]
    drawn: NDArray[np.float64]
    pins: NDArray[Any]
    spawn: NDArray[Any]


@jit
def follow_episodes(
    rewards: NDArray[np.float32],
    learnt: NDArray[np.float32],
    ended: NDArray[np.bool_],
    acted: NDArray[np.bool_],
    accrued_discounts: NDArray[np.float32],
    value: NDArray[np.float32],
    discounts: NDArray[np.float32],
    decisions: NDArray[np.int64],
    returns: NDArray[np.float64],
    ended_returns: NDArray[np.float64],
    ended_values: NDArray[np.float64],
    ended_decisions: NDArray[np.int64],
) -> None:
    """Add a step to the running episodes; note those that ended, and begin new ones.

    Args:
        rewards: (N, V, d) of the environment.
        learnt: (N, V, d) of which the accrued reward consists.
        ended: (N, V) whether the vehicle's episode ended in this step.
        acted: (N, V); who did not act has no episode under way.
        accrued_discounts: (V,) g.
        value: (N, V, d) of AccruedReward, changed.
        discounts: (N, V) of AccruedReward, changed.
        decisions: (N, V) of AccruedReward, changed.
        returns: (N, V, d) undiscounted, changed.
        ended_returns: (N, V, d) of the episodes that ended, written where ``ended``; so are the others.
        ended_values: (N, V, d) their accrued rewards.
        ended_decisions: (N, V).
    """
    n, v, d = rewards.shape
    for i in range(n):
        for j in range(v):
            for k in range(d):
                value[i, j, k] += discounts[i, j] * learnt[i, j, k]
                returns[i, j, k] += rewards[i, j, k]
            discounts[i, j] *= accrued_discounts[j]
            decisions[i, j] += 1
            if ended[i, j]:
                for k in range(d):
                    ended_returns[i, j, k] = returns[i, j, k]
                    ended_values[i, j, k] = value[i, j, k]
                ended_decisions[i, j] = decisions[i, j]
            if ended[i, j] or not acted[i, j]:
                for k in range(d):
                    value[i, j, k] = 0.0
                    returns[i, j, k] = 0.0
                discounts[i, j] = 1.0
                decisions[i, j] = 0


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
def roll_out(
    start: int,
    worlds: Worlds,
    actions: Any,
    buffers: Buffers,
    policy: Any,
    act: Callable[..., None],
    step: Callable[..., None],
    reset: Callable[..., tuple[int, int]],
) -> tuple[int, int]:
    """Take the decisions from ``start`` on in a part of the worlds.

    Args:
        start: the first decision that has not been taken.
        worlds: the part.
        actions: (T, N, V) or (T, N, V, k), written.
        buffers: the rest of the rollout, written.
        policy: for ``act``.
        act: see :class:`WorldRollout`.
        step: of :func:`mo_deepdrive.simulation.kernel.batch_step`.
        reset: :func:`mo_deepdrive.simulation.autoreset.reset_batch`.

    Returns:
        The decision that has not been taken, and why; (T, DONE) at the end.
    """
    (first, state, table, params, controls, motion, cars, path, sight, observations, rewards, acted, terminated,
     truncated, waiting, blocks, cursors, attempts, drawn, pins, spawn) = worlds  # fmt: skip
    (all_observations, final, all_rewards, accrued, discounts, flags, ended, succeeded, ended_returns, ended_values,
     ended_decisions, value, running_discounts, decisions, returns, accrued_discounts, shares) = buffers  # fmt: skip
    steps, last = len(actions), first + len(state)
    part = slice(first, last)
    for t in range(start, steps + 1):
        _, problem = reset(
            0, state, SAME_STEP, waiting, blocks, cursors, attempts, drawn, pins, params, spawn, sight,
            observations, terminated, truncated,
        )  # fmt: skip
        if problem != DONE:
            return t, problem
        _copy(observations, all_observations[t, part])
        _copy(value[part], accrued[t, part])
        _copy(running_discounts[part], discounts[t, part])
        if t == steps:
            break
        act(t, first, last, policy, all_observations, accrued, discounts, decisions, actions)
        chosen = actions[t, part]
        if actions.ndim == 4:  # noqa: SIM102  (where it is not, Numba omits what follows)
            if find_infinite(chosen) >= 0:
                return t, NOT_FINITE
        step(
            state, chosen, table, params, controls, motion, cars, path, sight, observations, rewards, acted,
            terminated, truncated,
        )  # fmt: skip
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


class WorldRollout:
    """Rollouts of the worlds of a batch.

    Args:
        batch: the worlds; they have been placed.
        draws: random numbers of new episodes.
        actions: (T, N, V) integers, or (T, N, V, k) numbers in [-1, 1] (clipped).
        buffers: the rest of a rollout.
        act: the policy, compiled: ``act(t, first, last, policy, observations, accrued, discounts, decisions, actions)``
            writes ``actions[t, first:last]`` from ``observations[t, first:last]`` and so on, all of them those of
            ``buffers``. ``policy`` is what :meth:`run` is given.
        parts: how many threads share the worlds.
    """

    def __init__(
        self, batch: WorldBatch, draws: Draws, actions: NDArray[Any], buffers: Buffers, act: Any, parts: int = 1
    ):
        self._batch = batch
        self._draws = draws
        self._shared = actions, buffers
        self._act = act
        self.parts = [_worlds(part, batch, draws) for part in batch.parts(min(parts, len(batch.state)))]
        self._threads = ThreadPool()
        self._loop: Loop | None = None
        self._pointers: tuple[Pointer, ...] = ()

    def run(self, policy: Any, not_finite: Callable[[int], None]) -> None:
        """Take T decisions in every world, and write the buffers.

        Args:
            policy: what ``act`` is given: of the same type in every call.
            not_finite: called with the number of a decision in which actions are not finite; it raises an error.

        Raises:
            ValueError: if no valid scenario is found.
        """
        if self._loop is None:
            self._pointers, self._loop = self._compiled(policy)
        self._threads.run(lambda worlds: self._run(worlds, policy, not_finite), self.parts)

    def _run(self, worlds: Worlds, policy: Any, not_finite: Callable[[int], None]) -> None:
        assert self._loop is not None
        start, problem = self._loop(0, worlds, *self._shared, policy, *self._pointers)
        while problem != DONE:
            if problem == NEEDS_DRAWS:
                over = (worlds.terminated | worlds.truncated).all(axis=1)
                self._draws.refill(worlds.first + np.flatnonzero(over))
            elif problem == NO_VALID_SCENARIO:
                raise self._batch.no_scenario()
            else:
                not_finite(start)
            start, problem = self._loop(start, worlds, *self._shared, policy, *self._pointers)

    def _compiled(self, policy: Any) -> tuple[tuple[Pointer, ...], Loop]:
        """The functions that :func:`roll_out` calls, and itself for arguments like these."""
        (actions, buffers), worlds = self._shared, self.parts[0]
        step = (worlds.state, actions[0], *worlds[2:14])
        reset = (
            0, worlds.state, SAME_STEP, *worlds[14:20], worlds.params, worlds.spawn, worlds.sight,
            worlds.observations, worlds.terminated, worlds.truncated,
        )  # fmt: skip
        act = (0, 0, 0, policy, buffers.observations, buffers.accrued, buffers.discounts, buffers.decisions, actions)
        pointers = Pointer(self._act, act), Pointer(self._batch.step_function, step), Pointer(reset_batch, reset)
        types = map(numba.typeof, (0, worlds, *self._shared, policy))
        signature = *types, *(pointer.type for pointer in pointers)
        loop: Any = roll_out
        if signature not in loop.overloads:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", numba.NumbaExperimentalFeatureWarning)  # pointers to functions
                loop.compile(signature)
        return pointers, loop.get_overload(signature)


def _worlds(part: Part, batch: WorldBatch, draws: Draws) -> Worlds:
    count = len(part.worlds)
    return Worlds(
        first=part.rows.start,
        state=part.worlds,
        table=batch.table,
        params=batch.params,
        controls=part.controls,
        motion=part.motion,
        cars=part.cars,
        path=part.path,
        sight=part.sight,
        observations=part.observations,
        rewards=part.rewards,
        acted=part.acted,
        terminated=part.terminated,
        truncated=part.truncated,
        waiting=np.zeros(count, dtype=np.bool_),
        blocks=draws.blocks[part.rows],
        cursors=draws.cursors[part.rows],
        attempts=np.zeros(count, dtype=np.int64),
        drawn=np.zeros((1, draws.blocks.shape[2])),
        pins=batch.no_pins,
        spawn=part.spawn,
    )
