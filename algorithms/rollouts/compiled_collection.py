"""Collects with :mod:`mo_deepdrive.rollout`: a rollout is one call instead of hundreds.

It serves our environments when nothing but compiled networks acts in them, and does what
:meth:`algorithms.rollouts.collector.Collector.collect` does, in the same order and with the same random numbers, so
that the rollout is the same, bit for bit. Several threads share the environments.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch

from algorithms.networks.actors import CategoricalActor, GaussianActor, StateGaussianActor, check_outputs
from algorithms.networks.compiled.perceptron import Perceptron
from algorithms.networks.threads import one_blas_thread, wanted_threads
from algorithms.rollouts.compiled_policy import Policies, act
from mo_deepdrive.faults import check_vehicles
from mo_deepdrive.rollout import WorldRollout

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from algorithms.networks.actors import Actor
    from algorithms.rollouts.collector import Collector

ACTORS = (CategoricalActor, GaussianActor, StateGaussianActor)


class CompiledCollection:
    """Collects the rollouts of a collector whose environments are ours and whose vehicles are driven by ``actors``.

    Args:
        collector: whose buffers are written.
        actors: by the vehicles that each drives, all equally many.
        accrued_scales: (d,) by which the accrued reward is divided that the actors observe; None if they do not.
        act: the callback of the rollout.
    """

    def __init__(
        self,
        collector: Collector,
        actors: Mapping[tuple[int, ...], Actor],
        accrued_scales: NDArray[np.float32] | None,
        act: Any = act,
    ):
        self._collector = collector
        self._actors = [*actors.values()]
        self._vehicles = np.array([*actors])
        assert collector.env.bare is not None  # see serves()
        self._env = collector.env.bare
        none = np.zeros(0, dtype=np.float32)
        self._scales = collector.env.observation_scales, none if accrued_scales is None else accrued_scales
        steps, n = collector.actions.shape[:2]
        k = collector.env.actions if collector.env.continuous else 1
        self._rows = n * self._vehicles.shape[1]  # of an actor in a decision
        self._noise = np.zeros((steps, len(actors), self._rows, k), dtype=np.float32)
        # As many parts as threads were asked for, so that the results do not depend on the machine's cores.
        env, parts = self._env, wanted_threads()
        self._rollout = WorldRollout(env.batch, env.streams, collector.actions, collector.buffers, act, parts)

    @staticmethod
    def serves(collector: Collector, actors: Sequence[Actor]) -> bool:
        """Whether the collector's environments are ours, and the actors and networks are those of this package."""
        compiled = all(
            type(actor) in ACTORS and type(actor.body) is Perceptron and actor.body.can_be_compiled for actor in actors
        )
        return collector.env.bare is not None and compiled

    def collect(self, generator: torch.Generator, complete: Callable[[Policies], Any] = lambda each: each) -> None:
        """Fill the collector's buffers.

        Args:
            generator: draws the actions.
            complete: makes of the policies what ``act`` is given.

        Raises:
            ResetNeeded: before the first reset.
            NotFinite: for rewards or outputs of a network that are not finite; nothing of the rollout may be used.
            ValueError: if no valid scenario is found.
        """
        collector, env = self._collector, self._env
        env.check_ready()
        steps, n = len(collector.actions), self._rows
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
            noise=self._noise,
            vehicles=self._vehicles,
        )
        for t in range(steps):
            for g, actor in enumerate(self._actors):
                self._noise[t, g] = actor.noise(n, generator)
        with one_blas_thread():
            self._rollout.run(complete(policies), self._not_finite)
        collector.check_finite()
        for each in kept:
            check_outputs(each.outputs.T, collector.env.num_envs, self._vehicles.shape[1])
            each.done = steps * n
        collector.observations = env.batch.observations.copy()

    def _not_finite(self, t: int) -> None:
        self._collector.check_finite()  # what the actions depend on
        check_vehicles("action", self._collector.actions[t], self._collector.env.name)
