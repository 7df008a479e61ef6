"""The episodes of one policy, their metrics with 95% intervals over the episodes, and both as files."""

from __future__ import annotations

import io
import json
import os
import zipfile
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import yaml

from mo_deepdrive.evaluation import metrics
from mo_deepdrive.evaluation.splits import describe_episodes, split_of
from mo_deepdrive.evaluation.statistics import Estimate, mean_or_rate, of_mean
from mo_deepdrive.evaluation.team import generalised_gini, total, worst_off
from mo_deepdrive.support.atomic_io import atomic_folder, atomic_write, csv_bytes, own_path, write_json
from mo_deepdrive.utilities import make_utility

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from mo_deepdrive.utilities import Utility


EVALUATION_FILE, EPISODES_FILE = "evaluation.json", "episodes.npz"
ARRAYS = ("returns", "discounted", "lengths", "succeeded", "ends", "largest")


@dataclass(frozen=True)
class Provenance:
    """How an evaluation was done."""

    env_id: str  #: the environment
    seed: int  #: of the first episode; those of the others count up
    gamma: float  #: discount of the discounted returns
    #: Whether actions were the most likely (or mean) ones; of a function, which evaluate cannot know, True.
    greedy: bool
    #: Of the environment; of this package's all, of another's those that were given.
    arguments: Mapping[str, Any] = field(default_factory=dict)


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
            scores = [f"{metrics.SUCCESS} {self.succeeded[:, v].mean():.4g}"]
            if self.utilities:
                scores.append(
                    f"{metrics.UTILITY_ESR} {self.episode_utilities(v).mean():.4g} ({self.utilities[v].name})"
                )
            means = zip(self.objectives, self.returns[:, v].mean(axis=0), strict=True)
            scores.append("mean returns " + ", ".join(f"{name} {value:.4g}" for name, value in means))
            lines.append(f"  {metrics.vehicle_prefix(v, vehicles).replace('/', ': ')}{'; '.join(scores)}")
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
        about = self.provenance
        if about is None:
            raise ValueError("the evaluation does not know its environment: save what evaluate returned")
        for argument, value in (("seed", seed), ("steps", steps)):
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 0:
                raise ValueError(f"{argument} = {value!r} must be an integer of at least 0")
        if not (isinstance(name, str) and name.strip() and name.isprintable()):
            raise ValueError(f"name = {name!r} must be the label of the algorithm")
        target, episodes = Path(directory), len(self.returns)
        if os.path.lexists(target):
            raise ValueError(f"directory {str(target)!r} exists; choose another")
        utilities = [{"name": u.name, "arguments": _plain(u.arguments or {})} for u in self.utilities]
        different = {metrics.vehicle_name(v): u for v, u in enumerate(utilities) if u != utilities[0]}
        config = {
            "environment": {"id": about.env_id, "arguments": _plain(about.arguments)},
            "utility": {**utilities[0], "vehicles": different} if utilities else None,
            "algorithm": {"name": name},
            "training": {"total_timesteps": int(steps), "seed": int(seed)},
            "evaluation": {
                "final_episodes": episodes,
                "split": split_of(about.seed, episodes),
                "gamma": about.gamma,
                "reference_point": None,
            },
        }
        policy = metrics.GREEDY if (about.greedy if greedy is None else greedy) else metrics.STOCHASTIC
        curve = {metrics.evaluation_prefix(policy) + metric: value for metric, value in self.metrics().items()}
        rows: list[list[Any]] = [[metrics.STEP, *curve], [int(steps), *curve.values()]]
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_folder(target) as staged:
            how = {"step": int(steps), "episodes": episodes, "seed": about.seed, "gamma": about.gamma}
            write_evaluation(staged, {policy: self}, how)
            atomic_write(staged / "metrics.csv", csv_bytes(rows))
            atomic_write(staged / EPISODES_FILE, _episodes_bytes(self))
            atomic_write(staged / "config.yaml", yaml.safe_dump(config, sort_keys=False).encode())
        return target

    @classmethod
    def load(cls, directory: str | Path, *, utilities: Sequence[Utility] | None = None) -> Evaluation:
        """The evaluation that :meth:`save` wrote; no code is run from the files.

        Args:
            directory: of the evaluation.
            utilities: one per vehicle, in place of those that were saved; needed for those made of a function.

        Raises:
            ValueError: if it is missing or broken, or has a utility that this package cannot make.
        """
        path = Path(directory) / EPISODES_FILE
        if not path.is_file():
            raise ValueError(f"{str(directory)!r} has no {EPISODES_FILE}; Evaluation.save writes it")
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in ARRAYS}
                about = json.loads(str(file["about"]))
            objectives, provenance = tuple(about["objectives"]), Provenance(**about["provenance"])
            known = [(str(name), arguments) for name, arguments in about["utilities"]]
            episodes, vehicles, _ = arrays["returns"].shape
            for name, array in arrays.items():
                vectors = (len(objectives),) if name in ("returns", "discounted", "largest") else ()
                if array.shape != (episodes, vehicles, *vectors):
                    raise ValueError(f"its arrays do not fit together: {name} has the shape {array.shape}")
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"{str(path)!r} is not a saved evaluation: {error}") from None
        if utilities is None:
            cost_sign = provenance.arguments.get("cost_sign", "maximise")
            utilities = [_utility(name, objectives, cost_sign, arguments) for name, arguments in known]
        elif len(utilities) != vehicles:
            raise ValueError(f"{len(utilities)} utilities are given for {vehicles} vehicles")
        ends = np.where(arrays["ends"] == "", None, arrays["ends"].astype(object))
        arrays = {**arrays, "ends": ends}
        return cls(objectives=objectives, utilities=tuple(utilities), **arrays, provenance=provenance)

    def episode_utilities(self, v: int = 0) -> NDArray[np.float64]:
        """(E,) utility of every undiscounted return of vehicle ``v``; its mean is the ESR value."""
        return np.asarray(self.utilities[v](self.returns[:, v]))

    def team_samples(self) -> dict[str, NDArray[Any]]:
        """(E,) what is measured of all vehicles together, by metric; means are the metrics."""
        collided = np.array([[end == metrics.COLLISION for end in ends] for ends in self.ends.tolist()])
        samples: dict[str, NDArray[Any]] = {
            metrics.SUCCESS: self.joint_succeeded,
            metrics.end_by(metrics.COLLISION): np.asarray(collided.any(axis=1)),
            metrics.SHARE_ARRIVED: self.succeeded.mean(axis=1),
            metrics.SHARE_COLLIDED: collided.mean(axis=1),
        }
        if self.utilities:
            utilities = np.stack([self.episode_utilities(v) for v in range(self.returns.shape[1])], axis=1)
            samples[metrics.TOTAL_UTILITY_ESR] = total(utilities)
            samples[metrics.MEAN_UTILITY_ESR] = samples[metrics.TOTAL_UTILITY_ESR] / utilities.shape[1]
            samples[metrics.WORST_OFF_UTILITY_ESR] = worst_off(utilities)
            samples[metrics.GINI_UTILITY_ESR] = generalised_gini(utilities)
        return samples

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
        return metrics.end_rates(self.ends[:, v])

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
        return {
            measure.name: measure.estimate()
            for measure in self._measures()
            if self._is_reported(measure.name, measure.value)
        }

    def metrics(self) -> dict[str, float]:
        """Every metric by name (:mod:`mo_deepdrive.evaluation.metrics`), as :meth:`estimates` without the intervals."""
        return {measure.name: measure.value for measure in self._measures()}

    def _measures(self) -> Iterator[Measure]:
        vehicles = self.returns.shape[1]
        if vehicles > 1:
            for name, samples in self.team_samples().items():
                yield _mean_of(name, samples)
        for v in range(vehicles):
            for measure in self._vehicle_measures(v):
                yield measure._replace(name=metrics.vehicle_prefix(v, vehicles) + measure.name)

    def _vehicle_measures(self, v: int) -> Iterator[Measure]:
        """In the order of tables."""
        returns, discounted, lengths = self.returns[:, v], self.discounted[:, v], self.lengths[:, v]
        if self.utilities:
            utility = self.utilities[v]
            for esr, ser, vectors in (
                (metrics.UTILITY_ESR, metrics.UTILITY_SER, returns),
                (metrics.DISCOUNTED_UTILITY_ESR, metrics.DISCOUNTED_UTILITY_SER, discounted),
            ):
                yield _mean_of(esr, np.asarray(utility(vectors)))
                yield Measure(ser, float(utility(vectors.mean(axis=0))), partial(of_mean, vectors, utility))
        yield _mean_of(metrics.SUCCESS, self.succeeded[:, v])
        ends = self.ends[:, v]
        for reason in sorted(metrics.end_rates(ends), key=lambda reason: reason not in metrics.USUAL_FAILURES):
            yield _mean_of(metrics.end_by(reason), np.array([str(end) == reason for end in ends]))
        yield _mean_of(metrics.LENGTH, lengths)
        for i, objective in enumerate(self.objectives):
            yield _mean_of(metrics.return_of(objective), returns[:, i])
            yield _mean_of(metrics.discounted_return_of(objective), discounted[:, i])
        for i, objective in enumerate(self.objectives):
            if objective in metrics.COMFORT:
                yield _mean_of(metrics.mean_of(objective), np.abs(returns[:, i]) / np.maximum(lengths, 1))
                largest = float(self.largest[:, v, i].max())
                yield Measure(metrics.maximum_of(objective), largest, partial(Estimate, largest))

    def _is_reported(self, name: str, value: float) -> bool:
        """Whether a metric has a place in tables: what no episode came to is left out, but for the usual failures."""
        _, vehicle, metric = metrics.split_name(name)
        if metric == metrics.SUCCESS:
            of_all = not vehicle and self.returns.shape[1] > 1
            return of_all or value > 0.0 or any(end is not None for end in self.ends.flat)
        if metric.startswith(metrics.END):
            return metric != metrics.end_by(metrics.ARRIVED) and (
                value > 0.0 or metric.removeprefix(metrics.END) in metrics.USUAL_FAILURES
            )
        return True


def _mean_of(name: str, samples: NDArray[Any]) -> Measure:
    return Measure(name, float(np.mean(samples)), partial(mean_or_rate, samples))


# --------------------------------------------------------------------------------------------------------------- files


def write_evaluation(directory: Path, evaluations: Mapping[str, Evaluation], about: Mapping[str, Any]) -> None:
    """Write evaluation.json and evaluation.csv (every metric) and episodes.csv (one row per episode and vehicle).

    The evaluations are one per policy; ``about`` says how they were made: seed, gamma, step and so on. A file that is a
    link is a ValueError.
    """
    policies: dict[str, dict[str, Any]] = {}
    rows: list[list[Any]] = [["policy", "metric", "value", "low", "high"]]
    for policy, evaluation in evaluations.items():
        policies[policy] = {name: asdict(estimate) for name, estimate in evaluation.estimates().items()}
        rows += [[policy, name, *estimate.values()] for name, estimate in policies[policy].items()]
    write_json(own_path(directory, EVALUATION_FILE), {**about, "policies": policies})
    atomic_write(own_path(directory, "evaluation.csv"), csv_bytes(rows))
    atomic_write(own_path(directory, "episodes.csv"), csv_bytes(_episode_rows(evaluations, int(about["seed"]))))


def _episode_rows(evaluations: Mapping[str, Evaluation], seed: int) -> list[list[Any]]:
    objectives = next(iter(evaluations.values())).objectives
    rows: list[list[Any]] = [
        [
            *("policy", "seed", "vehicle", metrics.SUCCESS, "end", metrics.LENGTH, metrics.UTILITY),
            *(metrics.return_of(objective) for objective in objectives),
            *(metrics.discounted_return_of(objective) for objective in objectives),
        ]
    ]
    for policy, evaluation in evaluations.items():
        episodes, vehicles, _ = evaluation.returns.shape
        for v in range(vehicles):
            utilities = evaluation.episode_utilities(v).tolist() if evaluation.utilities else [None] * episodes
            for e in range(episodes):
                how = [bool(evaluation.succeeded[e, v]), evaluation.ends[e, v], int(evaluation.lengths[e, v])]
                returns = [*evaluation.returns[e, v].tolist(), *evaluation.discounted[e, v].tolist()]
                rows.append([policy, seed + e, v, *how, utilities[e], *returns])
    return rows


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """``values`` as text files hold them, with lists in place of arrays and tuples."""
    plain: dict[str, Any] = json.loads(json.dumps(dict(values), default=_plain_value))
    return plain


def _plain_value(value: Any) -> Any:
    """What JSON does not know: NumPy's values, and as text any object that an environment takes."""
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else repr(value)


def _episodes_bytes(evaluation: Evaluation) -> bytes:
    """The arrays, with reasons as text, and the rest as JSON: an .npz file without pickled objects."""
    arrays = {name: getattr(evaluation, name) for name in ARRAYS}
    arrays["ends"] = np.array([["" if end is None else str(end) for end in ends] for ends in evaluation.ends])
    about = {
        "objectives": evaluation.objectives,
        "utilities": [[utility.name, utility.arguments] for utility in evaluation.utilities],
        "provenance": None if evaluation.provenance is None else asdict(evaluation.provenance),
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, about=np.array(json.dumps(about, default=_plain_value)), **arrays)
    return buffer.getvalue()


def _utility(name: str, objectives: Sequence[str], cost_sign: str, arguments: Mapping[str, Any] | None) -> Utility:
    """A utility by what was saved of it; nothing is imported that a file names."""
    try:
        if ":" in name or arguments is None:
            raise ValueError("it is a function that is not in this package")
        return make_utility(name, objectives, cost_sign=cost_sign, **arguments)
    except (ValueError, TypeError) as error:
        raise ValueError(f"utility {name!r} cannot be loaded: {error}; give utilities=[...]") from None
