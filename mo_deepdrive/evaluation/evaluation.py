"""The episodes of one policy, their metrics, and every metric's 95% interval over the episodes."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mo_deepdrive.evaluation.evaluation_files import Provenance, read_episodes, save_as_run
from mo_deepdrive.evaluation.metrics import (
    ARRIVED,
    COLLISION,
    COMFORT,
    DISCOUNTED_RETURN,
    DISCOUNTED_UTILITY_ESR,
    DISCOUNTED_UTILITY_SER,
    END,
    GINI_UTILITY_ESR,
    LENGTH,
    MEAN_UTILITY_ESR,
    RETURN,
    SHARE_ARRIVED,
    SHARE_COLLIDED,
    SUCCESS,
    TOTAL_UTILITY_ESR,
    USUAL_FAILURES,
    UTILITY_ESR,
    UTILITY_SER,
    WORST_OFF_UTILITY_ESR,
    discounted_return_of,
    end_by,
    end_rates,
    joint_objectives,
    maximum_of,
    mean_of,
    return_of,
    split_name,
    vehicle_prefix,
)
from mo_deepdrive.evaluation.splits import describe_episodes
from mo_deepdrive.evaluation.statistics import Estimate, mean, rate, utility_of_mean
from mo_deepdrive.evaluation.team import generalised_gini, total, worst_off

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from mo_deepdrive.utilities import Utility


class Measure(NamedTuple):
    """A metric: its name, its value, and what makes its estimate, which resamples the episodes."""

    name: str
    value: float
    estimate: Callable[[], Estimate]


@dataclass(repr=False)
class Evaluation:
    """E episodes of one policy with V vehicles.

    Attributes:
        objectives: names of the d components.
        utilities: one per vehicle; empty if no utility is known.
        returns: (E, V, d) undiscounted vector returns.
        discounted: (E, V, d) vector returns discounted with the evaluation's gamma.
        lengths: (E, V) decisions.
        succeeded: (E, V) whether the goal was reached.
        ends: (E, V) why the episode ended; None where the environment does not say.
        largest: (E, V, d) largest magnitude of each objective in one decision.
        provenance: environment, seeds and discount; None if the evaluation was not made by
            :func:`mo_deepdrive.evaluation.evaluate`.
    """

    objectives: tuple[str, ...]
    utilities: tuple[Utility, ...]
    returns: NDArray[np.float64]
    discounted: NDArray[np.float64]
    lengths: NDArray[np.int64]
    succeeded: NDArray[np.bool_]
    ends: NDArray[Any]
    largest: NDArray[np.float64]
    provenance: Provenance | None = field(default=None, kw_only=True)

    def __repr__(self) -> str:
        """A line on what was driven, and one per vehicle with the mean scores."""
        episodes, vehicles, _ = self.returns.shape
        about, driven = self.provenance, f"{episodes} episodes"
        if about is not None:
            driven = f"{describe_episodes(episodes, about.seed)} of {about.env_id}"
        lines = [f"Evaluation: {driven}, {vehicles} vehicle{'' if vehicles == 1 else 's'}"]
        if vehicles > 1:
            team = [f"{name} {samples.mean():.4g}" for name, samples in self.team_samples().items()]
            lines.append(f"  together: {', '.join(team)}")
        for v in range(vehicles):
            scores = [f"{SUCCESS} {self.succeeded[:, v].mean():.4g}"]
            if self.utilities:
                scores.append(f"{UTILITY_ESR} {self.episode_utilities(v).mean():.4g} ({self.utilities[v].name})")
            means = zip(self.objectives, self.returns[:, v].mean(axis=0), strict=True)
            scores.append("mean returns " + ", ".join(f"{name} {value:.4g}" for name, value in means))
            lines.append(f"  {vehicle_prefix(v, vehicles).replace('/', ': ')}{'; '.join(scores)}")
        return "\n".join(lines)

    def save(self, directory: str | Path, *, name: str, seed: int, steps: int = 0, greedy: bool | None = None) -> Path:
        """Write a new directory that ``mo-deepdrive table`` and ``plot`` read as that of a run.

        Args:
            directory: it must not exist; its parents are made.
            name: label of the algorithm. Evaluations with the same label, task and ``steps`` are one row, over seeds.
            seed: by which the policy was trained.
            steps: environment steps of its training.
            greedy: whether the policy takes its most likely (or mean) action or samples; as evaluated if None, which
                for a function means greedy.

        Returns:
            The directory, from which :meth:`load` reads the evaluation again.

        Raises:
            ValueError: if the directory exists, an argument is not valid, or the environment is not known.
            OSError: if it cannot be written; nothing is left then.
        """
        if greedy is None:
            greedy = self.provenance is None or self.provenance.greedy
        return save_as_run(self, directory, name=name, seed=seed, steps=steps, greedy=greedy)

    @classmethod
    def load(cls, directory: str | Path, *, utilities: Sequence[Utility] | None = None) -> Evaluation:
        """The evaluation that :meth:`save` wrote; no code is run from the files.

        Args:
            directory: of the evaluation.
            utilities: one per vehicle, in place of those that were saved; needed for those made of a function.

        Raises:
            ValueError: if it is missing or broken, or has a utility that this package cannot make.
        """
        return cls(**read_episodes(directory, utilities))

    def episode_utilities(self, v: int = 0) -> NDArray[np.float64]:
        """(E,) utility of every undiscounted return of vehicle ``v``; its mean is the ESR value."""
        return np.asarray(self.utilities[v](self.returns[:, v]))

    def team_samples(self) -> dict[str, NDArray[Any]]:
        """(E,) what is measured of all vehicles together, by metric; means are the metrics."""
        collided = np.array([[end == COLLISION for end in ends] for ends in self.ends.tolist()])
        samples: dict[str, NDArray[Any]] = {
            SUCCESS: self.joint_succeeded,
            end_by(COLLISION): np.asarray(collided.any(axis=1)),
            SHARE_ARRIVED: self.succeeded.mean(axis=1),
            SHARE_COLLIDED: collided.mean(axis=1),
        }
        if self.utilities:
            each = np.stack([self.episode_utilities(v) for v in range(self.returns.shape[1])], axis=1)
            samples[TOTAL_UTILITY_ESR] = total(each)
            samples[MEAN_UTILITY_ESR] = samples[TOTAL_UTILITY_ESR] / each.shape[1]
            samples[WORST_OFF_UTILITY_ESR] = worst_off(each)
            samples[GINI_UTILITY_ESR] = generalised_gini(each)
        return samples

    @property
    def joint_objectives(self) -> tuple[str, ...]:
        """Names of the V d components of joint returns: those of the first vehicle, of the second one, and so on."""
        return joint_objectives(self.objectives, self.returns.shape[1])

    @property
    def joint_returns(self) -> NDArray[np.float64]:
        """(E, V d) undiscounted returns of all vehicles."""
        return self.returns.reshape(len(self.returns), -1)

    @property
    def joint_discounted(self) -> NDArray[np.float64]:
        """(E, V d) discounted returns of all vehicles."""
        return self.discounted.reshape(len(self.discounted), -1)

    @property
    def joint_lengths(self) -> NDArray[np.int64]:
        """(E,) decisions until the last vehicle was through."""
        return np.asarray(self.lengths.max(axis=1))

    @property
    def joint_succeeded(self) -> NDArray[np.bool_]:
        """(E,) whether all vehicles reached their goals."""
        return np.asarray(self.succeeded.all(axis=1))

    def end_rates(self, v: int = 0) -> dict[str, float]:
        """Share of the episodes of vehicle ``v`` per reason of their end."""
        return end_rates(self.ends[:, v])

    def estimates(self) -> dict[str, Estimate]:
        """Every metric with its interval; with several vehicles prefixed by ``vehicle_0/`` and so on.

        With several vehicles ``success`` is the share of episodes in which all arrived, ``end/collision`` of those in
        which any collided, ``share_arrived`` and ``share_collided`` are shares of the vehicles, ``total_utility_esr``
        is the sum of the utilities, ``mean_utility_esr`` their mean, ``worst_off_utility_esr`` the least of them,
        ``gini_utility_esr`` the sum that counts the worse-off for more.

        Means and utilities have bootstrap intervals over episodes, rates have Wilson's; the largest magnitudes in one
        decision have none. ``success`` is there if the environment reports it, and of failures the usual ones and those
        that occurred.
        """
        measures = self._measures(_place_in_tables)
        return {name: estimate() for name, value, estimate in measures if self._is_reported(name, value)}

    def metrics(self) -> dict[str, float]:
        """Every metric by name (:mod:`mo_deepdrive.evaluation.metrics`), as :meth:`estimates` without the intervals."""
        return {name: value for name, value, _ in self._measures()}

    def _measures(self, place: Callable[[Measure], int] = lambda _: 0) -> Iterator[Measure]:
        vehicles = self.returns.shape[1]
        if vehicles > 1:
            for name, samples in self.team_samples().items():
                yield _mean_of(name, samples)
        for v in range(vehicles):
            for measure in sorted(self._vehicle_measures(v), key=place):
                yield measure._replace(name=vehicle_prefix(v, vehicles) + measure.name)

    def _vehicle_measures(self, v: int) -> Iterator[Measure]:
        returns, discounted, lengths = self.returns[:, v], self.discounted[:, v], self.lengths[:, v]
        if self.utilities:
            utility = self.utilities[v]
            for esr, ser, vectors in (
                (UTILITY_ESR, UTILITY_SER, returns),
                (DISCOUNTED_UTILITY_ESR, DISCOUNTED_UTILITY_SER, discounted),
            ):
                yield _mean_of(esr, np.asarray(utility(vectors)))
                yield Measure(ser, float(utility(vectors.mean(axis=0))), partial(utility_of_mean, vectors, utility))
        yield _mean_of(SUCCESS, self.succeeded[:, v])
        yield _mean_of(LENGTH, lengths)
        for reason in self.end_rates(v):
            yield _mean_of(end_by(reason), np.array([str(end) == reason for end in self.ends[:, v]]))
        for i, objective in enumerate(self.objectives):
            yield _mean_of(return_of(objective), returns[:, i])
            yield _mean_of(discounted_return_of(objective), discounted[:, i])
            if objective in COMFORT:
                yield _mean_of(mean_of(objective), np.abs(returns[:, i]) / np.maximum(lengths, 1))
                largest = float(self.largest[:, v, i].max())
                yield Measure(maximum_of(objective), largest, partial(Estimate, largest))

    def _is_reported(self, name: str, value: float) -> bool:
        """Whether a metric has a place in tables: what no episode came to is left out, but for the usual failures."""
        _, vehicle, metric = split_name(name)
        if metric == SUCCESS:
            of_all = not vehicle and self.returns.shape[1] > 1
            return of_all or value > 0.0 or any(end is not None for end in self.ends.flat)
        if metric.startswith(END):
            return metric != end_by(ARRIVED) and (value > 0.0 or metric.removeprefix(END) in USUAL_FAILURES)
        return True


def _mean_of(name: str, samples: NDArray[Any]) -> Measure:
    return Measure(name, float(np.mean(samples)), partial(rate if samples.dtype == np.bool_ else mean, samples))


def _place_in_tables(measure: Measure) -> int:
    """After utilities and success come the usual failures, other ends, length and returns, and comfort."""
    name = measure.name
    if name.startswith(END):
        return 1 if name.removeprefix(END) in USUAL_FAILURES else 2
    if name == LENGTH or name.startswith((RETURN, DISCOUNTED_RETURN)):
        return 3
    return 4 if name.startswith(("mean_", "max_")) else 0
