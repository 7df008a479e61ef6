"""What a launch does with its worlds, for both kinds of device.

The functions of :mod:`mo_deepdrive.simulation` are compiled for a GPU as they are: one thread moves one world, with
scratch of one lane in its own memory. On the CPU loops call the same functions.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mo_deepdrive.simulation import observation, philox, traffic
from mo_deepdrive.simulation.autoreset import DONE, NEXT_STEP, SAME_STEP, is_due, resetting
from mo_deepdrive.simulation.dynamics import make_scratch
from mo_deepdrive.simulation.jit import jit, uncounted_jit
from mo_deepdrive.simulation.kernel import batch_step, observe_worlds
from mo_deepdrive.simulation.state import SPAWN, with_room

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

# What a launch cannot refuse, because nobody waits for it: 4 times the world plus one of these is left in ``fault``.
NO_FAULT, WRONG_ACTION, RESET_NEEDED, NO_SCENARIO = range(4)


class Buffers(NamedTuple):
    """The arrays of N worlds that a launch reads and writes, of NumPy or of a GPU.

    Attributes:
        worlds: (N, V) of VEHICLE.
        streams: (N,) of STREAM: whose random numbers, and the number of the next episode.
        waiting: (N,) whether the episode is over and the world has not been reset.
        redraws: (N,) int64, how often the scenario of the episode has been drawn.
        unfair: (N,) int64, how many of these draws in a row were not fair.
        mask: (N,) in which worlds a restart starts an episode.
        actions: (N, V) int64, or (N, V, 3) float32; those that are not allowed are replaced by zeros.
        table: (actions, 4) of the discrete actions.
        params: (1,) of PARAMS.
        pins: (1,) of SPAWN, which pins nothing.
        controls: (N, V, 3) scratch.
        ended: (N, V) whether a vehicle has ended before its time limit, as its world is now.
        timed_out: (N, V) likewise, by the time limit.
        observations: (N, V, size) float32 for the next decision.
        final_observations: (N, V, size) after the decision, before an autoreset in the same step.
        rewards: (N, V, d) float32.
        acted: (N, V) whether the vehicle was on the road before the decision.
        terminated: (N, V) of the decision; so is truncated.
        truncated: (N, V).
        over: (N,) whether no vehicle is on the road after the decision.
        ends: (N, V) int8, why vehicles have ended.
        fault: (1,) int64.
    """

    worlds: Any
    streams: Any
    waiting: Any
    redraws: Any
    unfair: Any
    mask: Any
    actions: Any
    table: Any
    params: Any
    pins: Any
    controls: Any
    ended: Any
    timed_out: Any
    observations: Any
    final_observations: Any
    rewards: Any
    acted: Any
    terminated: Any
    truncated: Any
    over: Any
    ends: Any
    fault: Any


class Scratch(NamedTuple):
    """What one thread needs for itself; the lanes of a block of worlds, or one."""

    motion: Any
    cars: Any
    path: Any
    sight: Any
    spawn: Any
    drawn: Any


class Form(NamedTuple):
    """What the compiled functions of a configuration depend on, besides the types of the arrays.

    Attributes:
        vehicles: V.
        obstacles: how many bicycles.
        cars: how many oncoming cars.
        draws: how many uniforms an episode takes.
        physics_steps: of a decision.
        measures: of the objectives that the kernel does not measure.
        measured: their names.
    """

    vehicles: int
    obstacles: int
    cars: int
    draws: int
    physics_steps: int
    measures: tuple[Any, ...]
    measured: tuple[str, ...]

    @property
    def spawn(self) -> np.dtype[Any]:
        """SPAWN with the room that the scenario needs."""
        return with_room(SPAWN, self.obstacles, self.cars, 0)


@jit
def draw(streams: NDArray[Any], redraws: NDArray[np.int64], i: int, drawn: NDArray[np.float64]) -> bool:
    """Draw a scenario of the next episode of world ``i``, as ``resetting`` calls it."""
    philox.draw(streams[i], redraws[i], drawn, 0)
    redraws[i] += 1
    return True


@jit
def allow(actions: NDArray[Any], choices: int, i: int) -> bool:
    """Replace the actions of world ``i`` by zeros if one is not allowed; whether all were.

    Args:
        actions: (N, V) integers that must be in [0, choices), or (N, V, 3) numbers that must be finite.
        choices: how many actions there are, if they are discrete.
        i: which world.
    """
    fine = True
    if actions.ndim == 2:
        for v in range(actions.shape[1]):
            fine = fine and 0 <= actions[i, v] < choices
        if not fine:
            for v in range(actions.shape[1]):
                actions[i, v] = 0
    else:
        for v in range(actions.shape[1]):
            for axis in range(3):
                fine = fine and math.isfinite(actions[i, v, axis])
        if not fine:
            for v in range(actions.shape[1]):
                for axis in range(3):
                    actions[i, v, axis] = 0.0
    return fine


@jit
def report(fault: NDArray[np.int64], i: int, what: int) -> None:
    """Leave word of what is wrong with world ``i``, unless there is word of something already."""
    if fault[0] == NO_FAULT:
        fault[0] = 4 * i + what


_reset = resetting(draw)


@uncounted_jit
def record(b: Buffers, i: int) -> None:
    """Write in which state world ``i`` is."""
    over = True
    for v in range(b.ended.shape[1]):
        over = over and (b.ended[i, v] or b.timed_out[i, v])
        b.terminated[i, v] = b.ended[i, v]
        b.truncated[i, v] = b.timed_out[i, v]
        b.ends[i, v] = b.worlds[i, v].end
    b.over[i] = over


@uncounted_jit
def renew(b: Buffers, s: Scratch, i: int) -> None:
    """Start the next episode in world ``i``."""
    b.redraws[i] = 0
    problem = _reset(
        b.worlds, i, b.waiting, b.streams, b.redraws, b.unfair, s.drawn, b.pins, b.params, s.spawn, s.sight,
        b.observations, b.ended, b.timed_out,
    )  # fmt: skip
    if problem != DONE:
        report(b.fault, i, NO_SCENARIO)
    else:
        b.streams[i].episode += philox.ONE


@uncounted_jit
def before_decision(b: Buffers, i: int, mode: int) -> None:
    """Report what is wrong with a step of world ``i``."""
    if not allow(b.actions, b.table.shape[0], i):
        report(b.fault, i, WRONG_ACTION)
    if mode != NEXT_STEP and b.waiting[i]:
        report(b.fault, i, RESET_NEEDED)


@uncounted_jit
def after_decision(b: Buffers, s: Scratch, i: int, mode: int) -> None:
    """Write how the decision has left world ``i``, and reset it if the autoreset mode says so."""
    if mode == SAME_STEP:
        record(b, i)
        for v in range(b.observations.shape[1]):
            for k in range(b.observations.shape[2]):
                b.observations[i, v, k] = b.final_observations[i, v, k]
    if is_due(i, mode, b.waiting, b.ended, b.timed_out):
        renew(b, s, i)
    if mode != SAME_STEP:  # of the new episode, if one has begun
        record(b, i)


@uncounted_jit
def begin_episode(b: Buffers, s: Scratch, i: int, place: bool) -> None:
    """Start a new episode in world ``i``, or with ``place`` = False only look at the state that it is in."""
    if place:
        renew(b, s, i)
    else:
        observe_worlds(b.worlds, i, i + 1, b.params[0], s.sight, b.observations, b.ended, b.timed_out)
    record(b, i)
    b.waiting[i] = b.over[i]
    for v in range(b.acted.shape[1]):
        b.acted[i, v] = False


class Launcher(NamedTuple):
    """One call for all worlds: ``step()``, and ``restart(place)`` for those in the mask."""

    step: Callable[[], None]
    restart: Callable[[bool], None]


@uncounted_jit
def _before_decisions(b: Buffers, mode: int) -> None:
    for i in range(len(b.worlds)):
        before_decision(b, i, mode)


@uncounted_jit
def _after_decisions(b: Buffers, s: Scratch, mode: int) -> None:
    for i in range(len(b.worlds)):
        after_decision(b, s, i, mode)


@uncounted_jit
def _begin_episodes(b: Buffers, s: Scratch, place: bool) -> None:
    for i in range(len(b.worlds)):
        if b.mask[i]:
            begin_episode(b, s, i, place)


def host_launcher(form: Form, buffers: Buffers, mode: int, _device: Any) -> Launcher:
    """The launcher of the CPU, which does every part of a decision for all worlds; buffers of NumPy."""
    decide, b = batch_step(form.measures), buffers
    motion, path = make_scratch(form.vehicles + form.cars, form.physics_steps)
    sight, spawn = np.zeros(1, dtype=observation.SIGHT), np.zeros(1, dtype=form.spawn)
    s = Scratch(motion, traffic.make_scratch(form.cars), path, sight, spawn, np.zeros((1, form.draws)))

    def step() -> None:
        _before_decisions(b, mode)
        decide(
            b.worlds, b.actions, b.table, b.params, b.controls, s.motion, s.cars, s.path, s.sight,
            b.final_observations, b.rewards, b.acted, b.ended, b.timed_out,
        )  # fmt: skip
        _after_decisions(b, s, mode)

    return Launcher(step, lambda place: _begin_episodes(b, s, place))
