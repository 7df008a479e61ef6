"""What the runs of a reproduction gave, as two tables that are kept: final scores and learning curves."""

from __future__ import annotations

import csv
import gzip
import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from algorithms.common.atomic_io import atomic_write, csv_bytes
from algorithms.common.metrics_file import read_metrics
from algorithms.evaluation.front import Front
from algorithms.experiments.run_directory import Run
from algorithms.reporting.learning_curves import Columns
from algorithms.reproduction.plan import Entry

SCORES_FILE, CURVES_FILE = "reproduction_scores.csv", "reproduction_curves.csv.gz"
KEYS = ("cell", "arm", "variant", "label", "seed", "steps", "seconds", "policy")
# Of the final evaluation and of those on the way; with two vehicles each has its own, "vehicle_0/..." and so on.
METRICS = ("utility_esr", "utility_ser", "success", "end/collision", "end/off_lane", "end/time_limit", "length")
FRONT_METRICS = ("hypervolume", "cardinality", "expected_utility", "igd_plus")
# Sum of the utilities of all vehicles (the paper's figure 6), and the ends of a front's distances.
TOTAL_UTILITY, NEAREST, FARTHEST = "total_utility_esr", "lowest_distance", "highest_distance"
CURVE_POLICIES = ("greedy", "stochastic", "front")

Row = dict[str, Any]


@dataclass(frozen=True)
class Results:
    """Scores and curves of a reproduction.

    Attributes:
        scores: one row per run and policy: KEYS, then metrics; a metric that a run does not have is missing.
        curves: one row per run and evaluation on the way: KEYS without "seconds" and "policy", "step", and metrics
            whose names begin with the policy.
    """

    scores: list[Row]
    curves: list[Row]

    def values(self, cell: str, arm: str, variant: str, metric: str, policy: str = "stochastic") -> NDArray[np.float64]:
        """(seeds,) one number per run, in the order of the seeds.

        Raises:
            KeyError: if there are none.
        """
        where = (cell, arm, variant, policy)
        found = [
            (row["seed"], row[metric])
            for row in self.scores
            if (row["cell"], row["arm"], row["variant"], row["policy"]) == where and metric in row
        ]
        if not found:
            raise KeyError(f"no run of {cell}/{arm}/{variant} has {metric!r} of the {policy} policy")
        return np.array([value for _, value in sorted(found)], dtype=np.float64)

    def runs(self, cell: str, arm: str, variant: str) -> list[Columns]:
        """The curves of every run of a variant, in the order of the seeds."""
        by_seed: dict[int, list[Row]] = {}
        for row in self.curves:
            if (row["cell"], row["arm"], row["variant"]) == (cell, arm, variant):
                by_seed.setdefault(row["seed"], []).append(row)
        found = []
        for _, rows in sorted(by_seed.items()):
            names = dict.fromkeys(name for row in rows for name in row if name not in KEYS)
            found.append({name: np.array([row.get(name, np.nan) for row in rows], dtype=np.float64) for name in names})
        return found

    def variants(self, cell: str, arm: str) -> dict[str, str]:
        """Keys and labels of the variants that have scores."""
        return {row["variant"]: row["label"] for row in self.scores if (row["cell"], row["arm"]) == (cell, arm)}

    def arms(self, cell: str) -> list[str]:
        """Keys of the arms that have scores."""
        return list(dict.fromkeys(row["arm"] for row in self.scores if row["cell"] == cell))

    def write(self, directory: Path) -> None:
        """Write both tables.

        Raises:
            OSError: if a file cannot be written; each is whole or as it was.
        """
        atomic_write(directory / SCORES_FILE, _table(self.scores, KEYS))
        curve_keys = (*(key for key in KEYS if key not in ("seconds", "policy")), "step")
        # No name and no time in the header: the same curves are the same bytes.
        atomic_write(directory / CURVES_FILE, gzip.compress(_table(self.curves, curve_keys), mtime=0))

    @classmethod
    def read(cls, directory: Path) -> Results:
        """What :meth:`write` left.

        Raises:
            ValueError: if a file is missing or broken.
        """
        try:
            scores = _rows((directory / SCORES_FILE).read_text())
            curves = _rows(gzip.decompress((directory / CURVES_FILE).read_bytes()).decode())
        except (OSError, EOFError, KeyError, ValueError) as error:
            raise ValueError(f"no results of a reproduction in {str(directory)!r}: {error}") from None
        return cls(scores, curves)


def gather(entries: Iterable[Entry]) -> Results:
    """The results of finished runs; the others are passed over."""
    scores: list[Row] = []
    curves: list[Row] = []
    for entry in entries:
        if not entry.job.done:
            continue
        keys = {
            "cell": entry.cell,
            "arm": entry.arm,
            "variant": entry.variant,
            "label": entry.label,
            "seed": entry.seed,
            "steps": entry.job.experiment.training.total_timesteps,
        }
        seconds = float(Run.open(entry.job.path).status.get("seconds", 0.0))
        for policy, metrics in _final(entry.job.path).items():
            scores.append({**keys, "seconds": seconds, "policy": policy, **metrics})
        curves += [{**keys, **row} for row in _curve(entry.job.path)]
    return Results(scores, curves)


def _final(path: Path) -> dict[str, dict[str, float]]:
    """The numbers of the final evaluation per policy."""
    found = {}
    for policy, estimates in json.loads((path / "evaluation.json").read_text())["policies"].items():
        metrics = {name: float(each["value"]) for name, each in estimates.items() if _wanted(name)}
        if policy == "front":
            distances = _distances(Front.read(path))
            metrics |= {NEAREST: float(distances.min()), FARTHEST: float(distances.max())}
        found[policy] = _with_total(metrics)
    return found


def _distances(front: Front) -> NDArray[np.float64]:
    if "distance" not in front.objectives:
        return np.full(1, np.nan)
    return front.returns[:, front.objectives.index("distance")]


def _curve(path: Path) -> list[Row]:
    """The evaluations on the way."""
    columns = read_metrics(path / "metrics.csv")
    rows = []
    for policy in CURVE_POLICIES:
        prefix = f"eval/{policy}/"
        names = [name for name in columns if name.startswith(prefix) and _wanted(name.removeprefix(prefix))]
        for i, step in enumerate(columns["step"]):
            metrics = {name.removeprefix(prefix): float(columns[name][i]) for name in names}
            metrics = {name: value for name, value in metrics.items() if np.isfinite(value)}
            if metrics:
                inner = {f"{policy}/{name}": value for name, value in _with_total(metrics).items()}
                rows.append((int(step), inner))
    merged: dict[int, Row] = {}
    for step, metrics in rows:
        merged.setdefault(step, {"step": step}).update(metrics)
    return [merged[step] for step in sorted(merged)]


def _wanted(name: str) -> bool:
    vehicle, slash, rest = name.partition("/")
    plain = rest if slash and vehicle.startswith("vehicle_") else name
    return plain in METRICS or plain in FRONT_METRICS or plain.startswith("return/")


def _with_total(metrics: dict[str, float]) -> dict[str, float]:
    utilities = [
        value for name, value in metrics.items() if name.startswith("vehicle_") and name.endswith("/utility_esr")
    ]
    return {**metrics, TOTAL_UTILITY: sum(utilities)} if utilities else metrics


def _table(rows: Sequence[Row], keys: Sequence[str]) -> bytes:
    """A CSV of ``rows``: ``keys`` first, then every metric that some row has; numbers to seven digits."""
    names = [*keys, *dict.fromkeys(name for row in rows for name in row if name not in keys)]

    def cell(value: Any) -> str:
        return f"{value:.7g}" if isinstance(value, float) else str(value)

    return csv_bytes([names, *([cell(row.get(name, "")) for name in names] for row in rows)])


def _rows(text: str) -> list[Row]:
    """The rows of a CSV that :func:`_table` wrote."""
    rows = []
    for line in csv.DictReader(io.StringIO(text)):
        row: Row = {}
        for name, value in line.items():
            if value == "":
                continue
            if name in ("seed", "steps", "step"):
                row[name] = int(value)
            else:
                row[name] = value if name in KEYS and name != "seconds" else float(value)
        rows.append(row)
    return rows
