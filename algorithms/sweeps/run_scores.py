"""Scores of single runs, read from their directories: the objective of a search and the final report to Ray Tune."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from algorithms.common.metrics_file import read_metrics
from algorithms.experiments.run_directory import read_status
from mo_deepdrive.config import nearest

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from algorithms.experiments.jobs import Job

T = TypeVar("T")


def final_metrics(path: Path) -> dict[str, float]:
    """The final evaluation of the run in ``path`` by metric, such as "greedy/utility_esr"; empty if there is none."""
    file = path / "evaluation.json"
    if not file.is_file():
        return {}
    policies = json.loads(file.read_text())["policies"]
    return {
        f"{policy}/{name}": estimate["value"]
        for policy, summary in policies.items()
        for name, estimate in summary.items()
    }


def read_scores(jobs: Sequence[Job], metric: str) -> dict[str, float | None]:
    """The value of a metric for every run that has ended, by run id; None if it is not finite.

    For a pruned run this is the value of its last evaluation.

    Raises:
        ValueError: if a run does not have the metric.
    """
    scores: dict[str, float | None] = {}
    for job in jobs:
        assert job.id is not None
        state = read_status(job.path).get("state")
        if state == "finished":
            value = _lookup(final_metrics(job.path), metric)
            scores[job.id] = value if np.isfinite(value) else None
        elif state == "pruned":
            column = _lookup(read_metrics(job.path / "metrics.csv"), f"eval/{metric}")
            known = column[np.isfinite(column)]
            scores[job.id] = float(known[-1]) if len(known) else None
    return scores


def _lookup(metrics: Mapping[str, T], metric: str) -> T:
    if metric not in metrics:
        raise ValueError(f"metric {metric!r} is not a metric of the runs; {nearest(metric, metrics)}")
    return metrics[metric]
