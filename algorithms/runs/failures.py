"""What becomes of a run that ended with an error: one rule for runs in worker processes, on Ray and on Slurm."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Literal

from algorithms.runs.interrupts import DiskFull, JobFailed, Stopped, describe
from algorithms.runs.run_directory import InUse

if TYPE_CHECKING:
    from algorithms.runs.jobs import Job

BUSY = 2.0  # s after which a run that another process holds is tried again
DIED = "its worker process died (out of memory, or killed)"


class WorkerDied(JobFailed):
    """The process, actor or Slurm job of a run ended before the run did."""


def verdict(error: BaseException, attempts: int, retries: int) -> Literal["stop", "wait", "retry", "fail"]:
    """What happens after an error of a run.

    - "stop" all runs if the disk is full: none could be saved.
    - "wait" if another process trains the run, and try again after BUSY seconds.
    - "retry" if its worker died, or it could not read or write: it resumes from its checkpoint.
    - "fail" after ``retries`` of these, and for any other error, which would happen again.

    Args:
        error: that ended the run.
        attempts: how often the run has been started.
        retries: how often it may be started again.
    """
    if isinstance(error, DiskFull):
        return "stop"
    if isinstance(error, InUse):
        return "wait"
    return "retry" if isinstance(error, (WorkerDied, Stopped, OSError)) and attempts <= retries else "fail"


def record(job: Job, error: BaseException) -> str:
    """The reason why a run failed; a death, of which the worker could not say anything, is written to its status."""
    reason = describe(error)
    if isinstance(error, WorkerDied):
        with contextlib.suppress(ValueError, OSError):  # it may have died before the directory existed
            run = job.open()
            run.set_status("failed", run.status.get("step", 0), reason)
    return reason
