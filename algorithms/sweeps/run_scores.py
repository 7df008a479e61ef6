"""Scores of the runs of a hyperparameter search, read from their directories."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from algorithms.common.metrics_file import read_metrics
from algorithms.experiments.run_directory import read_status
from algorithms.experiments.run_files import changed_files
from algorithms.reporting.seed_tables import final_metrics
from mo_deepdrive.evaluation.front import EVALUATION_FILE
from mo_deepdrive.evaluation.metrics import EVALUATION, known_metric

if TYPE_CHECKING:
    from collections.abc import Sequence

    from algorithms.experiments.jobs import Job


def read_scores(jobs: Sequence[Job], metric: str) -> dict[str, float | None]:
    """The value of a metric for every run that has ended, by run id; None if it is not finite.

    For a pruned run this is the value of its last evaluation.

    Raises:
        ValueError: if a run does not have the metric, or its final evaluation has changed since.
    """
    scores: dict[str, float | None] = {}
    for job in jobs:
        assert job.id is not None
        state = read_status(job.path).get("state")
        if state == "finished":
            broken = changed_files(job.path, [EVALUATION_FILE])
            if broken:
                raise ValueError(f"the search cannot use {job.path}: {broken[0]}; --remake makes it again")
            final = final_metrics(job.path)
            value = final[known_metric(metric, final)]
            scores[job.id] = value if np.isfinite(value) else None
        elif state == "pruned":
            columns = read_metrics(job.path / "metrics.csv")
            column = columns[known_metric(EVALUATION + metric, columns)]
            known = column[np.isfinite(column)]
            scores[job.id] = float(known[-1]) if len(known) else None
    return scores
