"""Run a sweep: write its manifest and train its runs on a backend, batch after batch of a hyperparameter search."""

from __future__ import annotations

import json
import math
import sys
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

from algorithms.runs.console import print_line
from algorithms.runs.dashboard import Dashboard, count_states, summary_of
from algorithms.runs.interrupts import Interrupts
from algorithms.runs.run_directory import imported_paths, is_run, read_status
from algorithms.studies.manifest import (
    ManifestRow,
    expand,
    is_sweep,
    iterate_manifest,
    read_manifest,
    write_manifest,
)
from algorithms.studies.run_scores import read_scores
from algorithms.studies.sweep_settings import SEED_KEYS, replaced_keys
from algorithms.studies.sweep_verification import discard, verify
from mo_deepdrive.support.machine import GIB, available_cores, available_memory, check_memory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from rich.console import Console

    from algorithms.runs.jobs import Job
    from algorithms.studies.hyperparameter_search import Scores
    from algorithms.studies.sweep_settings import BackendSettings, SweepSettings


WORKER_MEMORY = GIB / 4  # bytes of a process that trains, without its rollouts


@dataclass(frozen=True)
class Backend:
    """What trains the runs of a sweep.

    Attributes:
        name: "local" for worker processes on this machine, "ray", "slurm", or "manifest" to only write the manifest.
        workers: maximum number of concurrent runs (local, Ray); None for as many as there are cores or resources for.
        address: of a running Ray cluster, or "auto"; None starts Ray in this process.
        wait: whether to wait for the jobs after submitting them (Slurm).
    """

    name: str = "local"
    workers: int | None = None
    address: str | None = None
    wait: bool = True


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
        """The runs that are known by now: all of them, or those that ``scores`` suffice to choose.

        Raises:
            ValueError: naming what is invalid.
        """

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
        self._report(jobs)
        if interrupts.received is not None:
            print(f"interrupted; {self._after_interrupt()}", file=sys.stderr)
            return 128 + interrupts.received
        return 1 if self._failed else 0

    def remake(self) -> int:
        """Discard the finished runs whose files are broken, then :meth:`run`, which makes them again; its exit code.

        Raises:
            ValueError: if the directory has no manifest, or that of another sweep; this and other errors also as in
                :meth:`run`.
        """
        self._check_manifest()
        for row, problems in verify(self._directory, self._say):
            discard(self._directory, row, problems)
        return self.run()

    def print_batch_script(self) -> int:
        """Print the batch script that would be submitted to Slurm; returns the exit code 0.

        Raises:
            ValueError: for an invalid sweep.
        """
        from algorithms.studies.slurm import array_tasks
        from algorithms.studies.slurm_script import MAX_ARRAY_TASKS, batch_script

        jobs = [row.job(self._directory) for row in self._expand() if self.wanted(row)]
        missing = [job for job in jobs if not job.done]
        tasks = len(array_tasks(missing, self._settings))
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
        """The runs that are known by now.

        Raises:
            ValueError: for an invalid sweep, or the directory of a run or of another sweep.
        """
        if is_run(self._directory):
            raise ValueError(f"{str(self._directory)!r} is the directory of a run; choose another directory")
        expanded = self.expand(self.scores())
        self._refuse_other_sweep(expanded)
        return expanded

    def scores(self) -> dict[str, float | None]:
        """The scores by which runs are chosen, of the runs that have ended, by id; None for those that failed.

        Raises:
            ValueError: for the directory of another sweep, or scores that cannot be read.
        """
        scores: dict[str, float | None] = {}
        if self._settings.adaptive and is_sweep(self._directory):
            self._check_manifest()  # the scores of another sweep may not have the metric
            rows = read_manifest(self._directory)
            by_metric: dict[str, list[Job]] = {}
            for row in rows:
                if (metric := self.metric_of(row)) is not None:
                    by_metric.setdefault(metric, []).append(row.job(self._directory))
            for metric, jobs in by_metric.items():
                scores |= read_scores(jobs, metric)
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
            self._report_removed_runs(rows)
            write_manifest(self._directory, rows)
            jobs = [row.job(self._directory) for row in rows if self.wanted(row)]
            open_jobs = [job for job in jobs if job not in self._failed and not job.done]
            if not open_jobs:
                return jobs
            self._say(f"{len(jobs)} runs, {len(jobs) - len(open_jobs)} of them done, in {self._directory}")
            with Dashboard(jobs, self._console, self._directory.name) as monitor:
                failed = self._train_batch([job for job in jobs if job not in self._failed], monitor, stop)
            self._failed |= failed
            # Without waiting, failures may have been all that the next batch of a search was waiting for.
            if stop() or not self._settings.adaptive or not (self._backend.wait or failed):
                return jobs

    def _train_batch(self, jobs: Sequence[Job], monitor: Dashboard, stop: Callable[[], bool]) -> dict[Job, str]:
        """Train the runs on the backend; returns those that failed, each with its reason."""
        backend, settings = self._backend, self._settings
        # What trains is imported now, because it takes seconds; Ray and submitit are optional dependencies, too.
        if backend.name == "local":
            from algorithms.runs.worker_pool import perform_all

            workers = self._local_workers([job for job in jobs if not job.done])
            return perform_all(jobs, workers, monitor, retries=settings.retries, stop=stop)
        if backend.name == "ray":
            from algorithms.studies.ray_tune import run_on_ray

            return run_on_ray(
                jobs,
                settings,
                self._directory,
                monitor,
                stop=stop,
                address=backend.address,
                workers=backend.workers,
            )
        from algorithms.studies.slurm import run_on_slurm

        return run_on_slurm(jobs, settings, self._directory, monitor, stop=stop, wait=backend.wait)

    def _local_workers(self, jobs: Sequence[Job]) -> int:
        """The number of workers: the given one, or as many as there are cores and memory for.

        Raises:
            ValueError: if the given ones take more memory than there is.
        """
        from algorithms.runs.build import training_memory

        if not jobs:  # another process has just finished the last one
            return 1
        smallest = min((job.experiment for job in jobs), key=lambda experiment: experiment.training.num_envs)
        num_envs = smallest.training.num_envs
        each = WORKER_MEMORY + training_memory(smallest, num_envs)
        if self._backend.workers is not None:
            workers = min(self._backend.workers, len(jobs))
            check_memory(f"--workers {workers} with training.num_envs = {num_envs}", workers * each)
            return workers
        cores = available_cores() / self._settings.resources.cpus
        return max(1, math.floor(min(cores, available_memory() / each)))

    def _report_removed_runs(self, rows: Sequence[ManifestRow]) -> None:
        """Tell the user about runs of the previous manifest that the sweep no longer has."""
        removed = len({row.id for row in self._listed()} - {row.id for row in rows})
        if removed:
            self._say(f"{removed} runs of the previous manifest are no longer in the sweep; their directories are kept")

    def _report(self, jobs: Sequence[Job]) -> None:
        """Print a summary of the runs, and the reasons of failures."""
        self._say(Dashboard(jobs, self._console).summary())
        for job, error in self._failed.items():
            self._say(f"FAILED {job.name}: {error}\n  {job.path}")

    def _after_interrupt(self) -> str:
        """What the user can do after an interrupt."""
        if self._backend.name != "slurm":
            return "the runs in progress are saved: the same command resumes them"
        from algorithms.studies.slurm import SlurmQueue

        queue = SlurmQueue(self._directory)
        queue.refresh()
        cancel = queue.cancel_command()
        if cancel is None:
            return "no job is in Slurm's queue: the same command submits the runs that are not done"
        return f"the jobs stay in Slurm's queue: the same command watches them again, `{cancel}` cancels them"

    def _say(self, text: str) -> None:
        print_line(self._console, text)


class SweepRunner(Runner):
    """Trains the runs of a sweep; those of a search batch after batch."""

    _settings: SweepSettings

    def expand(self, scores: Scores) -> list[ManifestRow]:
        """As of the base class."""
        return expand(self._settings, scores)

    def announcement(self) -> list[str]:
        """As of the base class: all runs of a search, of which the manifest has one batch."""
        search, settings = self._settings.search, self._settings
        lines = replaced_keys(settings.config, SEED_KEYS)
        if search is not None:
            cells = len(settings.config) * math.prod(map(len, settings.grid.values()))
            runs = cells * search.trials * len(settings.seeds)
            lines.append(f"at most {runs} runs: {cells} searches of {search.trials} points, with every seed")
        return lines

    def metric_of(self, row: ManifestRow) -> str | None:
        """As of the base class."""
        del row
        return None if self._settings.search is None else self._settings.search.metric

    def settled(self, rows: Sequence[ManifestRow]) -> list[ManifestRow]:
        """The runs of a cell's earlier batches: its later ones were chosen with their failures."""
        search = self._settings.search
        assert search is not None
        cells = [json.dumps({key: row.cell[key] for key in row.cell if key not in search.space}) for row in rows]
        batches = [(row.trial or 0) // search.points_at_a_time for row in rows]
        last: dict[str, int] = {}  # every cell of the grid has a search of its own
        for cell, batch in zip(cells, batches, strict=True):
            last[cell] = max(batch, last.get(cell, 0))
        return [row for row, cell, batch in zip(rows, cells, batches, strict=True) if batch < last[cell]]


def show_status(directory: Path, console: Console) -> None:
    """Print how many runs of the sweep in ``directory`` are done, running, failed and waiting.

    Raises:
        ValueError: if the directory has no manifest, or a broken one.
    """
    states = (read_status(directory / row.directory).get("state") for row in iterate_manifest(directory))
    print_line(console, summary_of(count_states(states)))


def show_broken(directory: Path, console: Console) -> int:
    """Print which finished runs of the sweep in ``directory`` are broken; the exit code, 1 if there are any.

    Raises:
        ValueError: if the directory has no manifest, or a broken one.
    """
    return int(bool(verify(directory, lambda line: print_line(console, line))))
