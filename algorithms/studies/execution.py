"""Run a manifest: train its runs on a backend, batch after batch where scores decide which are next; verify them."""

from __future__ import annotations

import math
import shutil
import sys
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np

from algorithms.reporting.run_records import final_metrics
from algorithms.reporting.training_log import read_metrics
from algorithms.runs.console import print_line
from algorithms.runs.interrupts import Interrupts
from algorithms.runs.progress import Dashboard, count_states, summary_of
from algorithms.runs.run_directory import METRICS_FILE, RESULTS, changed_files, imported_paths, is_run, read_status
from algorithms.studies.manifest import ManifestRow, is_sweep, iterate_manifest, read_manifest, write_manifest
from mo_deepdrive.evaluation.front import EVALUATION_FILE
from mo_deepdrive.evaluation.metrics import EVALUATION, known_metric
from mo_deepdrive.support.atomic_io import own_path

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from rich.console import Console

    from algorithms.runs.jobs import Job
    from algorithms.studies.backends import Backend
    from algorithms.studies.manifest import Scores
    from algorithms.studies.sweep_settings import BackendSettings


class Runner(ABC):
    """Trains runs in a directory, which has their manifest; which runs may depend on the scores of others.

    Args:
        settings: of the backends.
        directory: has the manifest and the run directories.
        backend: what trains the runs.
        console: shows the progress.
    """

    def __init__(self, settings: BackendSettings, directory: Path, backend: Backend, console: Console):
        self._settings = settings
        self._directory = directory
        self._backend = backend
        self._console = console
        self._failed: dict[Job, str] = {}

    @abstractmethod
    def expand(self, scores: Scores) -> list[ManifestRow]:
        """The runs that are known by now: all of them, or those that ``scores`` suffice to choose."""

    @abstractmethod
    def metric_of(self, row: ManifestRow) -> str | None:
        """The metric of the final evaluation by which later runs are chosen; None for a run that chooses nothing."""

    @abstractmethod
    def settled(self, rows: Sequence[ManifestRow]) -> list[ManifestRow]:
        """Those rows by which others of them were chosen: they are not retried if they failed."""

    def announcement(self) -> list[str]:
        """What is said before anything is trained, one line each."""
        return []

    def wanted(self, row: ManifestRow) -> bool:
        """Whether a run of the manifest is to be trained now."""
        del row
        return True

    def _listed(self) -> Iterator[ManifestRow]:
        """The rows of the manifest in the directory; none if it has no manifest yet."""
        return iterate_manifest(self._directory) if is_sweep(self._directory) else iter(())

    def run(self) -> int:
        """Train all runs that are not done; with the backend "manifest", only list them.

        Returns:
            The exit code: 0 if all runs are done, or submitted without waiting; 1 if some failed; 128 plus the number
            of the signal that interrupted the sweep.

        Raises:
            ValueError: for an invalid sweep, or if the backend is not available.
            OSError: if the manifest cannot be written.
            Stopped: if the backend cannot continue, for example because the disk is full.
        """
        if self._backend.name == "manifest":
            rows = self._expand()
            for line in self.announcement():
                self._say(line)
            print(f"{write_manifest(self._directory, rows)}: {len(rows)} runs")
            return 0
        with Interrupts() as interrupts:
            jobs = self._train(lambda: interrupts.received is not None)
        self._say(Dashboard(jobs, self._console).summary())
        for job, error in self._failed.items():
            self._say(f"FAILED {job.name}: {error}\n  {job.path}")
        if interrupts.received is not None:
            print(f"interrupted; {self._backend.after_interrupt(self._directory)}", file=sys.stderr)
            return 128 + interrupts.received
        return 1 if self._failed else 0

    def remake(self) -> int:
        """Discard the finished runs whose files are broken, then :meth:`run`, which makes them again; its exit code."""
        self._check_manifest()
        for row, problems in verify(self._directory, self._say):
            discard(self._directory, row, problems)
        return self.run()

    def print_batch_script(self) -> int:
        """Print the batch script that would be submitted to Slurm; returns the exit code 0."""
        from algorithms.studies.slurm import MAX_ARRAY_TASKS, batch_script

        jobs = [row.job(self._directory) for row in self._expand() if self.wanted(row)]
        tasks = math.ceil(sum(not job.done for job in jobs) / self._settings.slurm.runs_per_job)
        print(batch_script(tasks, self._settings, self._directory) if tasks else "all runs are done")
        arrays = math.ceil(tasks / MAX_ARRAY_TASKS)
        if arrays > 1:
            print(
                f"{tasks} tasks are submitted as {arrays} job arrays of at most {MAX_ARRAY_TASKS} tasks; "
                "this is the script of the first",
                file=sys.stderr,
            )
        return 0

    def _expand(self) -> list[ManifestRow]:
        """The runs that are known by now."""
        if is_run(self._directory):
            raise ValueError(f"{str(self._directory)!r} is the directory of a run; choose another directory")
        expanded = self.expand(self.scores())
        self._refuse_other_sweep(expanded)
        return expanded

    def scores(self) -> dict[str, float | None]:
        """The scores by which runs are chosen, of the runs that have ended, by id; None for those that failed."""
        scores: dict[str, float | None] = {}
        if self._settings.adaptive and is_sweep(self._directory):
            self._check_manifest()  # the scores of another sweep may not have the metric
            rows = read_manifest(self._directory)
            for row in rows:
                if (metric := self.metric_of(row)) is not None:
                    scores |= read_score(row.id, self._directory / row.directory, metric)
            for row in self.settled(rows):
                status = read_status(self._directory / row.directory)
                if status.get("state") == "failed":
                    self._failed.setdefault(row.job(self._directory), str(status.get("reason")))
        return scores | {job.id: None for job in self._failed if job.id is not None}

    def _refuse_other_sweep(self, rows: Sequence[ManifestRow]) -> None:
        """Refuse a directory whose manifest has none of ``rows``; that of a sweep that was extended or cut has some."""
        before = {row.id: row.name for row in self._listed()}
        if before and before.keys().isdisjoint(row.id for row in rows):
            raise ValueError(
                f"{str(self._directory)!r} has another sweep: none of its {len(before)} runs, such as "
                f"{next(iter(before.values()))}, is in this one; choose another directory, or delete that sweep"
            )

    def _check_manifest(self) -> None:
        """Refuse a manifest of another sweep, or one that names code that this sweep does not, before it is opened."""
        rows = self.expand({})
        self._refuse_other_sweep(rows)
        known = {name for row in rows for name in imported_paths(row.config).values()}
        for row in iterate_manifest(self._directory):
            for key, name in imported_paths(row.config).items():
                if name not in known:
                    raise ValueError(
                        f"the manifest of {str(self._directory)!r} has {key} = {name!r}, code that this sweep does not "
                        "name; choose another directory, or delete that sweep"
                    )

    def _train(self, stop: Callable[[], bool]) -> list[Job]:
        """Train the runs, batch after batch of a search; returns all of them, whether they succeeded or not."""
        lines = self.announcement()
        while True:
            rows = self._expand()
            while lines:
                self._say(lines.pop(0))
            removed = len({row.id for row in self._listed()} - {row.id for row in rows})
            if removed:
                self._say(
                    f"{removed} runs of the previous manifest are no longer in the sweep; their directories are kept"
                )
            write_manifest(self._directory, rows)
            jobs = [row.job(self._directory) for row in rows if self.wanted(row)]
            open_jobs = [job for job in jobs if job not in self._failed and not job.done]
            if not open_jobs:
                return jobs
            self._say(f"{len(jobs)} runs, {len(jobs) - len(open_jobs)} of them done, in {self._directory}")
            with Dashboard(jobs, self._console, self._directory.name) as monitor:
                batch = [job for job in jobs if job not in self._failed]
                failed = self._backend.train(batch, self._settings, self._directory, monitor, stop)
            self._failed |= failed
            # Without waiting, failures may have been all that the next batch of a search was waiting for.
            if stop() or not self._settings.adaptive or not (self._backend.wait or failed):
                return jobs

    def _say(self, text: str) -> None:
        print_line(self._console, text)


def read_score(name: str, run: Path, metric: str) -> dict[str, float | None]:
    """The value of a metric of a run that has ended, by its id; empty for any other run.

    For a pruned run this is the value of its last evaluation; None if it has none.
    """
    state = read_status(run).get("state")
    if state not in ("finished", "pruned"):
        return {}
    if changed := changed_files(run, [EVALUATION_FILE]):
        raise ValueError(f"the search cannot use {run}: {changed[0]}; --remake makes it again")
    try:
        values = final_metrics(run) if state == "finished" else read_metrics(run / METRICS_FILE)
    except ValueError as error:
        raise ValueError(f"the search cannot use {run}: {error}; delete it, and it is made again") from None
    history = np.atleast_1d(values[known_metric(metric if state == "finished" else EVALUATION + metric, values)])
    known = history[np.isfinite(history)]
    return {name: float(known[-1]) if len(known) else None}


def verify(sweep: Path, say: Callable[[str], None]) -> list[tuple[ManifestRow, list[str]]]:
    """Compare all files of the finished runs of a sweep with their recorded sizes and hashes.

    Args:
        sweep: its directory.
        say: called with a line about each run that is broken, and with a summary.

    Returns:
        The broken runs, each with what is broken.
    """
    finished = [row for row in iterate_manifest(sweep) if read_status(sweep / row.directory).get("state") == "finished"]
    broken = []
    for row in finished:
        problems = changed_files(sweep / row.directory)
        if problems:
            broken.append((row, problems))
            say(f"{sweep / row.directory}: {'; '.join(problems)}")
    say(f"{len(finished)} finished runs: {len(broken)} broken")
    return broken


def discard(sweep: Path, row: ManifestRow, problems: list[str]) -> None:
    """Make a broken run one that is not finished, so that training the sweep makes it again.

    A run of which only the final evaluation is broken is evaluated again from its checkpoint; any other is deleted.

    Args:
        sweep: the directory of the sweep.
        row: of the run.
        problems: what is broken, from :func:`verify`.
    """
    directory = own_path(sweep, row.directory)
    if not {problem.partition(":")[0] for problem in problems} <= set(RESULTS):
        shutil.rmtree(directory)
        return
    run = row.job(sweep).open()
    run.lock()
    run.set_status("trained", run.status.get("step", 0))
    run.unlock()


def progress(sweep: Path) -> str:
    """How many runs of a sweep are done, running, failed and waiting."""
    return summary_of(count_states(read_status(sweep / row.directory).get("state") for row in iterate_manifest(sweep)))
