"""The Slurm backend: the batch script of a sweep, its submission as a job array through submitit, and its watch.

:func:`sbatch_options` is the place to change the batch script; submitit writes the text around the options. Print it
with ``mo-deepdrive sweep --config FILE --on slurm --dry-run``. For sweeps/one_waypoint it is::

    #!/bin/bash

    # Parameters
    #SBATCH --array=0-9%10
    #SBATCH --cpus-per-task=1
    #SBATCH --job-name=one_waypoint
    #SBATCH --mem=2048MB
    #SBATCH --nodes=1
    #SBATCH --open-mode=append
    #SBATCH --output=SWEEP/slurm/%A_%a_0_log.out
    #SBATCH --requeue
    #SBATCH --signal=USR2@90
    #SBATCH --time=30
    #SBATCH --wckey=submitit

    # command
    export SUBMITIT_EXECUTOR=slurm
    srun --unbuffered --output LOG --cpus-per-task=1 python -u -c '...; submitit_main()' SWEEP/slurm

Each task of the array unpickles and calls its :class:`ArrayTask`. Before the time limit, or when pre-empted, a task
saves its runs and requeues itself.
"""

from __future__ import annotations

import json
import math
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from concurrent import futures
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import submitit
from rich.console import Console

from algorithms.runs.console import WIDTH
from algorithms.runs.interrupts import Stopped
from algorithms.runs.jobs import WorkerDied, perform_all, record, verdict
from algorithms.runs.progress import Dashboard
from algorithms.runs.run_directory import read_status
from mo_deepdrive.support.atomic_io import own_path, write_json

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from algorithms.runs.jobs import Job
    from algorithms.studies.sweep_settings import BackendSettings

POLL = 5.0  # s between queries of the queue
JOBS_PER_QUERY = 500  # the length of a command line is limited
MAX_ARRAY_TASKS = 1000  # Slurm's default limit is 1001 (MaxArraySize)
# States of a Slurm job that will not run (again).
FINAL_STATES = (
    *("BOOT_FAIL", "CANCELLED", "COMPLETED", "DEADLINE", "FAILED", "NODE_FAIL"),
    *("OUT_OF_MEMORY", "PREEMPTED", "REVOKED", "TIMEOUT"),
)
# submitit's own command, `python -m submitit.core._submit`, looks for packages in the working directory first, and
# would take any package algorithms for ours.
START = (
    "import sys; sys.path = [*filter(None, sys.path), str()]; import mo_deepdrive.__main__; "
    "from submitit.core.submission import submitit_main; submitit_main()"
)


# ---------------------------------------------------------------------------------------------------- the batch script


class TaskExecutor(submitit.SlurmExecutor):
    """Starts tasks that look for packages in the working directory last, like the commands."""

    @property
    def _submitit_command_str(self) -> str:
        return shlex.join([sys.executable, "-u", "-c", START, str(self.folder)])

    @classmethod
    def affinity(cls) -> int:
        """Always available, because a dry run needs no Slurm; :func:`run_on_slurm` looks for it."""
        return 1


def slurm_folder(sweep: Path) -> Path:
    """Where the logs of the jobs and the ids of submitted jobs are."""
    return own_path(sweep.resolve(), "slurm")


def sbatch_options(settings: BackendSettings, name: str) -> dict[str, Any]:
    """The options of sbatch for each task of the array, under submitit's names.

    Args:
        settings: of the sweep; a task runs ``slurm.side_by_side`` runs at a time, with ``resources`` for each.
        name: of the job.
    """
    slurm, resources = settings.slurm, settings.resources
    cpus = max(1, math.ceil(resources.cpus * slurm.side_by_side))
    gpus = math.ceil(resources.gpus * slurm.side_by_side)
    memory = None if resources.memory_gb is None else math.ceil(1024 * resources.memory_gb * slurm.side_by_side)
    optional = {
        "partition": slurm.partition,
        "account": slurm.account,
        "qos": slurm.qos,
        "constraint": slurm.constraint,
        "gpus_per_node": gpus or None,
        "mem": None if memory is None else f"{memory}MB",
        "setup": slurm.setup or None,
    }
    return {
        "job_name": name,
        "time": resources.minutes,
        "cpus_per_task": cpus,
        "array_parallelism": slurm.array_parallelism,
        "signal_delay_s": slurm.signal_delay_s,
        "stderr_to_stdout": True,
        # Since Slurm 22.05, srun does not inherit --cpus-per-task from sbatch.
        "srun_args": [f"--cpus-per-task={cpus}"],
        "additional_parameters": {"requeue": True, **slurm.additional},
        **{key: value for key, value in optional.items() if value is not None},
    }


def make_executor(settings: BackendSettings, sweep: Path) -> TaskExecutor:
    """What writes and submits the batch script of a sweep."""
    executor = TaskExecutor(slurm_folder(sweep), max_num_timeout=settings.slurm.max_requeues)
    executor.update_parameters(**sbatch_options(settings, sweep.name))
    return executor


def batch_script(tasks: int, settings: BackendSettings, sweep: Path) -> str:
    """The text of the batch script for an array of ``tasks`` tasks, or for the first array if there are several."""
    executor = make_executor(settings, sweep)
    if tasks > 1:
        executor.parameters["map_count"] = min(MAX_ARRAY_TASKS, tasks)
    return executor._make_submission_file_text(executor._submitit_command_str, "")


# ------------------------------------------------------------------------------------------------- a task of the array


@dataclass
class ArrayTask:
    """What one task of the job array does: train some runs, which it carries: the manifest may change meanwhile.

    On SIGUSR2, which submitit handles and Slurm sends before the time limit, and on SIGTERM, which Slurm sends on
    pre-emption, it saves its runs and requeues itself. When it starts again, the runs resume from their directories.

    Attributes:
        jobs: the runs.
        side_by_side: number of concurrent runs.
        retries: as in :func:`algorithms.runs.jobs.verdict`.
    """

    jobs: tuple[Job, ...]
    side_by_side: int
    retries: int
    _stop: threading.Event | None = field(default=None, init=False, repr=False)
    _training: futures.Future[dict[Job, str]] | None = field(default=None, init=False, repr=False)

    def __call__(self) -> list[str]:
        """Train the runs; returns the errors of those that failed."""
        stop = self._stop = threading.Event()
        # The main thread only handles signals, so that a handler can wait until the other thread has saved.
        signal.signal(signal.SIGTERM, lambda _number, _frame: stop.set())
        with futures.ThreadPoolExecutor(1) as pool:
            self._training = pool.submit(self._train, stop)
            while futures.wait([self._training], timeout=1.0).not_done:
                pass
        failed = self._training.result()
        if stop.is_set():
            job_id = submitit.JobEnvironment().job_id
            if _query_states([job_id]) == {job_id: "RUNNING"}:  # it has not been cancelled
                subprocess.run(["scontrol", "requeue", job_id], check=True)
        return [f"{job.name}: {error}" for job, error in failed.items()]

    def _train(self, stop: threading.Event) -> dict[Job, str]:
        with Dashboard(self.jobs, Console(width=WIDTH), "this job") as monitor:
            return perform_all(self.jobs, self.side_by_side, monitor, retries=self.retries, stop=stop.is_set)

    def checkpoint(self) -> submitit.helpers.DelayedSubmission:
        """Save the runs, and ask to be submitted again; called by submitit's signal handler."""
        if self._stop is not None and self._training is not None:
            self._stop.set()
            futures.wait([self._training])
        return submitit.helpers.DelayedSubmission(ArrayTask(self.jobs, self.side_by_side, self.retries))


def array_tasks(jobs: Sequence[Job], settings: BackendSettings) -> list[ArrayTask]:
    """Divide the runs among tasks of a job array."""
    jobs = [replace(job.without_code(), path=job.path.resolve()) for job in jobs]
    size = settings.slurm.runs_per_job
    return [
        ArrayTask(tuple(jobs[first : first + size]), settings.slurm.side_by_side, settings.retries)
        for first in range(0, len(jobs), size)
    ]


# ----------------------------------------------------------------------------------------------------------- the queue


def _query_states(jobs: Sequence[str]) -> dict[str, str] | None:
    """The states of all jobs and array tasks that Slurm still knows; None if it does not answer."""
    command = ["squeue", "--all", "--states=all", "--array", "--noheader", "--format=%i|%T"]
    states: dict[str, str] = {}
    for first in range(0, len(jobs), JOBS_PER_QUERY):
        ids = ",".join(jobs[first : first + JOBS_PER_QUERY])
        answer = subprocess.run([*command, f"--jobs={ids}"], capture_output=True, text=True, check=False)
        if answer.returncode and "Invalid job id" not in answer.stderr:
            return None
        states |= dict(line.split("|") for line in answer.stdout.split())
    return states


def _ask_accounting(job: str) -> dict[str, str]:
    """The states of a job, or of the tasks of an array, in Slurm's accounting; empty where there is none."""
    if shutil.which("sacct") is None:
        return {}
    command = ["sacct", "--noheader", "--parsable2", "--allocations", "--format=JobID,State", f"--jobs={job}"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = answer.stdout.splitlines() if answer.returncode == 0 else []
    return {name: state.split()[0] for name, _, state in (line.partition("|") for line in lines) if state.split()}


class SlurmQueue:
    """The submitted jobs of a sweep, stored in slurm/jobs.json so that no run is submitted twice.

    Attributes:
        jobs: ids of the runs, by id of the job.
        states: of the jobs, as of the last :meth:`refresh`.
    """

    def __init__(self, sweep: Path):
        self._sweep = sweep
        self._file = slurm_folder(sweep) / "jobs.json"
        self.jobs: dict[str, list[str]] = json.loads(self._file.read_text()) if self._file.is_file() else {}
        self.states: dict[str, str] = {}

    def submit(self, jobs: Sequence[Job], settings: BackendSettings) -> None:
        """Submit runs to Slurm, in as few job arrays as possible."""
        executor, tasks = make_executor(settings, self._sweep), array_tasks(jobs, settings)
        for first in range(0, len(tasks), MAX_ARRAY_TASKS):
            array = tasks[first : first + MAX_ARRAY_TASKS]
            try:
                with executor.batch():
                    submitted = [executor.submit(task) for task in array]
            except (subprocess.CalledProcessError, submitit.core.utils.FailedJobError) as error:
                raise Stopped(f"Slurm rejects the jobs: {' '.join(str(error).split())}") from None
            for slurm_job, task in zip(submitted, array, strict=True):
                self.jobs[slurm_job.job_id] = [str(job.id) for job in task.jobs]
            write_json(self._file, self.jobs)

    def refresh(self) -> bool:
        """Query the states of the jobs; returns whether Slurm answered."""
        states = _query_states(sorted({job.partition("_")[0] for job in self.jobs}, key=int))
        if states is not None:
            self.states = states
        return states is not None

    def is_active(self, job: str) -> bool:
        """Whether a job is queued or running."""
        return self.states.get(job, "COMPLETED") not in FINAL_STATES

    def active_runs(self) -> set[str]:
        """Ids of the runs of queued and running jobs."""
        return {run for job, runs in self.jobs.items() if self.is_active(job) for run in runs}

    def last_state(self, run: str) -> tuple[str, str]:
        """The last job to which a run was assigned, and its state.

        Slurm forgets jobs some minutes after their end, and tasks of an array that are cancelled before they start at
        once. If accounting does not know the job either, one that has started is "LOST", one that has not "CANCELLED".
        """
        job = [job for job, runs in self.jobs.items() if run in runs][-1]
        if job not in self.states:
            self.states |= _ask_accounting(job.partition("_")[0])
        return job, self.states.setdefault(job, "LOST" if self.log_file(job).exists() else "CANCELLED")

    def log_file(self, job: str) -> Path:
        """The file with the output of a job."""
        return self._file.with_name(f"{job}_0_log.out")

    def cancel_command(self) -> str | None:
        """The command that cancels all queued and running jobs; None if there are none."""
        arrays = {job.partition("_")[0] for job in self.jobs if self.is_active(job)}
        return f"scancel {' '.join(sorted(arrays, key=int))}" if arrays else None


def run_on_slurm(
    jobs: Sequence[Job],
    settings: BackendSettings,
    sweep: Path,
    monitor: Dashboard,
    *,
    stop: Callable[[], bool],
    wait: bool = True,
) -> dict[Job, str]:
    """Submit the runs that are neither done nor already submitted, and wait for all runs.

    As :meth:`algorithms.studies.backends.Backend.train`; once ``stop`` returns True, the jobs stay in the queue.
    Without waiting, those of a search that have failed before are returned.
    """
    if shutil.which("sbatch") is None or shutil.which("squeue") is None:
        raise ValueError("--on slurm: Slurm is not installed (sbatch and squeue are not on the PATH)")
    queue = SlurmQueue(sweep)
    attempts: Counter[Any] = Counter()
    failed: dict[Job, str] = {}
    missing_before: set[Any] = set()
    first = True
    # Without waiting, nobody sees a run fail: a search that submitted it at every call would not pass its batch.
    count_failures = not wait and settings.adaptive
    while True:
        if queue.refresh():
            active = queue.active_runs()
            open_jobs = [job for job in jobs if job not in failed and not job.done]
            if not open_jobs:
                return failed
            missing = [job for job in open_jobs if job.id not in active]
            # The result of a run may become visible after the end of its job: a run is lost if it is missing twice.
            lost = missing if first else [job for job in missing if job.id in missing_before]
            missing_before = {job.id for job in missing}
            to_submit = []
            for job in lost:
                if first:
                    reason = _reported_failure(job) if count_failures else None
                else:  # the job has already retried what it reported
                    reason = _reported_failure(job) or _lost(job, queue, attempts[job.id], settings.retries)
                if reason is None:
                    attempts[job.id] += 1
                    to_submit.append(job)
                else:
                    failed[job] = reason
                    monitor.failed(job, reason)
            if to_submit:
                queue.submit(to_submit, settings)
                missing_before = set()
            first = False
        if not wait:
            return failed
        monitor.update()
        deadline = time.monotonic() + POLL
        while time.monotonic() < deadline:
            if stop():
                return failed
            time.sleep(0.2)


def _reported_failure(job: Job) -> str | None:
    """The reason in the directory of a run that failed; None if there is none."""
    status = read_status(job.path)
    return str(status["reason"]) if status.get("state") == "failed" and "reason" in status else None


def _lost(job: Job, queue: SlurmQueue, attempts: int, retries: int) -> str | None:
    """Why a run whose Slurm job ended before it did has failed; None to retry it."""
    slurm_job, state = queue.last_state(str(job.id))
    log = queue.log_file(slurm_job)
    hint = f"; see {log}" if log.exists() else ""
    error = WorkerDied(f"Slurm job {slurm_job} ended ({state}) before the run did{hint}")
    retried = state != "CANCELLED" and verdict(error, attempts, retries) == "retry"
    return None if retried else record(job, error)
