"""Train the runs of a plan in a directory, batch after batch where scores decide which are next; verify them.

They are trained on this machine, on Ray (:mod:`.ray_tune`) or on Slurm (:mod:`.slurm`). What becomes of a run that ends
with an error is decided for all of them by :func:`algorithms.runs.jobs.verdict`.
"""

from __future__ import annotations

import math
import shutil
import sys
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from algorithms.reporting.run_records import final_metrics
from algorithms.reporting.training_log import read_metrics
from algorithms.runs.console import print_line
from algorithms.runs.interrupts import Interrupts
from algorithms.runs.progress import Dashboard, summary_of
from algorithms.runs.run_directory import METRICS_FILE, RESULTS, STATUS_FILE, changed_files, is_run, read_status
from algorithms.studies.manifest import Scores, is_sweep, read_manifest, write_manifest
from mo_deepdrive.evaluation.front import EVALUATION_FILE
from mo_deepdrive.evaluation.metrics import EVALUATION, known_metric
from mo_deepdrive.support.atomic_io import own_path, write_json
from mo_deepdrive.support.machine import GIB, available_cores, available_memory, check_memory

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from rich.console import Console

    from algorithms.runs.jobs import Job
    from algorithms.studies.manifest import ManifestRow
    from algorithms.studies.plan import Plan
    from algorithms.studies.settings import PlanSettings, Resources


WORKER_MEMORY = GIB / 4  # bytes of a process that trains, without its rollouts


@dataclass(frozen=True)
class Backend:
    """What trains runs."""

    name: str = "local"  # one of algorithms.studies.BACKENDS, "manifest" only to list them
    workers: int | None = None  # that are concurrent, locally and on Ray; None for as many as there are resources for
    address: str | None = None  # of a running Ray cluster
    wait: bool = True  # for the jobs that are submitted to Slurm

    def train(
        self, jobs: Sequence[Job], settings: PlanSettings, directory: Path, monitor: Dashboard, stop: Callable[[], bool]
    ) -> dict[Job, str]:
        """Train the runs that are not done; returns those that failed, each with its reason.

        All machines must see ``directory``, that of the sweep, under the same path. ``stop`` is called several times a
        second; once it returns True, what is under way is saved and this returns. A backend that cannot continue, for
        example because the disk is full, raises Stopped.
        """
        # What trains is imported now, because it takes seconds; Ray and submitit are optional dependencies, too.
        if self.name == "ray":
            from algorithms.studies.ray_tune import run_on_ray

            return run_on_ray(jobs, settings, directory, monitor, stop=stop, address=self.address, workers=self.workers)
        if self.name == "slurm":
            from algorithms.studies.slurm import run_on_slurm

            return run_on_slurm(jobs, settings, directory, monitor, stop=stop, wait=self.wait)
        from algorithms.runs.jobs import perform_all

        workers = self._local_workers([job for job in jobs if not job.done], settings.resources)
        return perform_all(jobs, workers, monitor, retries=settings.retries, stop=stop)

    def _local_workers(self, jobs: Sequence[Job], resources: Resources) -> int:
        """The number of worker processes: the given one, or as many as there are cores and memory for."""
        from algorithms.runs.build import training_memory

        if not jobs:  # another process has just finished the last one
            return 1
        smallest = min((job.experiment for job in jobs), key=lambda experiment: experiment.training.num_envs)
        num_envs = smallest.training.num_envs
        memory = WORKER_MEMORY + training_memory(smallest, num_envs)
        if self.workers is None:
            return max(1, int(min(available_cores() / resources.cpus, available_memory() / memory)))
        workers = min(self.workers, len(jobs))
        check_memory(f"--workers {workers} with training.num_envs = {num_envs}", workers * memory)
        return workers


class Runner(Scores):
    """Trains the runs of a plan; it knows the scores of those in its directory, by which the plan chooses others."""

    def __init__(self, plan: Plan, directory: Path, backend: Backend, console: Console):
        self._plan, self._directory = plan, directory
        self._backend, self._console = backend, console
        self._say = partial(print_line, console)
        self._failed: dict[Job, str] = {}
        self._listed = read_manifest(directory) if is_sweep(directory) else []

    def run(self) -> int:
        """Train all runs that are not done; with the backend "manifest", only list them.

        Returns the exit code: 0 if all runs are done, or submitted without waiting; 1 if some failed; 128 plus the
        number of the signal that interrupted the training.
        """
        if self._backend.name == "manifest":
            rows = self._begin()
            print(f"{write_manifest(self._directory, rows)}: {len(rows)} runs")
            return 0
        with Interrupts() as interrupts:
            jobs = self._train(lambda: interrupts.received is not None)
        self._say(Dashboard(jobs, self._console).summary())
        for job, error in self._failed.items():
            self._say(f"FAILED {job.name}: {error}\n  {job.path}")
        if interrupts.received is not None:
            hint = "the runs in progress are saved: the same command resumes them"
            if self._backend.name == "slurm":
                from algorithms.studies.slurm import after_interrupt

                hint = after_interrupt(self._directory)
            print(f"interrupted; {hint}", file=sys.stderr)
            return 128 + interrupts.received
        return 1 if self._failed else 0

    def remake(self) -> int:
        """Discard the broken files of finished runs, then :meth:`run`, which makes them again; its exit code."""
        self._check_directory()
        for row, problems in verify(self._directory, self._say):
            directory = own_path(self._directory, row.directory)
            if {problem.partition(":")[0] for problem in problems} <= {*RESULTS}:
                write_json(directory / STATUS_FILE, {**read_status(directory), "state": "trained"})
            else:
                shutil.rmtree(directory)
        return self.run()

    def print_batch_script(self) -> int:
        """Print the batch script that would be submitted to Slurm; returns the exit code 0."""
        from algorithms.studies.slurm import batch_script

        settings = self._plan.settings
        jobs = [row.job(self._directory) for row in self._expand() if self._plan.wanted(row)]
        tasks = math.ceil(sum(not job.done for job in jobs) / settings.slurm.runs_per_job)
        print(batch_script(tasks, settings, self._directory) if tasks else "all runs are done")
        return 0

    def of(self, row: ManifestRow, metric: str) -> float | None:
        """As of the base class, from the directory of the run."""
        return None if row.job(self._directory) in self._failed else read_score(self._directory / row.directory, metric)

    def settle(self, earlier: Sequence[ManifestRow], later: Sequence[ManifestRow]) -> bool:
        """As of the base class: runs that failed before count if those were made that were chosen without them."""
        statuses = {row.job(self._directory): read_status(self._directory / row.directory) for row in earlier}
        before = {job: str(status.get("reason")) for job, status in statuses.items() if status.get("state") == "failed"}
        settled = before.keys() <= self._failed.keys() or {row.id for row in later} <= {row.id for row in self._listed}
        if settled:
            self._failed = before | self._failed
        return settled

    def _begin(self) -> list[ManifestRow]:
        """The runs that are known at the beginning, after what is to be said before anything is trained."""
        rows = self._expand()
        for line in self._plan.announcement():
            self._say(line)
        return rows

    def _expand(self) -> list[ManifestRow]:
        """The runs that are known by now: of what is wanted, and what the manifest has of the rest."""
        self._check_directory()
        listed = {row.id for row in self._listed}
        return [row for row in self._plan.rows(self) if row.id in listed or self._plan.wanted(row)]

    def _check_directory(self) -> None:
        """Refuse the directory of a run, or one whose manifest has none of the runs with which the plan begins."""
        if is_run(self._directory):
            raise ValueError(f"{str(self._directory)!r} is the directory of a run; choose another directory")
        before = {row.id: row.name for row in self._listed}
        if before and before.keys().isdisjoint(row.id for row in self._plan.rows(Scores())):
            runs = f"none of its {len(before)} runs, such as {next(iter(before.values()))}, is in this one"
            hint = "choose another directory, or delete that sweep"
            raise ValueError(f"{str(self._directory)!r} has another sweep: {runs}; {hint}")

    def _train(self, stop: Callable[[], bool]) -> list[Job]:
        """Train the runs, batch after batch; returns all of them, whether they succeeded or not."""
        rows = self._begin()
        while True:
            if removed := len({row.id for row in self._listed} - {row.id for row in rows}):
                kept = "are no longer in the sweep; their directories are kept"
                self._say(f"{removed} runs of the previous manifest {kept}")
            write_manifest(self._directory, rows)
            self._listed = rows
            jobs = [row.job(self._directory) for row in rows if self._plan.wanted(row)]
            open_jobs = [job for job in jobs if job not in self._failed and not job.done]
            if not open_jobs:
                return jobs
            self._say(f"{len(jobs)} runs, {len(jobs) - len(open_jobs)} of them done, in {self._directory}")
            with Dashboard(jobs, self._console, self._directory.name) as monitor:
                batch = [job for job in jobs if job not in self._failed]
                failed = self._backend.train(batch, self._plan.settings, self._directory, monitor, stop)
            self._failed |= failed
            # Without waiting, failures may have been all that the next batch of a search was waiting for.
            if stop() or not self._plan.settings.adaptive or not (self._backend.wait or failed):
                return jobs
            rows = self._expand()


def read_score(run: Path, metric: str) -> float | None:
    """As :meth:`Scores.of`; of a run that was pruned the value of its last evaluation."""
    state = read_status(run).get("state")
    if state not in ("finished", "pruned"):
        return None if state == "failed" else math.nan
    if changed := changed_files(run, [EVALUATION_FILE]):
        raise ValueError(f"the search cannot use {run}: {changed[0]}; --remake makes it again")
    try:
        values = final_metrics(run) if state == "finished" else read_metrics(run / METRICS_FILE)
    except ValueError as error:
        raise ValueError(f"the search cannot use {run}: {error}; delete it, and it is made again") from None
    history = np.atleast_1d(values[known_metric(metric if state == "finished" else EVALUATION + metric, values)])
    known = history[np.isfinite(history)]
    return float(known[-1]) if len(known) else None


def verify(sweep: Path, say: Callable[[str], None]) -> list[tuple[ManifestRow, list[str]]]:
    """Compare the files of the finished runs with their recorded hashes; says and returns what is broken, by run."""
    finished = [row for row in read_manifest(sweep) if read_status(sweep / row.directory).get("state") == "finished"]
    broken = [(row, problems) for row in finished if (problems := changed_files(sweep / row.directory))]
    for row, problems in broken:
        say(f"{sweep / row.directory}: {'; '.join(problems)}")
    say(f"{len(finished)} finished runs: {len(broken)} broken")
    return broken


def progress(sweep: Path) -> str:
    """How many runs of a sweep are done, running, failed and waiting."""
    return summary_of(read_status(sweep / row.directory).get("state") for row in read_manifest(sweep))
