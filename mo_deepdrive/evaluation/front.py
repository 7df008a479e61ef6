"""Fronts: the policies that a multi-policy algorithm found, each with the returns measured by evaluating it anew."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.evaluation.evaluation import EVALUATION_FILE as EVALUATION_FILE
from mo_deepdrive.evaluation.metrics import (
    ADDITIVE_EPSILON,
    CARDINALITY,
    DISCOUNTED_RETURN,
    EXPECTED_UTILITY,
    HYPERVOLUME,
    IGD_PLUS,
    LENGTH,
    RETURN,
    SUCCESS,
    joint_objectives,
)
from mo_deepdrive.evaluation.pareto import (
    WEIGHTS,
    additive_epsilon,
    evenly_spaced_weights,
    expected_utility,
    finite_points,
    hypervolume,
    igd_plus,
    non_dominated,
)
from mo_deepdrive.evaluation.statistics import MIN_SAMPLES, bootstrap
from mo_deepdrive.support.atomic_io import atomic_write, csv_bytes, own_path, write_json

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from gymnasium.vector import VectorEnv
    from numpy.typing import ArrayLike, NDArray

    from mo_deepdrive.evaluation.evaluation import Evaluation

FRONT_FILE = "front.csv"
CONDITION = "condition/"  # prefix of columns of front.csv
LARGEST = 1e100  # magnitude of a number, of which products remain finite


@dataclass(frozen=True)
class Front:
    """K re-evaluated policies, all objectives maximised."""

    #: Names of the d components; with several vehicles those of each in turn, such as ``vehicle_1/jerk``.
    objectives: tuple[str, ...]
    returns: NDArray[np.float64]  #: (K, d) mean undiscounted return of each policy
    #: (K, d) ends of the 95% bootstrap intervals of ``returns``; equal to ``returns`` where all episodes are the same,
    #: and with fewer than three episodes, too few for an interval.
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    #: (K, d) mean return discounted with ``gamma``, by which dominance and indicators are determined.
    discounted: NDArray[np.float64]
    #: (K,) share of the episodes in which every vehicle reached its goal; NaN where the environment does not say.
    success: NDArray[np.float64]
    length: NDArray[np.float64]  #: (K,) mean number of decisions, of the vehicle that takes longest
    #: (K, m) what the algorithm's network is conditioned on to give each policy: PCN's command, another algorithm's
    #: weights; m may be 0.
    conditions: NDArray[np.float64]
    condition_names: tuple[str, ...]  #: names of the m columns
    gamma: float  #: discount factor of ``discounted``
    episodes: int  #: number of episodes per policy
    seed: int  #: seed of the first episode

    @classmethod
    def of_episodes(
        cls,
        objectives: Sequence[str],
        returns: ArrayLike,
        discounted: ArrayLike,
        lengths: ArrayLike,
        succeeded: ArrayLike | None,
        conditions: ArrayLike | None = None,
        condition_names: Sequence[str] = (),
        *,
        gamma: float,
        seed: int,
    ) -> Front:
        """The means and intervals of K policies over E episodes each.

        The arrays are (K, E, d) returns, (K, E) lengths and successes, None where the environment does not say, and
        (K, m) conditions, None if there are none.
        """
        returns = np.asarray(returns, dtype=np.float64)
        k, e, _ = returns.shape
        mean = returns.mean(axis=1)
        low, high = bootstrap(returns.swapaxes(0, 1)) if e >= MIN_SAMPLES else (mean.copy(), mean.copy())
        return cls(
            objectives=tuple(objectives),
            returns=mean,
            low=low,
            high=high,
            discounted=np.asarray(discounted, dtype=np.float64).mean(axis=1),
            success=np.full(k, np.nan) if succeeded is None else np.asarray(succeeded, dtype=np.float64).mean(axis=1),
            length=np.asarray(lengths, dtype=np.float64).mean(axis=1),
            conditions=np.zeros((k, 0)) if conditions is None else np.asarray(conditions, dtype=np.float64),
            condition_names=tuple(condition_names),
            gamma=gamma,
            episodes=e,
            seed=seed,
        )

    @classmethod
    def of_evaluations(
        cls,
        evaluations: Sequence[Evaluation],
        conditions: ArrayLike | None = None,
        condition_names: Sequence[str] = (),
        *,
        gamma: float,
        seed: int,
    ) -> Front:
        """The front of K policies evaluated on the same seeds; arguments as of :meth:`of_episodes`.

        With V vehicles it has the V d objectives of all of them, and an episode succeeds if all arrive.
        """
        returns, discounted, lengths, succeeded = (
            np.stack([getattr(evaluation, f"joint_{name}") for evaluation in evaluations])
            for name in ("returns", "discounted", "lengths", "succeeded")
        )
        objectives = joint_objectives(evaluations[0].objectives, evaluations[0].returns.shape[1])
        said = succeeded.any() or any(end is not None for evaluation in evaluations for end in evaluation.ends.flat)
        episodes = objectives, returns, discounted, lengths, succeeded if said else None
        return cls.of_episodes(*episodes, conditions, condition_names, gamma=gamma, seed=seed)

    def __len__(self) -> int:
        return len(self.returns)

    def is_arrival_rate(self, i: int) -> bool:
        """Whether the return of objective ``i`` is the arrival rate, as that of ``destination`` is."""
        return self.objectives[i] == "destination" and bool(np.allclose(self.returns[:, i], self.success))

    def take(self, indices: ArrayLike) -> Front:
        """The policies at ``indices`` (or under a mask), in this order."""
        rows = np.asarray(indices)
        names = ("returns", "low", "high", "discounted", "success", "length", "conditions")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def non_dominated(self) -> Front:
        """The policies that no other dominates, in increasing order of the discounted return of the first objective."""
        kept = self.take(np.flatnonzero(non_dominated(self.discounted)))
        return kept.take(np.argsort(kept.discounted[:, 0], kind="stable"))

    def rows(self) -> list[dict[str, float]]:
        """One mapping per policy, from the columns of ``front.csv`` to its numbers."""
        return [dict(zip(self._columns(), row, strict=True)) for row in self._table().tolist()]

    def _columns(self) -> list[str]:
        per_objective = [
            f"{prefix}{name}{end}"
            for prefix, end in ((RETURN, ""), (RETURN, "/low"), (RETURN, "/high"), (DISCOUNTED_RETURN, ""))
            for name in self.objectives
        ]
        return ["policy", SUCCESS, LENGTH, *per_objective, *(CONDITION + name for name in self.condition_names)]

    def _table(self) -> NDArray[np.float64]:
        blocks = (self.returns, self.low, self.high, self.discounted, self.conditions)
        return np.column_stack([np.arange(len(self)), self.success, self.length, *blocks])

    def write(self, directory: str | Path, about: Mapping[str, Any]) -> None:
        """Write ``front.csv``, one row per policy, and ``evaluation.json``: how they were evaluated, and ``about``.

        A file that is a link is a ValueError; each file is complete or unchanged.
        """
        rows: list[list[Any]] = [self._columns(), *([int(row[0]), *row[1:]] for row in self._table().tolist())]
        directory = Path(directory)
        atomic_write(own_path(directory, FRONT_FILE), csv_bytes(rows))
        how = {"gamma": self.gamma, "episodes": self.episodes, "seed": self.seed, "objectives": list(self.objectives)}
        write_json(own_path(directory, EVALUATION_FILE), {**about, **how})

    @classmethod
    def read(cls, directory: str | Path) -> Front:
        """The front that :meth:`write` wrote into ``directory``; a ValueError if there is none, or a file is broken."""
        path = Path(directory) / FRONT_FILE
        try:
            about = json.loads((Path(directory) / EVALUATION_FILE).read_text())
            with path.open(newline="") as file:
                header, *rows = csv.reader(file)
            if not rows:
                raise ValueError(f"{FRONT_FILE} has no policy")
            if len(set(header)) < len(header):
                raise ValueError(f"{FRONT_FILE} has two columns of the same name")
            columns = dict(zip(header, np.array(rows, dtype=np.float64).reshape(len(rows), -1).T, strict=True))
            objectives = tuple(about["objectives"])
            names = tuple(name.removeprefix(CONDITION) for name in header if name.startswith(CONDITION))

            def block(prefix: str, of: tuple[str, ...], end: str = "") -> NDArray[np.float64]:
                return np.stack([columns[f"{prefix}{name}{end}"] for name in of], axis=1)

            front = cls(
                objectives=objectives,
                returns=block(RETURN, objectives),
                low=block(RETURN, objectives, "/low"),
                high=block(RETURN, objectives, "/high"),
                discounted=block(DISCOUNTED_RETURN, objectives),
                success=columns[SUCCESS],
                length=columns[LENGTH],
                conditions=block(CONDITION, names) if names else np.zeros((len(rows), 0)),
                condition_names=names,
                gamma=float(about["gamma"]),
                episodes=int(about["episodes"]),
                seed=int(about["seed"]),
            )
            front._check()
            return front
        except FileNotFoundError as error:
            raise ValueError(f"{str(directory)!r} holds no front: there is no {Path(error.filename).name}") from None
        except (OSError, LookupError, ArithmeticError, TypeError, ValueError, RecursionError, csv.Error) as error:
            raise ValueError(f"the front in {str(directory)!r} is broken: {type(error).__name__}: {error}") from None

    def _check(self) -> None:
        """Refuse numbers that no evaluation gives."""
        allowed = dict.fromkeys(self._columns(), (-LARGEST, LARGEST))
        allowed |= {SUCCESS: (0.0, 1.0), LENGTH: (1.0, LARGEST)}
        for name, column in zip(self._columns(), self._table().T, strict=True):
            low, high = allowed[name]
            wrong = ~((column >= low) & (column <= high))
            if name == SUCCESS:
                wrong &= ~np.isnan(column)
            if wrong.any():
                raise ValueError(f"{name} = {column[wrong][0]:g} must be between {low:g} and {high:g}")
        for name, value, low, high in (
            ("gamma", self.gamma, 0.0, 1.0),
            ("episodes", self.episodes, 1, LARGEST),
            ("seed", self.seed, 0, LARGEST),
        ):
            if not low <= value <= high:
                raise ValueError(f"{name} = {value:g} must be between {low:g} and {high:g}")


def indicators(
    returns: ArrayLike,
    *,
    reference_point: ArrayLike | None = None,
    reference_front: ArrayLike | None = None,
    scales: ArrayLike | None = None,
) -> dict[str, float]:
    """All indicators of the non-dominated ones among ``returns`` (n, d), maximised, by name.

    ``hypervolume`` needs the reference point (d,), and is 0 where no point dominates it; ``igd_plus`` and
    ``additive_epsilon`` need the reference front (k, d); ``cardinality`` and ``expected_utility`` are always given. The
    scales (d,) are nominal sizes of the objectives' returns, 1 if None. A ValueError for anything of the wrong width,
    empty or not finite.
    """
    points = finite_points(returns, "front")
    points = points[non_dominated(points)]
    d = points.shape[1]
    measured: dict[str, float] = {CARDINALITY: float(len(points))}
    if reference_point is not None:
        measured[HYPERVOLUME] = hypervolume(points, reference_point)
    measured[EXPECTED_UTILITY] = expected_utility(points, evenly_spaced_weights(d, max(WEIGHTS, d)), scales)
    if reference_front is not None:
        measured[IGD_PLUS] = igd_plus(points, reference_front, scales)
        measured[ADDITIVE_EPSILON] = additive_epsilon(points, reference_front, scales)
    return measured


def measure_front(
    front: Front, *, reference_point: ArrayLike | None, reference_front: ArrayLike | None, scales: ArrayLike | None
) -> dict[str, float]:
    """:func:`indicators` of the discounted returns of a front, and the share of episodes that arrived, if known."""
    measured = indicators(
        front.discounted, reference_point=reference_point, reference_front=reference_front, scales=scales
    )
    if np.isfinite(front.success).all():
        measured[SUCCESS] = float(front.success.mean())
    return measured


def best_known_front(env: VectorEnv, gamma: float) -> NDArray[np.float64] | None:
    """The (k, d) best-known returns of an environment, discounted with ``gamma``; None if it knows none."""
    inner: Any = env.unwrapped
    if not hasattr(inner, "pareto_front"):
        inner = getattr(inner, "envs", [None])[0]
        inner = getattr(inner, "unwrapped", None)
    if not hasattr(inner, "pareto_front"):
        return None
    try:
        return np.array(inner.pareto_front(gamma), dtype=np.float64)
    except ValueError:  # from ours, where no front is known for their configuration
        return None


def check_reference_point(point: Sequence[float] | None, objectives: Sequence[str]) -> None:
    """Refuse a reference point of an experiment's hypervolume that does not have one number per objective."""
    if point is not None and len(point) != len(objectives):
        raise ValueError(f"evaluation.reference_point = {point} needs {len(objectives)} numbers: {tuple(objectives)}")
