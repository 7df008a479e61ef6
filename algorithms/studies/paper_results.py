"""The results of the reproduction: scores as rows of a study's results, and learning curves as a data frame."""

from __future__ import annotations

import gzip
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from algorithms.studies.results import frame_of
from mo_deepdrive.evaluation.metrics import STEP, STOCHASTIC, TOTAL_UTILITY_ESR, UTILITY_ESR
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
# The two algorithms that are compared, by their keys in the study.
BASELINE, MULTI_OBJECTIVE = "a2c", "mo_a2c"
LABELS = {BASELINE: "A2C", MULTI_OBJECTIVE: "MO-A2C"}
# The task with an unknown utility, and the learner of its front.
FRONT_TASK, FRONT_LEARNER = "one_waypoint_front", "pcn"


@dataclass(frozen=True)
class TaskResults:
    """The results of a task under one protocol; its scores and curves are those rows of :class:`PaperResults`."""

    study: Study
    key: str  # TASK/PROTOCOL
    scores: pl.DataFrame
    curves: pl.DataFrame

    @property
    def task(self) -> str:
        """The name of the task."""
        return self.key.partition("/")[0]

    @property
    def is_front(self) -> bool:
        """Whether the utility is unknown."""
        return self.task == FRONT_TASK

    @property
    def vehicles(self) -> int:
        """The number of learning vehicles."""
        return 2 if self.task.startswith("intersection") else 1

    @property
    def utility(self) -> str:
        """The metric for an episode's utility; with two vehicles it is the sum of their utilities."""
        return TOTAL_UTILITY_ESR if self.vehicles > 1 else UTILITY_ESR

    @property
    def utility_kind(self) -> str:
        """Either "linear" or "non-linear"."""
        return "non-linear" if self.task.endswith("nonlinear") else "linear"

    @property
    def titles(self) -> tuple[str, str]:
        """The titles of the task and of the protocol."""
        title, _, conditions = (self.study.tasks[self.key].title or "").partition(": ")
        return title, conditions

    @property
    def labels(self) -> dict[str, str]:
        """The labels of the learners with scores, by name."""
        scored = {*self.scores["learner"]}
        learners = self.study.learners_of(self.key)
        return {name: learner.label or name for name, learner in learners.items() if name in scored}

    @property
    def is_ablation(self) -> bool:
        """Whether it is neither a comparison of A2C and MO-A2C nor a run of PCN."""
        return set(self.study.learners_of(self.key)) not in ({*LABELS}, {FRONT_LEARNER})

    @property
    def steps(self) -> int:
        """The number of environment steps of a run."""
        return self.scores["steps"].cast(pl.Int64).max() or 0  # type: ignore[return-value]

    def by_seed(self, learner: str, metric: str, policy: str = STOCHASTIC) -> dict[int, float]:
        """The metric of every run of a learner, by its seed."""
        chosen = self.scores.filter(learner=learner, column=metric, policy=policy)
        return dict(chosen.select("seed", "value").iter_rows())

    def values(self, learner: str, metric: str, policy: str = STOCHASTIC) -> NDArray[np.float64]:
        """Values (seeds,) of a metric, one per run, in the order of seeds; KeyError if there are none."""
        by_seed = self.by_seed(learner, metric, policy)
        if not by_seed:
            raise KeyError(f"no run of {self.key}/{learner} has {metric!r} of the {policy} policy")
        return np.array([*by_seed.values()], dtype=np.float64)

    def learning_curves(self, learner: str) -> list[Columns]:
        """Learning curves of all runs of a learner, in the order of seeds."""
        runs = self.curves.filter(learner=learner).sort("seed", STEP).partition_by("seed", maintain_order=True)
        return [
            {
                name: column.to_numpy().astype(np.float64)
                for name, column in run.drop("task", "learner", "seed").to_dict().items()
                if column.null_count() < len(column)
            }
            for run in runs
        ]


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

    @cached_property
    def scores(self) -> pl.DataFrame:
        """The rows with a value, in the order of seeds."""
        return frame_of(self.rows).filter(pl.col("value").is_not_null()).sort("seed", maintain_order=True)

    @cached_property
    def tasks(self) -> dict[str, dict[str, TaskResults]]:
        """What has scores, by task and protocol, in the order of the study."""
        scored = self.scores.partition_by("task", as_dict=True)
        tasks: dict[str, dict[str, TaskResults]] = {}
        for key in (key for key in self.study.tasks if (key,) in scored):
            task, _, protocol = key.partition("/")
            results = TaskResults(self.study, key, scored[key,], self.curves.filter(task=key))
            tasks.setdefault(task, {})[protocol] = results
        return tasks

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
