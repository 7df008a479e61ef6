"""Collects with :mod:`algorithms.rollouts.compiled_loop`: a rollout is one call instead of hundreds.

It serves our environments when nothing but compiled networks acts in them, and does what
:meth:`algorithms.rollouts.collector.Collector.collect` does, in the same order and with the same random numbers, so
that the rollout is the same, bit for bit. Several threads share the environments.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any, cast

import numba
import numpy as np
import torch
from numba import types

from algorithms.networks.actors import CategoricalActor, GaussianActor, StateGaussianActor, check_outputs
from algorithms.networks.compiled.perceptron import Perceptron
from algorithms.networks.threads import one_blas_thread, wanted_threads
from algorithms.rollouts.compiled_loop import DONE, NEEDS_DRAWS, NO_VALID_SCENARIO, Policies, Worlds, collect_part
from mo_deepdrive.batch import MAX_REDRAWS
from mo_deepdrive.faults import check_vehicles
from mo_deepdrive.simulation.kernel import reset_batch, step_batch
from mo_deepdrive.thread_pool import ThreadPool

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from algorithms.networks.actors import Actor
    from algorithms.rollouts.collector import Collector
    from mo_deepdrive.batch import Part, WorldBatch

    Kernel = tuple[Any, ...]
    Loop = Callable[..., tuple[int, int]]

ACTORS = (CategoricalActor, GaussianActor, StateGaussianActor)


class CompiledCollection:
    """Collects the rollouts of a collector whose environments are ours and whose vehicles are driven by ``actors``.

    Args:
        collector: whose buffers are written.
        actors: of every vehicle, in order.
        accrued_scales: (d,) by which the accrued reward is divided that the actors observe; None if they do not.
    """

    def __init__(
        self,
        collector: Collector,
        actors: Sequence[Actor],
        accrued_scales: NDArray[np.float32] | None,
    ):
        self._collector = collector
        self._actors = actors
        assert collector.env.bare is not None  # see serves()
        self._env = collector.env.bare
        none = np.zeros(0, dtype=np.float32)
        self._scales = collector.env.observation_scales, none if accrued_scales is None else accrued_scales
        batch, streams = self._env.batch, self._env.streams
        # As many parts as threads were asked for, so that the results do not depend on the machine's cores.
        parts = batch.parts(min(wanted_threads(), len(batch.state)))
        self._worlds = [_worlds(part, batch, streams.blocks, streams.cursors) for part in parts]
        steps, n = collector.actions.shape[:2]
        k = collector.env.actions if collector.env.continuous else 1
        self._noise = np.zeros((steps, len(actors), n, k), dtype=np.float32)
        self._loop: Loop | None = None
        self._kernel: Kernel = ()
        self._threads = ThreadPool()

    @staticmethod
    def serves(collector: Collector, actors: Sequence[Actor]) -> bool:
        """Whether the collector's environments are ours, and the actors and networks are those of this package."""
        compiled = all(
            type(actor) in ACTORS and type(actor.body) is Perceptron and actor.body.can_be_compiled for actor in actors
        )
        return collector.env.bare is not None and compiled

    def collect(self, generator: torch.Generator) -> None:
        """Fill the collector's buffers; ``generator`` draws the actions.

        Raises:
            ResetNeeded: before the first reset.
            NotFinite: for rewards or outputs of a network that are not finite; nothing of the rollout may be used.
            ValueError: if no valid scenario is found.
        """
        collector, env = self._collector, self._env
        env.check_ready()
        steps, n = collector.actions.shape[:2]
        networks = [cast("Perceptron", actor.body) for actor in self._actors]
        kept = [network.keep_passes(steps * n) for network in networks]
        arrays = [network.parameter_arrays() for network in networks]
        deviations = [actor.log_std.detach().exp() for actor in self._actors if isinstance(actor, GaussianActor)]
        policies = Policies(
            rows=tuple([each.rows for each in kept]),
            weights=tuple([weights for weights, _ in arrays]),
            biases=tuple([biases for _, biases in arrays]),
            hidden=tuple([each.space.hidden(steps * n) for each in kept]),
            outputs=tuple([each.outputs for each in kept]),
            deviations=torch.stack(deviations).numpy() if deviations else np.zeros((len(kept), 0), dtype=np.float32),
            observation_scales=self._scales[0],
            accrued_scales=self._scales[1],
        )
        for t in range(steps):
            for v, actor in enumerate(self._actors):
                self._noise[t, v] = actor.noise(n, generator)
        shared = policies, self._noise, collector.actions, collector.buffers
        if self._loop is None:
            first = self._worlds[0]
            self._kernel = _pointers(env.batch, first)
            self._loop = _compiled_loop((first, *shared), self._kernel)
        loop = self._loop
        with one_blas_thread():
            self._threads.run(lambda worlds: self._run(loop, worlds, shared), self._worlds)
        collector.check_finite()
        for each in kept:
            check_outputs(each.outputs.T, n)
            each.done = steps * n
        collector.observations = env.batch.observations.copy()

    def _run(self, loop: Loop, worlds: Worlds, shared: tuple[Any, ...]) -> None:
        env = self._env
        start, problem = loop(0, worlds, *shared, *self._kernel)
        while problem != DONE:
            if problem == NEEDS_DRAWS:
                over = (worlds.terminated | worlds.truncated).all(axis=1)
                env.streams.refill(worlds.first + np.flatnonzero(over))
            elif problem == NO_VALID_SCENARIO:
                raise ValueError(f"no valid scenario in {MAX_REDRAWS} draws")
            else:
                self._collector.check_finite()  # what the actions depend on
                check_vehicles("action", self._collector.actions[start], self._collector.env.name)
            start, problem = loop(start, worlds, *shared, *self._kernel)


def _worlds(part: Part, batch: WorldBatch, blocks: NDArray[np.float64], cursors: NDArray[np.int64]) -> Worlds:
    return Worlds(
        first=part.rows.start,
        state=part.worlds,
        controls=part.controls,
        motion=part.motion,
        cars=part.cars,
        path=part.path,
        sight=part.sight,
        spawn=part.spawn,
        observations=part.observations,
        rewards=part.rewards,
        terminated=part.terminated,
        truncated=part.truncated,
        params=batch.params,
        pins=batch.no_pins,
        table=batch.table,
        blocks=blocks[part.rows],
        cursors=cursors[part.rows],
        attempts=np.zeros(len(part.worlds), dtype=np.int64),
        draws=np.zeros((1, blocks.shape[2])),
        columns=np.array([measure.column for measure in batch.measures], dtype=np.int64),
        signs=np.array([measure.sign for measure in batch.measures]),
    )


class _Pointer(types.WrapperAddressProtocol):
    """A pointer to a compiled function that returns nothing.

    A function that is passed as it is would be compiled again within what it is passed to, or its address looked up at
    every call.

    Args:
        function: the function.
        arguments: like those that it will be called with.
    """

    def __init__(self, function: Any, arguments: Sequence[Any]):
        arguments = tuple(map(numba.typeof, arguments))
        function.compile(arguments)
        compiled = function.overloads[arguments]
        self.type = types.FunctionType(types.void(*arguments))
        self._function = function  # keeps the code alive
        self._address = compiled.library.get_pointer_to_function(compiled.fndesc.llvm_cfunc_wrapper_name)

    def __wrapper_address__(self) -> int:
        return int(self._address)

    def signature(self) -> Any:
        """Of the function."""
        return self.type.signature


def _pointers(batch: WorldBatch, worlds: Worlds) -> Kernel:
    """What :func:`collect_part` calls: the kernel's two functions, and what measures further objectives."""
    acted = np.zeros(worlds.terminated.shape, dtype=np.bool_)
    step = (
        worlds.state, worlds.controls, worlds.params, worlds.motion, worlds.cars, worlds.path, worlds.sight,
        worlds.observations, worlds.rewards, worlds.terminated, worlds.truncated,
    )  # fmt: skip
    reset = (
        worlds.state, np.zeros(1, dtype=np.int64), worlds.draws, worlds.pins, worlds.params, worlds.spawn, acted[0],
        worlds.sight, worlds.observations, worlds.terminated, worlds.truncated,
    )  # fmt: skip
    measures = [
        _Pointer(measure.write, (worlds.state, worlds.params, acted, measure.column, measure.sign, worlds.rewards))
        for measure in batch.measures
    ]
    return _Pointer(step_batch, step), _Pointer(reset_batch, reset), tuple(measures)


def _compiled_loop(arguments: tuple[Any, ...], kernel: Kernel) -> Loop:
    """:func:`collect_part` for arguments like these."""
    step, reset, measures = kernel
    several = types.UniTuple(measures[0].type, len(measures)) if measures else types.Tuple(())  # type: ignore[no-untyped-call]
    signature = types.int64, *map(numba.typeof, arguments), step.type, reset.type, several
    loop: Any = collect_part
    if signature not in loop.overloads:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", numba.NumbaExperimentalFeatureWarning)  # pointers to functions
            loop.compile(signature)
    entry: Loop = loop.get_overload(signature)
    return entry
