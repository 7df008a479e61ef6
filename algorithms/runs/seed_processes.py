"""Several seeds at the same time, in a process each on a CPU."""

from __future__ import annotations

from typing import TYPE_CHECKING

from algorithms.runs.dashboard import Dashboard
from algorithms.runs.interrupts import Interrupts
from algorithms.runs.jobs import Job
from algorithms.runs.worker_pool import perform_all
from mo_deepdrive.support.machine import available_cores

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from algorithms.runs.run_directory import Run


def train_apart(runs: Sequence[Run], console: Console) -> int | None:
    """Train runs whose locks are held, each in a process of its own.

    As many run at a time as there are cores for their threads.

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
