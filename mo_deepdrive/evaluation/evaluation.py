"""The episodes of one policy, their metrics, and every metric's 95% interval over the episodes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.evaluation.evaluation_files import Provenance, read_episodes, save_as_run
from mo_deepdrive.evaluation.metrics import (
    ARRIVED,
    COLLISION,
    COMFORT,
    DISCOUNTED_UTILITY_ESR,
    DISCOUNTED_UTILITY_SER,
    GINI_UTILITY_ESR,
    LENGTH,
    MEAN_UTILITY_ESR,
    OUR_ENDS,
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
    summarise,
    vehicle_prefix,
)
from mo_deepdrive.evaluation.splits import describe_episodes
from mo_deepdrive.evaluation.statistics import Estimate, mean, rate, utility_of_mean
from mo_deepdrive.evaluation.team_utility import generalised_gini, total, worst_off

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from mo_deepdrive.utilities import Utility


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
        """Every metric with its 95% interval (:func:`estimate_metrics`)."""
        return estimate_metrics(self)

    def metrics(self) -> dict[str, float]:
        """Every metric by name (:mod:`mo_deepdrive.evaluation.metrics`).

        With several vehicles the names begin with ``vehicle_0/`` and so on, and :meth:`team_samples` has those of all
        together.
        """
        metrics: dict[str, float] = {}
        vehicles = self.returns.shape[1]
        if vehicles > 1:
            metrics |= {name: float(samples.mean()) for name, samples in self.team_samples().items()}
        for v in range(vehicles):
            summary = summarise(
                self.objectives,
                self.returns[:, v],
                self.lengths[:, v],
                self.succeeded[:, v],
                utility=self.utilities[v] if self.utilities else None,
                discounted=self.discounted[:, v],
                ends=self.ends[:, v],
                largest=self.largest[:, v],
            )
            metrics |= {vehicle_prefix(v, vehicles) + name: value for name, value in summary.items()}
        return metrics


def estimate_metrics(evaluation: Evaluation) -> dict[str, Estimate]:
    """Every metric of an evaluation with its interval; with several vehicles prefixed by ``vehicle_0/`` and so on.

    With several vehicles ``success`` is the share of episodes in which all arrived, ``end/collision`` of those in which
    any collided, ``share_arrived`` and ``share_collided`` are shares of the vehicles, ``total_utility_esr`` is the sum
    of the utilities, ``mean_utility_esr`` their mean, ``worst_off_utility_esr`` the least of them,
    ``gini_utility_esr`` the sum that counts the worse-off for more.

    Means and utilities have bootstrap intervals over episodes, rates have Wilson's; the largest magnitudes in one
    decision have none.
    """
    estimates: dict[str, Estimate] = {}
    vehicles = evaluation.returns.shape[1]
    if vehicles > 1:
        for name, samples in evaluation.team_samples().items():
            estimates[name] = rate(samples) if samples.dtype == np.bool_ else mean(samples)
    for v in range(vehicles):
        prefix = vehicle_prefix(v, vehicles)
        estimates |= {prefix + name: value for name, value in _estimate_vehicle(evaluation, v).items()}
    return estimates


def _estimate_vehicle(evaluation: Evaluation, v: int) -> dict[str, Estimate]:
    returns, discounted = evaluation.returns[:, v], evaluation.discounted[:, v]
    lengths, ends = evaluation.lengths[:, v], evaluation.ends[:, v]
    estimates: dict[str, Estimate] = {}
    if evaluation.utilities:
        utility = evaluation.utilities[v]
        estimates = {
            UTILITY_ESR: mean(np.asarray(utility(returns))),
            UTILITY_SER: utility_of_mean(returns, utility),
            DISCOUNTED_UTILITY_ESR: mean(np.asarray(utility(discounted))),
            DISCOUNTED_UTILITY_SER: utility_of_mean(discounted, utility),
        }
    known = {str(end) for end in ends if end is not None}
    if known or evaluation.succeeded[:, v].any():
        estimates[SUCCESS] = rate(evaluation.succeeded[:, v])
    if known:
        usual = USUAL_FAILURES if known <= OUR_ENDS else ()
        reasons = (*usual, *sorted(known - {ARRIVED, *usual}))
        estimates |= {end_by(reason): rate(np.array([str(end) == reason for end in ends])) for reason in reasons}
    estimates[LENGTH] = mean(lengths.astype(np.float64))
    for i, objective in enumerate(evaluation.objectives):
        estimates[return_of(objective)] = mean(returns[:, i])
        estimates[discounted_return_of(objective)] = mean(discounted[:, i])
    for i, objective in enumerate(evaluation.objectives):
        if objective in COMFORT:
            estimates[mean_of(objective)] = mean(np.abs(returns[:, i]) / np.maximum(lengths, 1))
            estimates[maximum_of(objective)] = Estimate(float(evaluation.largest[:, v, i].max()))
    return estimates
