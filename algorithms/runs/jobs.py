"""Jobs: each trains a run, resumes it or skips it; many at a time are worker processes of this machine.

A worker that dies costs only the steps since its checkpoint. What becomes of a run that failed is decided by
:func:`verdict`, wherever it was trained.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections import Counter
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from multiprocessing import connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from algorithms.reporting.run_records import INCIDENTAL, Recorded, flatten
from algorithms.runs.config import Experiment, is_peer, make_experiment, peer_running
from algorithms.runs.console import make_console, make_standard_streams_lenient, open_log
from algorithms.runs.interrupts import DiskFull, Interrupts, JobFailed, Stopped, describe, stopped_by
from algorithms.runs.progress import ENDED, Dashboard
from algorithms.runs.run_directory import CONFIG_FILE, InUse, Run, imported_paths, is_run, read_status
from mo_deepdrive.support.atomic_io import atomic_write
from mo_deepdrive.support.machine import available_cores

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from rich.console import Console

    from algorithms.runs.training import Watch

JobOutcome = Literal["trained", "already there", "stopped"]
BUSY = 2.0  # s after which a run that another process holds is tried again
DIED = "its worker process died (out of memory, or killed)"


@dataclass(frozen=True)
class Job:
    """A run to be made."""

    name: str  # in messages
    experiment: Experiment = field(hash=False)  # with every default filled in
    path: Path  # the run's directory
    # Hash of the experiment, if the directory is named by it and cannot hold another run; also the run's id in W&B.
    id: str | None = None

    @property
    def done(self) -> bool:
        """Whether the run is finished (trained and evaluated) or pruned."""
        if self.id is None and is_run(self.path):
            self.open()
        return read_status(self.path).get("state") in ENDED

    def open(self) -> Run:
        """The run in the directory, which has this experiment, and may import what it names."""
        values = self.experiment.to_dict()
        run = Run.open(self.path, imports=imported_paths(values).values())
        there, wanted = flatten(run.experiment.to_dict()), flatten(values)
        changed = [
            f"{key} = {there.get(key)!r} there, {wanted.get(key)!r} wanted"
            for key in there | wanted
            if not {key, key.partition(".")[0]} & {*INCIDENTAL} and there.get(key) != wanted.get(key)
        ]
        if changed:
            raise ValueError(
                f"run directory {str(self.path)!r} holds another experiment: {'; '.join(changed)}; "
                "delete it or choose another folder"
            )
        return run

    def packed(self) -> dict[str, Any]:
        """Plain values to send to another process, for :meth:`unpack`."""
        return {**vars(self), "experiment": self.experiment.to_dict(), "path": str(self.path)}

    def without_code(self) -> Job:
        """The job for a process that only starts workers: without the Config, whose module imports torch."""
        algorithm = self.experiment.algorithm
        plain = algorithm.model_copy(update={"config": Recorded(**algorithm.config.model_dump(mode="json"))})
        return replace(self, experiment=self.experiment.model_copy(update={"algorithm": plain}))

    @classmethod
    def unpack(cls, values: Mapping[str, Any]) -> Job:
        """The job from the values of :meth:`packed`."""
        return cls(values["name"], make_experiment(values["experiment"]), Path(values["path"]), values["id"])


def perform(job: Job, *, watch: Watch | None = None, stop: Callable[[], bool] | None = None) -> JobOutcome:
    """Train and evaluate a run; "stopped" if a signal or ``stop`` ended it early, after saving."""
    if job.done:
        return "already there"
    # As late as this: the process that hands out jobs needs no torch, which takes seconds and much memory.
    from algorithms.runs.training import resume, train_and_finish

    run: Run | None = None
    try:
        run, resumed = _lock(job)
        if job.done:  # finished by the process that held the lock until now
            return "already there"
        if resumed:
            _take_over_settings(run, job.experiment)
        if job.id is not None and run.experiment.logging.wandb is not None:
            atomic_write(job.path / "wandb_id", f"{job.id}\n".encode())  # repeated attempts continue one W&B run
        with open_log(job.path / "train.log") as log:
            if is_peer(run.experiment.algorithm.name):
                peer_running().run_peer(run, make_console(log))
                return "trained"
            agent = resume(run)
            if train_and_finish(run, agent, make_console(log), resumed=resumed, watch=watch, stop=stop) is not None:
                return "stopped"
    except OSError as error:
        raise stopped_by(error, f"the run cannot be written: {error}") from error
    except Exception as error:
        if run is not None:
            run.end("failed", run.status.get("step", 0), describe(error))
        raise
    finally:
        if run is not None:
            run.unlock()
    return "trained"


def _lock(job: Job) -> tuple[Run, bool]:
    """The run, locked, and whether it was started before."""
    if not is_run(job.path):
        try:
            return Run.create(job.experiment, job.path), False
        except ValueError as error:
            if isinstance(error, InUse) or not is_run(job.path):  # else another process has just created it
                raise
    run = job.open()
    run.lock()
    return run, True


def _take_over_settings(run: Run, wanted: Experiment) -> None:
    """Continue a run with the job's logging and, if possible, on its device; threads would change last bits."""
    before = run.experiment
    values = {**before.to_dict(), "logging": wanted.logging.model_dump(mode="json")}
    # Worlds that stay on a device draw other random numbers, so that their checkpoints are others.
    if before.is_resident == wanted.is_resident or not run.checkpoint.exists():
        values["training"]["device"] = wanted.training.device
    run.experiment = make_experiment(values, f"experiment {str(run.path / CONFIG_FILE)!r}")
    if run.experiment != before:
        run.write_config()


class WorkerDied(JobFailed):
    """The process, actor or Slurm job of a run ended before the run did."""


def verdict(error: BaseException, attempts: int, retries: int) -> Literal["stop", "wait", "retry", "fail"]:
    """What happens after an error of a run, which has been started ``attempts`` times."""
    if isinstance(error, DiskFull):
        return "stop"  # all runs: none could be saved
    if isinstance(error, InUse):
        return "wait"  # for the process that trains it, and try again after BUSY seconds
    # After a death, or where it could not read or write, it resumes; any other error would happen again.
    return "retry" if isinstance(error, (WorkerDied, Stopped, OSError)) and attempts <= retries else "fail"


def record(job: Job, error: BaseException) -> str:
    """The reason why a run failed; a death, of which the worker could not say anything, is written to its status."""
    reason = describe(error)
    if isinstance(error, WorkerDied):
        with contextlib.suppress(ValueError, OSError):  # it may have died before the directory existed
            run = job.open()
            run.set_status("failed", run.status.get("step", 0), reason)
    return reason


# ----------------------------------------------------------------------------------------------------- worker processes

POLL = 0.25  # s between checks for finished jobs


def _perform(packed: dict[str, Any]) -> JobOutcome:
    """:func:`perform` in a worker process; its errors can be sent to the parent."""
    try:
        outcome = perform(Job.unpack(packed))
    except (InUse, Stopped):
        raise
    except Exception as error:
        raise JobFailed(describe(error)) from None
    if outcome == "stopped":
        os._exit(130)  # everything is saved; otherwise this worker would take the next job
    return outcome


def _begin_worker() -> None:
    """Stop at SIGTERM and when the parent ends alone: batch systems send their signals to every process of a job."""
    make_standard_streams_lenient()
    if os.name == "posix":
        os.setsid()
        for number in (signal.SIGUSR1, signal.SIGUSR2):
            signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    """Hold back Ctrl-C in the context: processes started in it never receive it, this one receives it afterwards."""
    if os.name != "posix":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Workers:
    """Worker processes that each take one job at a time; if one dies, the others continue."""

    def __init__(self, count: int):
        self.idle = [self._executor() for _ in range(count)]
        self.busy: dict[Future[JobOutcome], tuple[ProcessPoolExecutor, Job]] = {}

    @staticmethod
    def _executor() -> ProcessPoolExecutor:
        from mo_deepdrive.__main__ import call  # not earlier: it decides which package is algorithms

        return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), call, (_begin_worker,))

    def start(self, job: Job) -> None:
        """Give a job to an idle worker."""
        executor = self.idle.pop()
        with _interrupts_held():
            self.busy[executor.submit(_perform, job.packed())] = executor, job

    def ended(self, timeout: float) -> Iterator[tuple[Job, BaseException | None]]:
        """The jobs that end within ``timeout`` seconds, each with its error or None."""
        for future in wait(self.busy, timeout, FIRST_COMPLETED).done:
            executor, job = self.busy.pop(future)
            error = future.exception()
            if isinstance(error, BrokenProcessPool):
                executor.shutdown()
                executor = self._executor()
            self.idle.append(executor)
            yield job, error

    def close(self) -> None:
        """Stop the running jobs, which save their checkpoints, and end the workers."""
        if self.busy:
            for process in multiprocessing.active_children():
                process.terminate()  # SIGTERM, at which training saves
        for executor in [*self.idle, *(executor for executor, _ in self.busy.values())]:
            executor.shutdown(wait=True, cancel_futures=True)


def perform_all(
    jobs: Sequence[Job], workers: int, dashboard: Dashboard, *, retries: int = 0, stop: Callable[[], bool] | None = None
) -> dict[Job, str]:
    """Make all runs that are not finished, until ``stop``, which is called often; the failed ones with their errors."""
    waiting = {job: 0.0 for job in jobs if not job.done}  # the time from which on each may be started
    failed: dict[Job, str] = {}
    if not waiting:
        return failed
    attempts: Counter[Job] = Counter()
    pool = _Workers(min(workers, len(waiting)))
    try:
        while (waiting or pool.busy) and not (stop and stop()):
            for job in [job for job, start in waiting.items() if start <= time.monotonic()][: len(pool.idle)]:
                del waiting[job]
                pool.start(job)
            if not pool.busy:
                time.sleep(POLL)
            for job, error in pool.ended(POLL):
                if error is None:
                    continue
                if not isinstance(error, InUse):
                    attempts[job] += 1
                if isinstance(error, BrokenProcessPool):
                    error = WorkerDied(DIED + (f", {attempts[job]} times" if attempts[job] > 1 else ""))
                outcome = verdict(error, attempts[job], retries)
                if outcome == "stop":
                    raise error
                if outcome == "fail":
                    failed[job] = record(job, error)
                    dashboard.failed(job, failed[job])
                else:
                    waiting[job] = time.monotonic() + (BUSY if outcome == "wait" else 0.0)
            dashboard.update()
    finally:
        pool.close()
        dashboard.update(now=True)
    return failed


def train_apart(runs: Sequence[Run], console: Console) -> int | None:
    """Train locked runs in processes; the signal that stopped it, 1 if a run failed, None if all are finished."""
    jobs = [Job(run.path.name, run.experiment, run.path) for run in runs]
    workers = max(1, available_cores() // runs[0].experiment.training.threads)
    for run in runs:
        run.unlock()
    with Interrupts() as interrupts, Dashboard(jobs, console) as dashboard:
        failed = perform_all(jobs, workers, dashboard, stop=lambda: interrupts.received is not None)
    return interrupts.received or (1 if failed else None)
