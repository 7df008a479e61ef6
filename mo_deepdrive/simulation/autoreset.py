"""New episodes: a scenario is drawn until it is fair and placed, at once or when the autoreset mode says so."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

from mo_deepdrive.simulation.jit import jit
from mo_deepdrive.simulation.kernel import observe_worlds
from mo_deepdrive.simulation.placing import draw_spawn, place, spawn_is_fair

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mo_deepdrive.simulation.state import Records

MAX_REDRAWS = 1000

# What comes of a reset.
DONE, NEEDS_DRAWS, NO_VALID_SCENARIO = range(3)

# When a world is reset: by the step after the one in which its episode ends, by that step, or by the caller alone.
NEXT_STEP, SAME_STEP, DISABLED = range(3)


@jit
def draw_from_blocks(
    blocks: NDArray[np.float64], cursors: NDArray[np.int64], i: int, drawn: NDArray[np.float64]
) -> bool:
    """Copy the next uniforms of world ``i`` to ``drawn`` (1, draws), if there are any left.

    Args:
        blocks: (worlds, B, draws) uniforms in [0, 1).
        cursors: (worlds,) how many rows of its block each world has used.
        i: which world.
        drawn: written.
    """
    if cursors[i] == blocks.shape[1]:
        return False
    for k in range(drawn.shape[1]):
        drawn[0, k] = blocks[i, cursors[i], k]
    cursors[i] += 1
    return True


@jit
def is_due(
    i: int, mode: int, waiting: NDArray[np.bool_], terminated: NDArray[np.bool_], truncated: NDArray[np.bool_]
) -> bool:
    """Whether world ``i`` is to be reset now, after a decision.

    Args:
        i: which world.
        mode: NEXT_STEP, SAME_STEP or DISABLED.
        waiting: (worlds,) whether the episode is over and its world has not been reset; read and written.
        terminated: (worlds, vehicles) of the decision.
        truncated: likewise.
    """
    over = True
    for v in range(terminated.shape[1]):
        over = over and (terminated[i, v] or truncated[i, v])
    due = mode != DISABLED and (waiting[i] if mode == NEXT_STEP else over)
    waiting[i] = over or due
    return due


@functools.cache
def resetting(draw: Any) -> Any:
    """The function that resets a world.

    Args:
        draw: compiled; ``draw(source, cursors, i, drawn)`` writes uniforms for a scenario of world ``i``, and returns
            False if there are none: :func:`draw_from_blocks`, or a generator that counts.

    Returns:
        ``reset(worlds, i, waiting, ..., truncated)``, compiled; it returns DONE, NEEDS_DRAWS (and can then be called
        again) or NO_VALID_SCENARIO.
    """

    @jit
    def reset(
        worlds: Records,
        i: int,
        waiting: NDArray[np.bool_],
        source: Any,
        cursors: NDArray[np.int64],
        attempts: NDArray[np.int64],
        drawn: NDArray[np.float64],
        pins: Records,
        params: Records,
        spawn: Records,
        sight: Records,
        observations: NDArray[np.float32],
        terminated: NDArray[np.bool_],
        truncated: NDArray[np.bool_],
    ) -> int:
        """Start a new episode in world ``i``.

        Args:
            worlds: (worlds, vehicles) of VEHICLE, changed in place.
            i: which world.
            waiting: as of :func:`is_due`, written.
            source: what ``draw`` draws from; so is cursors.
            cursors: (worlds,).
            attempts: (worlds,) draws in a row that were not fair, zero at first.
            drawn: (1, draws), scratch.
            pins: (1,) of SPAWN; entries that are not NaN replace what would be drawn.
            params: (1,) of PARAMS.
            spawn: (1,) of SPAWN, scratch.
            sight: (1,) of SIGHT, scratch.
            observations: (worlds, vehicles, size), written.
            terminated: (worlds, vehicles), written.
            truncated: likewise.
        """
        while attempts[i] < MAX_REDRAWS:
            if not draw(source, cursors, i, drawn):
                return NEEDS_DRAWS
            draw_spawn(drawn, 0, params[0], pins[0], spawn[0])
            if spawn_is_fair(spawn[0], params[0]):
                place(worlds, i, spawn[0], params[0])
                observe_worlds(worlds, i, i + 1, params[0], sight, observations, terminated, truncated)
                attempts[i] = 0
                waiting[i] = False
                return DONE
            attempts[i] += 1
        attempts[i] = 0
        return NO_VALID_SCENARIO

    return reset


_reset = resetting(draw_from_blocks)


@jit
def reset_batch(
    start: int,
    worlds: Records,
    mode: int,
    waiting: NDArray[np.bool_],
    blocks: NDArray[np.float64],
    cursors: NDArray[np.int64],
    attempts: NDArray[np.int64],
    drawn: NDArray[np.float64],
    pins: Records,
    params: Records,
    spawn: Records,
    sight: Records,
    observations: NDArray[np.float32],
    terminated: NDArray[np.bool_],
    truncated: NDArray[np.bool_],
) -> tuple[int, int]:
    """Reset the worlds from ``start`` on that are due; see :func:`is_due` and :func:`resetting` for the arguments.

    Returns:
        The world that has not been reset, and why; (worlds, DONE) at the end.
    """
    for i in range(start, worlds.shape[0]):
        if is_due(i, mode, waiting, terminated, truncated):
            problem = _reset(
                worlds, i, waiting, blocks, cursors, attempts, drawn, pins, params, spawn, sight, observations,
                terminated, truncated,
            )  # fmt: skip
            if problem != DONE:
                return i, problem
    return worlds.shape[0], DONE
