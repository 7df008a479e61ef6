"""The results of the reproduction: scores as rows of a study's results, and learning curves as a data frame."""

from __future__ import annotations

import gzip
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from mo_deepdrive.evaluation.metrics import STEP, STOCHASTIC
from mo_deepdrive.suite import read_rows, write_rows
from mo_deepdrive.support.atomic_io import atomic_write

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from algorithms.reporting.training_log import Columns
    from algorithms.studies.settings import Study
    from mo_deepdrive.suite import Row

SCORES_FILE, CURVES_FILE = "reproduction_scores.csv", "reproduction_curves.csv.gz"
CURVE_KEYS = {"task": pl.String, "learner": pl.String, "seed": pl.Int64, STEP: pl.Int64}


@dataclass(frozen=True)
class PaperResults:
    """Scores and learning curves of all runs.

    Attributes:
        study: of the paper.
        rows: of its results.
        curves: one row per run and evaluation during training: task, learner, seed, step, then metrics whose names
            start with the policy.
    """

    study: Study
    rows: Sequence[Row]
    curves: pl.DataFrame

    def by_seed(self, key: str, learner: str, metric: str, policy: str) -> dict[int, float]:
        """The metric of every run of a learner on a task, TASK/PROTOCOL, by its seed."""
        return {
            row.seed: row.value
            for row in sorted(self.rows, key=lambda row: row.seed)
            if (row.task, row.learner, row.column, row.policy) == (key, learner, metric, policy)
            and row.value is not None
        }

    def values(
        self, task: str, protocol: str, learner: str, metric: str, policy: str = STOCHASTIC
    ) -> NDArray[np.float64]:
        """Values (seeds,) of a metric, one per run, in the order of seeds."""
        by_seed = self.by_seed(f"{task}/{protocol}", learner, metric, policy)
        if not by_seed:
            raise KeyError(f"no run of {task}/{protocol}/{learner} has {metric!r} of the {policy} policy")
        return np.array([*by_seed.values()], dtype=np.float64)

    def learning_curves(self, task: str, protocol: str, learner: str) -> list[Columns]:
        """Learning curves of all runs of a learner, in the order of seeds."""
        mine = self.curves.filter(pl.col("task") == f"{task}/{protocol}", pl.col("learner") == learner)
        runs = mine.sort("seed", STEP).partition_by("seed", maintain_order=True)
        return [
            {
                name: column.to_numpy().astype(np.float64)
                for name, column in run.drop("task", "learner", "seed").to_dict().items()
                if column.null_count() < len(column)
            }
            for run in runs
        ]

    def protocols(self, task: str) -> list[str]:
        """The protocols of a task with scores."""
        scored = {row.task for row in self.rows if row.value is not None}
        places = (key.partition("/") for key in self.study.tasks if key in scored)
        return [protocol for name, _, protocol in places if name == task]

    def labels(self, task: str, protocol: str) -> dict[str, str]:
        """The labels of the learners with scores, by name."""
        key = f"{task}/{protocol}"
        scored = {row.learner for row in self.rows if row.task == key and row.value is not None}
        learners = self.study.learners_of(key)
        return {name: learner.label or name for name, learner in learners.items() if name in scored}

    def titles(self, task: str, protocol: str) -> tuple[str, str]:
        """The titles of a task and of its protocol."""
        title, _, conditions = (self.study.tasks[f"{task}/{protocol}"].title or "").partition(": ")
        return title, conditions

    def steps(self, task: str, protocol: str) -> int:
        """The number of environment steps of a run."""
        return max(row.steps or 0 for row in self.rows if row.task == f"{task}/{protocol}")

    def write(self, directory: Path) -> None:
        """Write both tables."""
        write_rows(directory / SCORES_FILE, self.rows)
        # Without name and time in the header, equal curves give equal bytes.
        atomic_write(directory / CURVES_FILE, gzip.compress(self.curves.write_csv().encode(), mtime=0))

    @classmethod
    def read(cls, study: Study, directory: Path) -> PaperResults:
        """Read both tables from the directory that :meth:`write` wrote to."""
        try:
            table = gzip.decompress((directory / CURVES_FILE).read_bytes())
            curves = pl.read_csv(table, infer_schema=False)
            metrics = pl.exclude(*CURVE_KEYS).cast(pl.Float64)
            curves = curves.with_columns(pl.col(name).cast(kind) for name, kind in CURVE_KEYS.items())
            return cls(study, read_rows(directory / SCORES_FILE), curves.with_columns(metrics))
        except (OSError, EOFError, ValueError, pl.exceptions.PolarsError) as error:
            raise ValueError(f"no results of a reproduction in {str(directory)!r}: {error}") from None
