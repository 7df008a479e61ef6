"""The results of the reproduction as two tables: final scores and learning curves."""

from __future__ import annotations

import csv
import gzip
import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.reporting.run_records import LEFT_OUT, read_evaluation
from algorithms.reporting.training_log import read_metrics
from algorithms.runs.run_directory import METRICS_FILE, read_status
from mo_deepdrive.evaluation.front import Front
from mo_deepdrive.evaluation.metrics import (
    CARDINALITY,
    COLLISION,
    EXPECTED_UTILITY,
    FRONT,
    HIGHEST_DISTANCE,
    HYPERVOLUME,
    IGD_PLUS,
    LENGTH,
    LOWEST_DISTANCE,
    OFF_LANE,
    POLICIES,
    RETURN,
    STEP,
    STOCHASTIC,
    SUCCESS,
    TIME_LIMIT,
    TOTAL_UTILITY_ESR,
    UTILITY_ESR,
    UTILITY_SER,
    end_by,
    evaluation_prefix,
    return_of,
    split_name,
)
from mo_deepdrive.support.atomic_io import atomic_write, csv_bytes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from algorithms.reporting.run_records import EstimateRecord
    from algorithms.reporting.training_log import Columns
    from algorithms.studies.paper_plan import PlannedRun

SCORES_FILE, CURVES_FILE = "reproduction_scores.csv", "reproduction_curves.csv.gz"
KEYS = ("task", "protocol", "variant", "label", "seed", "steps", "seconds", "episodes", "first_episode", "policy")
# Of the final evaluation and of those during training, besides returns; with several vehicles also those of each.
METRICS = (UTILITY_ESR, UTILITY_SER, SUCCESS, end_by(COLLISION), end_by(OFF_LANE), end_by(TIME_LIMIT), LENGTH)
# Ending of the columns with the width of a score's interval over the episodes of the evaluation.
WIDTH = "_width"
FRONT_METRICS = (HYPERVOLUME, CARDINALITY, EXPECTED_UTILITY, IGD_PLUS)

ResultRow = dict[str, Any]


@dataclass(frozen=True)
class ReproductionResults:
    """Scores and learning curves of all runs.

    Attributes:
        scores: one row per run and policy, with KEYS and metrics; missing metrics have no entry. "first_episode" is the
            seed of the first of the "episodes" of the final evaluation.
        curves: one row per run and evaluation during training, with the KEYS that describe the run, "step", and metrics
            whose names start with the policy.
    """

    scores: list[ResultRow]
    curves: list[ResultRow]

    def values(
        self, task: str, protocol: str, variant: str, metric: str, policy: str = STOCHASTIC
    ) -> NDArray[np.float64]:
        """Values (seeds,) of a metric, one per run, in the order of seeds.

        Raises:
            KeyError: if no run has the metric.
        """
        where = (task, protocol, variant, policy)
        found = [
            (row["seed"], row[metric])
            for row in self.scores
            if (row["task"], row["protocol"], row["variant"], row["policy"]) == where and metric in row
        ]
        if not found:
            raise KeyError(f"no run of {task}/{protocol}/{variant} has {metric!r} of the {policy} policy")
        return np.array([value for _, value in sorted(found)], dtype=np.float64)

    def of_run(self, run: PlannedRun) -> dict[str, ResultRow]:
        """The scores of a run, by policy."""
        place = (run.task, run.protocol, run.variant, run.seed)
        return {
            row["policy"]: row
            for row in self.scores
            if (row["task"], row["protocol"], row["variant"], row["seed"]) == place
        }

    def episodes_width(self, task: str, protocol: str, variant: str, metric: str, policy: str = STOCHASTIC) -> float:
        """Mean over runs of the width of a score's interval over evaluation episodes; 0 if it is not known."""
        try:
            return float(self.values(task, protocol, variant, metric + WIDTH, policy).mean())
        except KeyError:
            return 0.0

    def learning_curves(self, task: str, protocol: str, variant: str) -> list[Columns]:
        """Learning curves of all runs of a variant, in the order of seeds."""
        by_seed: dict[int, list[ResultRow]] = {}
        for row in self.curves:
            if (row["task"], row["protocol"], row["variant"]) == (task, protocol, variant):
                by_seed.setdefault(row["seed"], []).append(row)
        found = []
        for _, rows in sorted(by_seed.items()):
            names = dict.fromkeys(name for row in rows for name in row if name not in KEYS)
            found.append({name: np.array([row.get(name, np.nan) for row in rows], dtype=np.float64) for name in names})
        return found

    def variants(self, task: str, protocol: str) -> dict[str, str]:
        """Labels of the variants with scores, by key."""
        return {
            row["variant"]: row["label"] for row in self.scores if (row["task"], row["protocol"]) == (task, protocol)
        }

    def protocols(self, task: str) -> list[str]:
        """Keys of the protocols with scores."""
        return list(dict.fromkeys(row["protocol"] for row in self.scores if row["task"] == task))

    def write(self, directory: Path) -> None:
        """Write both tables.

        Raises:
            OSError: if a file cannot be written; no file is left half written.
        """
        atomic_write(directory / SCORES_FILE, _csv(self.scores, KEYS))
        curve_keys = (*KEYS[: KEYS.index("seconds")], STEP)
        # Without name and time in the header, equal curves give equal bytes.
        atomic_write(directory / CURVES_FILE, gzip.compress(_csv(self.curves, curve_keys), mtime=0))

    @classmethod
    def read(cls, directory: Path) -> ReproductionResults:
        """Read both tables from the directory that :meth:`write` wrote to.

        Raises:
            ValueError: if a file is missing or broken.
        """
        try:
            scores = _read_csv((directory / SCORES_FILE).read_text())
            curves = _read_csv(gzip.decompress((directory / CURVES_FILE).read_bytes()).decode())
        except (OSError, EOFError, KeyError, ValueError) as error:
            raise ValueError(f"no results of a reproduction in {str(directory)!r}: {error}") from None
        return cls(scores, curves)


def gather(runs: Iterable[PlannedRun], warn: Callable[[str], None]) -> ReproductionResults:
    """The results of all finished runs.

    Args:
        runs: of the reproduction.
        warn: called with a line about every run that is left out because it cannot be read.
    """
    scores: list[ResultRow] = []
    curves: list[ResultRow] = []
    for run in runs:
        try:
            if run.job.done:
                of_run, evaluated = _results_of(run)
                scores += of_run
                curves += evaluated
        except ValueError as error:
            warn(f"{LEFT_OUT}{error}")
    return ReproductionResults(scores, curves)


def _results_of(run: PlannedRun) -> tuple[list[ResultRow], list[ResultRow]]:
    """The rows of a finished run in both tables.

    Raises:
        ValueError: naming the file that is missing or damaged.
    """
    path = run.job.path
    keys = {
        "task": run.task,
        "protocol": run.protocol,
        "variant": run.variant,
        "label": run.label,
        "seed": run.seed,
        "steps": run.job.experiment.training.total_timesteps,
    }
    evaluation = read_evaluation(path)
    if evaluation is None or evaluation.episodes is None or evaluation.seed is None:
        raise ValueError(f"run {str(path)!r} has no final evaluation with the number of episodes and their seed")
    seconds = float(read_status(path).get("seconds", 0.0))
    measured = {"seconds": seconds, "episodes": evaluation.episodes, "first_episode": evaluation.seed}
    scores = [
        {**keys, **measured, "policy": policy, **_final_scores(path, policy, estimates)}
        for policy, estimates in evaluation.policies.items()
    ]
    return scores, [{**keys, **row} for row in _learning_curve(path)]


def _final_scores(path: Path, policy: str, estimates: Mapping[str, EstimateRecord]) -> dict[str, float]:
    """The metrics of a policy in the final evaluation of the run in ``path``."""
    metrics = {name: each.value for name, each in estimates.items() if _is_kept(name)}
    metrics |= {name + WIDTH: _width(each) for name, each in estimates.items() if _is_shown(name)}
    if policy == FRONT:
        distances = _distances(Front.read(path))
        metrics |= {LOWEST_DISTANCE: float(distances.min()), HIGHEST_DISTANCE: float(distances.max())}
    return _with_total(metrics)


def _is_shown(name: str) -> bool:
    """Whether the report shows a metric, so that the width of its interval over episodes is kept."""
    return split_name(name).metric in (UTILITY_ESR, SUCCESS, end_by(COLLISION), return_of("distance"))


def _width(estimate: EstimateRecord) -> float:
    """The width of an interval of an evaluation.json; NaN if there is none."""
    return np.nan if estimate.low is None or estimate.high is None else estimate.high - estimate.low


def _distances(front: Front) -> NDArray[np.float64]:
    """The returns (n,) of the objective "distance"; NaN if there is none."""
    if "distance" not in front.objectives:
        return np.full(1, np.nan)
    return front.returns[:, front.objectives.index("distance")]


def _learning_curve(path: Path) -> list[ResultRow]:
    """The evaluations during training of the run in ``path``."""
    columns = read_metrics(path / METRICS_FILE)
    rows = []
    for policy in POLICIES:
        prefix = evaluation_prefix(policy)
        names = [name for name in columns if name.startswith(prefix) and _is_kept(name.removeprefix(prefix))]
        for i, step in enumerate(columns[STEP]):
            metrics = {name.removeprefix(prefix): float(columns[name][i]) for name in names}
            metrics = {name: value for name, value in metrics.items() if np.isfinite(value)}
            if metrics:
                inner = {f"{policy}/{name}": value for name, value in _with_total(metrics).items()}
                rows.append((int(step), inner))
    merged: dict[int, ResultRow] = {}
    for step, metrics in rows:
        merged.setdefault(step, {STEP: step}).update(metrics)
    return [merged[step] for step in sorted(merged)]


def _is_kept(name: str) -> bool:
    """Whether the tables have a metric."""
    metric = split_name(name).metric
    return metric in METRICS or metric in FRONT_METRICS or metric.startswith(RETURN)


def _with_total(metrics: dict[str, float]) -> dict[str, float]:
    """The metrics and, with several vehicles, the sum of their utilities; its interval is at most the sum of theirs."""
    parts = {name: split_name(name) for name in metrics}
    total = dict(metrics)
    for metric in (UTILITY_ESR, UTILITY_ESR + WIDTH):
        values = [metrics[name] for name, part in parts.items() if part.vehicle and part.metric == metric]
        if values:
            total[metric.replace(UTILITY_ESR, TOTAL_UTILITY_ESR)] = sum(values)
    return total


def _csv(rows: Sequence[ResultRow], keys: Sequence[str]) -> bytes:
    """``rows`` as CSV: ``keys`` first, then every metric of any row; numbers have seven significant digits."""
    names = [*keys, *dict.fromkeys(name for row in rows for name in row if name not in keys)]

    def formatted(value: Any) -> str:
        return f"{value:.7g}" if isinstance(value, float) else str(value)

    return csv_bytes([names, *([formatted(row.get(name, "")) for name in names] for row in rows)])


def _read_csv(text: str) -> list[ResultRow]:
    """The rows of a CSV that :func:`_csv` wrote.

    Raises:
        ValueError: if it has other columns, or values of the wrong type.
    """
    reader = csv.DictReader(io.StringIO(text))
    missing = {"task", "protocol", "variant", "seed"} - set(reader.fieldnames or ())
    if missing:
        raise ValueError(f"column {min(missing)!r} is missing")
    rows = []
    for line in reader:
        row: ResultRow = {}
        for name, value in line.items():
            if value == "":
                continue
            if name in ("seed", "steps", "episodes", "first_episode", STEP):
                row[name] = int(value)
            else:
                row[name] = value if name in KEYS and name != "seconds" else float(value)
        rows.append(row)
    return rows
