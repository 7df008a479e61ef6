"""Train the runs of a study, the tuning of every arm before the runs that count, and write its tables."""

from __future__ import annotations

from typing import TYPE_CHECKING

from algorithms.reporting.tables import print_rows
from algorithms.runs.run_directory import is_run
from algorithms.studies.execution import Runner
from algorithms.studies.manifest import is_sweep
from algorithms.studies.plan import LEARNER, TASK, StudyPlan
from algorithms.studies.results import NOTE, RESULTS_FILE, TABLES_FILE, write_results
from algorithms.studies.settings import ELSEWHERE, learners_in
from algorithms.studies.sweep_settings import replaced_keys

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rich.console import Console

    from algorithms.studies.backends import Backend
    from algorithms.studies.manifest import ManifestRow, Scores
    from algorithms.studies.plan import ArmRuns


class StudyRunner(Runner):
    """Trains the runs of a study in a directory like a sweep's.

    Args:
        plan: the arms of the study.
        directory: has the manifest and the run directories.
        backend: what trains the runs.
        console: shows the progress.
        train: whether to train what is missing; else the tables are written of what there is.
    """

    def __init__(self, plan: StudyPlan, directory: Path, backend: Backend, console: Console, *, train: bool = True):
        super().__init__(plan.study, directory, backend, console)
        self._plan = plan
        self._train_missing = train
        self._metrics = {arm.key: arm.metric for arm in plan.arms}

    def expand(self, scores: Scores) -> list[ManifestRow]:
        """As of the base class: of the arms that were selected, and what the manifest has of others."""
        listed = {row.id for row in self._listed()}
        return [row for row in self._plan.rows(scores) if self.wanted(row) or row.id in listed]

    def announcement(self) -> list[str]:
        """As of the base class."""
        study = self._plan.study
        configs = (learner.config for _, learner in learners_in(study) if learner.config is not None)
        return [*replaced_keys(configs, ELSEWHERE), self._plan.announcement()]

    def metric_of(self, row: ManifestRow) -> str | None:
        """As of the base class."""
        return None if row.trial is None else self._metrics.get(_arm(row))

    def settled(self, rows: Sequence[ManifestRow]) -> list[ManifestRow]:
        """The tuning of the arms that have runs that count."""
        chosen = {_arm(row) for row in rows if row.trial is None}
        return [row for row in rows if row.trial is not None and _arm(row) in chosen]

    def wanted(self, row: ManifestRow) -> bool:
        """As of the base class."""
        return _arm(row) in self._plan.selected

    def train(self) -> int:
        """Train as the base class does, with its exit codes and errors."""
        return super().run()

    def run(self) -> int:
        """As :meth:`train`; then write and print the tables."""
        code = 0
        if self._train_missing:
            code = self.train()
        elif not is_sweep(self._directory):
            raise ValueError(f"there is no study in {str(self._directory)!r} yet; leave out --tables to train its runs")
        if self._backend.name != "manifest":
            for table in write_results(self._plan, self.runs_of_arms(), self._directory):
                print_rows(self._console, table.rows, table.title, 1)
                self._console.print(table.to_cite, highlight=False)
            self._console.print(NOTE, highlight=False)
            self._say(f"written: {self._directory / RESULTS_FILE}, {self._directory / TABLES_FILE}")
        return code

    def runs_of_arms(self) -> list[ArmRuns]:
        """The runs of the arms that were selected, and of others that were begun before."""
        return [arm for arm in self._plan.runs(self.scores()) if arm.arm.key in self._plan.selected or self._begun(arm)]

    def _begun(self, arm: ArmRuns) -> bool:
        return any(is_run(self._directory / row.directory) for row in arm.rows)


def _arm(row: ManifestRow) -> tuple[str, str]:
    """Task and learner of a row."""
    return str(row.cell.get(TASK)), str(row.cell.get(LEARNER))
