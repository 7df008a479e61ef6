"""Worker processes for many runs on one machine; a worker that dies costs only the steps since its checkpoint."""

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
from multiprocessing import connection
from typing import TYPE_CHECKING, Any

from algorithms.runs.console import make_standard_streams_lenient
from algorithms.runs.interrupts import Interrupts, JobFailed, Stopped, describe
from algorithms.runs.jobs import BUSY, DIED, Job, JobOutcome, WorkerDied, perform, record, verdict
from algorithms.runs.progress import Dashboard
from algorithms.runs.run_directory import InUse
from mo_deepdrive.__main__ import call
from mo_deepdrive.support.machine import available_cores

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from rich.console import Console

    from algorithms.runs.run_directory import Run

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
    """Leave the handling of signals to the parent: a worker stops at SIGTERM and when the parent ends.

    Batch systems send their signals to every process of a job. Output of the user's code must not stop a worker either.
    """
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
    jobs: Sequence[Job],
    workers: int,
    dashboard: Dashboard,
    *,
    retries: int = 0,
    stop: Callable[[], bool] = lambda: False,
) -> dict[Job, str]:
    """Make all runs that are not finished, ``workers`` at a time, each in a worker process.

    Runs that other processes are making are waited for.

    Args:
        jobs: the runs; finished ones are skipped.
        workers: number of processes.
        dashboard: shows the progress.
        retries: as in :func:`algorithms.runs.jobs.verdict`.
        stop: called several times a second; True saves the running jobs and returns.

    Returns:
        The jobs that failed, each with its error.
    """
    waiting = [(0.0, job) for job in jobs if not job.done]  # each with the time from which on it may be started
    failed: dict[Job, str] = {}
    if not waiting:
        return failed
    attempts: Counter[Path] = Counter()
    pool = _Workers(min(workers, len(waiting)))
    try:
        while (waiting or pool.busy) and not stop():
            for start in [start for start in waiting if start[0] <= time.monotonic()][: len(pool.idle)]:
                waiting.remove(start)
                pool.start(start[1])
            if not pool.busy:
                time.sleep(POLL)
            for job, error in pool.ended(POLL):
                if error is None:
                    continue
                attempts[job.path] += 1
                if isinstance(error, BrokenProcessPool):
                    times = f", {attempts[job.path]} times" if attempts[job.path] > 1 else ""
                    error = WorkerDied(DIED + times)
                outcome = verdict(error, attempts[job.path], retries)
                if outcome == "stop":
                    raise error
                if outcome == "wait":
                    attempts[job.path] -= 1
                    waiting.append((time.monotonic() + BUSY, job))
                elif outcome == "retry":
                    waiting.append((0.0, job))
                else:
                    failed[job] = record(job, error)
                    dashboard.failed(job, failed[job])
            dashboard.update()
    finally:
        pool.close()
        dashboard.update(now=True)
    return failed


def train_apart(runs: Sequence[Run], console: Console) -> int | None:
    """Train runs whose locks are held, each in a process of its own, as many at a time as there are cores for.

    Returns:
        The number of the signal that stopped training, 1 if a run failed, or None if all are finished.
    """
    jobs = [Job(run.path.name, run.experiment, run.path) for run in runs]
    workers = max(1, available_cores() // runs[0].experiment.training.threads)
    for run in runs:
        run.unlock()
    with Interrupts() as interrupts, Dashboard(jobs, console) as dashboard:
        failed = perform_all(jobs, workers, dashboard, stop=lambda: interrupts.received is not None)
    return interrupts.received or (1 if failed else None)
