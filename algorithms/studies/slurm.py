"""The Slurm backend: the batch script of a sweep, its submission as a job array through submitit, and its watch.

:func:`sbatch_options` is the place to change the batch script; submitit writes the text around the options, and
``mo-deepdrive sweep --config FILE --on slurm --dry-run`` prints it. Each task of the array unpickles and calls its
:class:`ArrayTask`. Before the time limit, or when pre-empted, a task saves its runs and requeues itself.
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
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    from algorithms.runs.jobs import Job
    from algorithms.studies.settings import PlanSettings

POLL = 5.0  # s between queries of the queue
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


def sbatch_options(settings: PlanSettings, name: str) -> dict[str, Any]:
    """The options of sbatch, under submitit's names, for each task of the array of a job ``name``."""
    slurm, resources = settings.slurm, settings.resources
    given = {"partition", "account", "qos", "constraint", "array_parallelism", "signal_delay_s", "setup"}
    cpus = max(1, math.ceil(resources.cpus * slurm.side_by_side))
    memory = math.ceil(1024 * (resources.memory_gb or 0.0) * slurm.side_by_side)
    options: dict[str, Any] = {
        **slurm.model_dump(include=given),
        "job_name": name,
        "time": resources.minutes,
        "cpus_per_task": cpus,
        "gpus_per_node": math.ceil(resources.gpus * slurm.side_by_side),
        "mem": f"{memory}MB" if memory else None,
        "stderr_to_stdout": True,
        # Since Slurm 22.05, srun does not inherit --cpus-per-task from sbatch.
        "srun_args": [f"--cpus-per-task={cpus}"],
        "additional_parameters": {"requeue": True, **slurm.additional},
    }
    return {key: value for key, value in options.items() if value}


def make_executor(settings: PlanSettings, sweep: Path) -> TaskExecutor:
    """What writes and submits the batch script of a sweep."""
    executor = TaskExecutor(own_path(sweep.resolve(), "slurm"), max_num_timeout=settings.slurm.max_requeues)
    executor.update_parameters(**sbatch_options(settings, sweep.name))
    return executor


def batch_script(tasks: int, settings: PlanSettings, sweep: Path) -> str:
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
        with futures.ThreadPoolExecutor(1) as pool, Dashboard(self.jobs, Console(width=WIDTH), "this job") as monitor:
            options: dict[str, Any] = {"retries": self.retries, "stop": stop.is_set}
            self._training = pool.submit(perform_all, self.jobs, self.side_by_side, monitor, **options)
            while futures.wait([self._training], timeout=1.0).not_done:
                pass
        failed = self._training.result()
        if stop.is_set():
            job_id = submitit.JobEnvironment().job_id
            if _query_states([job_id]) == {job_id: "RUNNING"}:  # it has not been cancelled
                subprocess.run(["scontrol", "requeue", job_id], check=True)
        return [f"{job.name}: {error}" for job, error in failed.items()]

    def checkpoint(self) -> submitit.helpers.DelayedSubmission:
        """Save the runs, and ask to be submitted again; called by submitit's signal handler."""
        if self._stop is not None and self._training is not None:
            self._stop.set()
            futures.wait([self._training])
        return submitit.helpers.DelayedSubmission(ArrayTask(self.jobs, self.side_by_side, self.retries))


# ----------------------------------------------------------------------------------------------------------- the queue


def _query_states(jobs: Iterable[str]) -> dict[str, str] | None:
    """The states of all jobs and array tasks that Slurm still knows; None if it does not answer."""
    command = ["squeue", "--all", "--states=all", "--array", "--noheader", "--format=%i|%T", f"--jobs={','.join(jobs)}"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    if answer.returncode and "Invalid job id" not in answer.stderr:
        return None
    return dict(line.split("|") for line in answer.stdout.split())


class SlurmQueue:
    """The submitted jobs of a sweep with the ids of their runs, in slurm/jobs.json, so that none is submitted twice."""

    def __init__(self, sweep: Path):
        self._sweep = sweep
        self._file = own_path(sweep.resolve(), "slurm") / "jobs.json"
        self.jobs: dict[str, list[str]] = json.loads(self._file.read_text()) if self._file.is_file() else {}
        self._states: dict[str, str] = {}

    def submit(self, jobs: Sequence[Job], settings: PlanSettings) -> None:
        """Submit runs to Slurm, in as few job arrays as possible."""
        executor, slurm = make_executor(settings, self._sweep), settings.slurm
        portable = [replace(job.without_code(), path=job.path.resolve()) for job in jobs]
        tasks = [
            ArrayTask(tuple(portable[first : first + slurm.runs_per_job]), slurm.side_by_side, settings.retries)
            for first in range(0, len(portable), slurm.runs_per_job)
        ]
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
        arrays = {job.partition("_")[0] for job in self.jobs}
        states = _query_states(arrays) if arrays else {}
        self._states = self._states if states is None else states
        return states is not None

    def active_jobs(self) -> list[str]:
        """The jobs that are queued or running."""
        return [job for job in self.jobs if self._states.get(job, "COMPLETED") not in FINAL_STATES]

    def lost(self, job: Job, attempts: int, retries: int) -> str | None:
        """Why a run whose Slurm job ended before it did has failed; None to retry it."""
        slurm_job = [slurm_job for slurm_job, runs in self.jobs.items() if job.id in runs][-1]
        log = self._file.with_name(f"{slurm_job}_0_log.out")
        # Slurm forgets jobs some minutes after their end, and tasks that are cancelled before they start at once.
        state = self._states.get(slurm_job, "LOST" if log.exists() else "CANCELLED")
        hint = f"; see {log}" if log.exists() else ""
        error = WorkerDied(f"Slurm job {slurm_job} ended ({state}) before the run did{hint}")
        retried = state != "CANCELLED" and verdict(error, attempts, retries) == "retry"
        return None if retried else record(job, error)


def after_interrupt(sweep: Path) -> str:
    """What the user can do after an interrupt."""
    queue = SlurmQueue(sweep)
    queue.refresh()
    arrays = sorted({job.partition("_")[0] for job in queue.active_jobs()}, key=int)
    if not arrays:
        return "no job is in Slurm's queue: the same command submits the runs that are not done"
    cancel = f"`scancel {' '.join(arrays)}` cancels them"
    return f"the jobs stay in Slurm's queue: the same command watches them again, {cancel}"


def run_on_slurm(
    jobs: Sequence[Job],
    settings: PlanSettings,
    sweep: Path,
    monitor: Dashboard,
    *,
    stop: Callable[[], bool],
    wait: bool = True,
) -> dict[Job, str]:
    """As :meth:`.execution.Backend.train`; once ``stop`` returns True, the jobs stay in the queue."""
    if shutil.which("sbatch") is None or shutil.which("squeue") is None:
        raise ValueError("--on slurm: Slurm is not installed (sbatch and squeue are not on the PATH)")
    queue = SlurmQueue(sweep)
    attempts: Counter[Any] = Counter()
    failed: dict[Job, str] = {}
    missing_before: set[Job] | None = None  # None until Slurm has answered

    def reason_of(job: Job) -> str | None:
        """Why a run that no job has has failed; None to submit it (again)."""
        status = read_status(job.path)
        reported = status.get("reason") if status.get("state") == "failed" else None
        if missing_before is None:
            # Without waiting, nobody sees a run fail: submitted at every call, it would keep a search in its batch.
            return reported if settings.adaptive and not wait else None
        # The job has already retried what the run reported.
        return reported or queue.lost(job, attempts[job.id], settings.retries)

    while True:
        if queue.refresh():
            active = {run for job in queue.active_jobs() for run in queue.jobs[job]}
            open_jobs = [job for job in jobs if job not in failed and not job.done]
            if not open_jobs:
                return failed
            missing = [job for job in open_jobs if job.id not in active]
            to_submit = []
            # The result of a run may become visible after the end of its job: a run is lost if it is missing twice.
            for job in (job for job in missing if missing_before is None or job in missing_before):
                reason = reason_of(job)
                if reason is None:
                    to_submit.append(job)
                    continue
                failed[job] = reason
                monitor.failed(job, reason)
            if to_submit:
                attempts.update(job.id for job in to_submit)
                queue.submit(to_submit, settings)
            missing_before = set() if to_submit else {*missing}
        if not wait:
            return failed
        monitor.update()
        deadline = time.monotonic() + POLL
        while time.monotonic() < deadline:
            if stop():
                return failed
            time.sleep(0.2)
