"""Scores of the runs of a hyperparameter search, read from their directories."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import numpy as np

from algorithms.reporting.run_records import final_metrics
from algorithms.reporting.training_log import read_metrics
from algorithms.runs.run_directory import METRICS_FILE, read_status
from algorithms.runs.run_files import changed_files
from mo_deepdrive.evaluation.front import EVALUATION_FILE
from mo_deepdrive.evaluation.metrics import EVALUATION, known_metric

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from algorithms.runs.jobs import Job


T = TypeVar("T")


def read_scores(jobs: Sequence[Job], metric: str) -> dict[str, float | None]:
    """The value of a metric for every run that has ended, by run id.

    For a pruned run this is the value of its last evaluation; None if it has none.

    Raises:
        ValueError: if a run does not have the metric, or its results have changed since or cannot be read.
    """
    scores: dict[str, float | None] = {}
    for job in jobs:
        assert job.id is not None
        state = read_status(job.path).get("state")
        if state == "finished":
            broken = changed_files(job.path, [EVALUATION_FILE])
            if broken:
                raise ValueError(f"the search cannot use {job.path}: {broken[0]}; --remake makes it again")
            final = _read(job, final_metrics)
            value = final[known_metric(metric, final)]
            scores[job.id] = value if np.isfinite(value) else None
        elif state == "pruned":
            columns = _read(job, lambda path: read_metrics(path / METRICS_FILE))
            column = columns[known_metric(EVALUATION + metric, columns)]
            known = column[np.isfinite(column)]
            scores[job.id] = float(known[-1]) if len(known) else None
    return scores


def _read(job: Job, read: Callable[[Path], T]) -> T:
    """What ``read`` finds in the directory of a run.

    Raises:
        ValueError: with what to do, because a search that leaves a run out would go another way.
    """
    try:
        return read(job.path)
    except ValueError as error:
        raise ValueError(f"the search cannot use {job.path}: {error}; delete it, and it is made again") from None
