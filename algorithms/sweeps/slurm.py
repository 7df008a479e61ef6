"""A sweep on Slurm: one job array through submitit, whose tasks save and requeue themselves when they must go."""

from __future__ import annotations

import json
import math
import shutil
import signal
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import submitit
from rich.console import Console

from algorithms.common.atomic_io import write_json
from algorithms.experiments.dashboard import Dashboard
from algorithms.experiments.interrupts import Stopped
from algorithms.experiments.jobs import Job
from algorithms.experiments.run_directory import read_status
from algorithms.experiments.worker_pool import perform_all
from algorithms.sweeps.manifest import read_manifest
from algorithms.sweeps.settings import SweepSettings

POLL = 5.0  # s between looks at the queue
ARRAY = 1000  # tasks of an array; Slurm takes no more unless it is told to
ASKED = 500  # jobs per look, for a command line has its limits
# States of a Slurm job that will not run again.
ENDED = (
    *("BOOT_FAIL", "CANCELLED", "COMPLETED", "DEADLINE", "FAILED", "NODE_FAIL"),
    *("OUT_OF_MEMORY", "PREEMPTED", "REVOKED", "TIMEOUT"),
)


@dataclass
class Chunk:
    """What one task of the array does: the runs of a part of the manifest.

    Told to go, it saves what is going on and requeues itself: by SIGUSR2, which submitit catches, before the job's time
    is over; by SIGTERM when it is pre-empted. Begun again it goes on, for the runs' directories say how far they are.

    Attributes:
        sweep: the sweep's directory.
        ids: of the runs.
        side_by_side: how many at a time.
        retries: as for :func:`algorithms.experiments.worker_pool.perform_all`.
    """

    sweep: Path
    ids: tuple[str, ...]
    side_by_side: int
    retries: int
    _stop: threading.Event | None = field(default=None, init=False, repr=False)
    _ended: threading.Event | None = field(default=None, init=False, repr=False)

    def __call__(self) -> list[str]:
        """Make the runs; the errors of those that failed."""
        wanted = set(self.ids)
        jobs = [row.job(self.sweep) for row in read_manifest(self.sweep) if row.id in wanted]
        stop, ended = threading.Event(), threading.Event()
        self._stop, self._ended = stop, ended
        result: list[dict[Job, str] | BaseException] = []

        def work() -> None:
            try:
                with Dashboard(jobs, Console(width=120), "this job") as monitor:
                    result.append(perform_all(jobs, self.side_by_side, monitor, retries=self.retries, stop=stop.is_set))
            except BaseException as error:
                result.append(error)
            finally:
                ended.set()

        # The main thread is left to the signals, whose handlers can then wait for the work to be saved.
        signal.signal(signal.SIGTERM, lambda number, frame: stop.set())
        threading.Thread(target=work).start()
        while not ended.wait(1.0):
            pass
        (outcome,) = result
        if isinstance(outcome, BaseException):
            raise outcome
        if stop.is_set():
            _requeue(submitit.JobEnvironment().job_id)
        return [f"{job.name}: {error}" for job, error in outcome.items()]

    def checkpoint(self) -> submitit.helpers.DelayedSubmission:
        """Save what is going on, and ask for the same again; submitit calls it in its signal handler."""
        if self._stop is not None and self._ended is not None:
            self._stop.set()
            self._ended.wait()
        return submitit.helpers.DelayedSubmission(Chunk(self.sweep, self.ids, self.side_by_side, self.retries))


def _requeue(job: str) -> None:
    """Put a job that must go back into the queue, unless somebody has cancelled it."""
    if _states([job]) == {job: "RUNNING"}:
        subprocess.run(["scontrol", "requeue", job], check=True)


def _states(jobs: Sequence[str]) -> dict[str, str] | None:
    """The state of every job, or task of an array, that Slurm still knows; None if it does not answer."""
    command = ["squeue", "--all", "--states=all", "--array", "--noheader", "--format=%i|%T"]
    found: dict[str, str] = {}
    for first in range(0, len(jobs), ASKED):
        asked = subprocess.run(
            [*command, f"--jobs={','.join(jobs[first : first + ASKED])}"], capture_output=True, text=True, check=False
        )
        if asked.returncode and "Invalid job id" not in asked.stderr:
            return None
        found |= dict(line.split("|") for line in asked.stdout.split())
    return found


class _ScriptOnly(submitit.SlurmExecutor):
    """Also where no Slurm is installed; for the text of the script."""

    @classmethod
    def affinity(cls) -> int:
        return 1


def chunks(jobs: Sequence[Job], settings: SweepSettings, sweep: Path) -> list[Chunk]:
    """The tasks of an array that makes the runs."""
    ids = [str(job.id) for job in jobs]
    size = settings.slurm.runs_per_job
    return [
        Chunk(sweep.resolve(), tuple(ids[first : first + size]), settings.slurm.side_by_side, settings.retries)
        for first in range(0, len(ids), size)
    ]


def parameters(settings: SweepSettings, name: str) -> dict[str, Any]:
    """What submitit asks of Slurm for each task of the array."""
    slurm, needs = settings.slurm, settings.resources
    cpus = max(1, math.ceil(needs.cpus * slurm.side_by_side))
    gpus = math.ceil(needs.gpus * slurm.side_by_side)
    optional = {
        "partition": slurm.partition,
        "account": slurm.account,
        "qos": slurm.qos,
        "constraint": slurm.constraint,
        "gpus_per_node": gpus or None,
        "mem": None if needs.memory_gb is None else f"{math.ceil(1024 * needs.memory_gb * slurm.side_by_side)}MB",
        "setup": slurm.setup or None,
    }
    return {
        "job_name": name,
        "time": needs.minutes,
        "cpus_per_task": cpus,
        "array_parallelism": slurm.array_parallelism,
        "signal_delay_s": slurm.signal_delay_s,
        "stderr_to_stdout": True,
        # Since Slurm 22.05 a step does not inherit the job's cores.
        "srun_args": [f"--cpus-per-task={cpus}"],
        "additional_parameters": {"requeue": True, **slurm.additional},
        **{key: value for key, value in optional.items() if value is not None},
    }


def script(jobs: Sequence[Job], settings: SweepSettings, sweep: Path) -> str:
    """The batch script that would be submitted for the runs, or for the first array of them."""
    executor = _ScriptOnly(_folder(sweep), max_num_timeout=settings.slurm.max_requeues)
    executor.update_parameters(**parameters(settings, sweep.name))
    count = min(ARRAY, len(chunks(jobs, settings, sweep)))
    if count > 1:
        executor.parameters["map_count"] = count
    return executor._make_submission_file_text(executor._submitit_command_str, "")


class Queue:
    """The jobs of a sweep that have been submitted, kept in slurm/jobs.json so that no run is submitted twice."""

    def __init__(self, sweep: Path):
        self._file = _folder(sweep) / "jobs.json"
        self.jobs: dict[str, list[str]] = json.loads(self._file.read_text()) if self._file.is_file() else {}
        self.states: dict[str, str] = {}

    def submit(self, tasks: Sequence[Chunk], settings: SweepSettings, sweep: Path) -> None:
        """Put tasks into Slurm's queue, in as few arrays as it takes.

        Raises:
            Stopped: if Slurm refuses them.
        """
        executor = submitit.SlurmExecutor(_folder(sweep), max_num_timeout=settings.slurm.max_requeues)
        executor.update_parameters(**parameters(settings, sweep.name))
        for first in range(0, len(tasks), ARRAY):
            array = tasks[first : first + ARRAY]
            try:
                with executor.batch():
                    submitted = [executor.submit(task) for task in array]
            except (subprocess.CalledProcessError, submitit.core.utils.FailedJobError) as error:
                raise Stopped(f"Slurm refuses the jobs: {' '.join(str(error).split())}") from None
            self.jobs |= {job.job_id: list(task.ids) for job, task in zip(submitted, array, strict=True)}
            write_json(self._file, self.jobs)

    def look(self) -> bool:
        """Ask Slurm for the states; whether it answered."""
        states = _states(sorted({job.partition("_")[0] for job in self.jobs}, key=int))
        if states is not None:
            self.states = states
        return states is not None

    def alive(self, job: str) -> bool:
        """Whether a job is in the queue or runs."""
        return self.states.get(job, "COMPLETED") not in ENDED

    def runs_alive(self) -> set[str]:
        """Ids of the runs of jobs that are in the queue or run."""
        return {run for job, runs in self.jobs.items() if self.alive(job) for run in runs}

    def last_state(self, run: str) -> tuple[str, str]:
        """The last job that had a run, and its state as Slurm last told it."""
        job = [job for job, runs in self.jobs.items() if run in runs][-1]
        return job, self.states.get(job, "gone")

    def log(self, job: str) -> Path:
        """What a job has printed."""
        return self._file.with_name(f"{job}_0_log.out")

    def cancel_command(self) -> str:
        """What a user types to cancel the jobs that are in the queue or run."""
        arrays = {job.partition("_")[0] for job in self.jobs if self.alive(job)}
        return f"scancel {' '.join(sorted(arrays, key=int))}"


def make_on_slurm(
    jobs: Sequence[Job],
    settings: SweepSettings,
    sweep: Path,
    monitor: Dashboard,
    *,
    stop: Callable[[], bool],
    wait: bool = True,
) -> dict[Job, str]:
    """Submit the runs that are neither done nor submitted, and wait for all.

    Args:
        jobs: the runs.
        settings: the sweep's.
        sweep: its directory, which all nodes see under the same path.
        monitor: shows the progress.
        stop: asked while waiting; True returns, the jobs stay in the queue.
        wait: False returns after the submission.

    Returns:
        The jobs that failed, each with its reason.

    Raises:
        ValueError: if there is no Slurm.
        Stopped: if Slurm refuses the jobs.
    """
    if shutil.which("sbatch") is None or shutil.which("squeue") is None:
        raise ValueError("--on slurm: there is no Slurm here (sbatch and squeue are not on the PATH)")
    queue = Queue(sweep)
    attempts: Counter[Any] = Counter()
    failed: dict[Job, str] = {}
    missing_before: set[Any] = set()
    first = True
    while True:
        if queue.look():
            alive = queue.runs_alive()
            open_jobs = [job for job in jobs if job not in failed and not job.done]
            if not open_jobs:
                return failed
            missing = [job for job in open_jobs if job.id not in alive]
            # A run's directory may be seen later than the end of its job: what is missing must be so twice.
            lost = missing if first else [job for job in missing if job.id in missing_before]
            missing_before = {job.id for job in missing}
            again = []
            for job in lost:
                reason = None if first else _reason(job, queue, attempts[job.id], settings.retries)
                if reason is None:
                    attempts[job.id] += 1
                    again.append(job)
                else:
                    failed[job] = reason
                    monitor.failed(job, reason)
            if again:
                queue.submit(chunks(again, settings, sweep), settings, sweep)
                missing_before = set()
            first = False
        if not wait:
            return failed
        monitor.update()
        ends = time.monotonic() + POLL
        while time.monotonic() < ends:
            if stop():
                return failed
            time.sleep(0.2)


def _reason(job: Job, queue: Queue, attempts: int, retries: int) -> str | None:
    """Why a run whose job has ended is given up; None to try again."""
    status = read_status(job.path)
    slurm_job, state = queue.last_state(str(job.id))
    if status.get("state") == "failed" and "reason" in status:
        return str(status["reason"])  # the job has tried what could be tried
    if state == "CANCELLED" or attempts > retries:
        return f"Slurm job {slurm_job} ended ({state}) before the run did; see {queue.log(slurm_job)}"
    return None


def _folder(sweep: Path) -> Path:
    return sweep.resolve() / "slurm"
