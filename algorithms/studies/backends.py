"""Where runs are trained: on this machine, on Ray (:mod:`.ray_tune`) or on Slurm (:mod:`.slurm`).

What becomes of a run that ends with an error is decided for all of them by :func:`algorithms.runs.jobs.verdict`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mo_deepdrive.support.machine import GIB, available_cores, available_memory, check_memory

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from algorithms.runs.jobs import Job
    from algorithms.runs.progress import Dashboard
    from algorithms.studies.sweep_settings import BackendSettings, Resources

WORKER_MEMORY = GIB / 4  # bytes of a process that trains, without its rollouts


@dataclass(frozen=True)
class Backend:
    """What trains runs.

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

    def train(
        self,
        jobs: Sequence[Job],
        settings: BackendSettings,
        directory: Path,
        monitor: Dashboard,
        stop: Callable[[], bool],
    ) -> dict[Job, str]:
        """Train the runs.

        Args:
            jobs: the runs; finished ones are skipped.
            settings: of the sweep or study.
            directory: of the sweep or study, which all machines must see under the same path.
            monitor: shows the progress.
            stop: called several times a second; once it returns True, what is under way is saved and this returns.

        Returns:
            The jobs that failed, each with its reason.

        Raises:
            ValueError: if the backend is not available, or the given workers take more memory than there is.
            Stopped: if the backend cannot continue, for example because the disk is full.
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
        if self.workers is not None:
            workers = min(self.workers, len(jobs))
            check_memory(f"--workers {workers} with training.num_envs = {num_envs}", workers * memory)
            return workers
        return max(1, math.floor(min(available_cores() / resources.cpus, available_memory() / memory)))

    def after_interrupt(self, directory: Path) -> str:
        """What the user can do after an interrupt."""
        if self.name != "slurm":
            return "the runs in progress are saved: the same command resumes them"
        from algorithms.studies.slurm import SlurmQueue

        queue = SlurmQueue(directory)
        queue.refresh()
        cancel = queue.cancel_command()
        if cancel is None:
            return "no job is in Slurm's queue: the same command submits the runs that are not done"
        return f"the jobs stay in Slurm's queue: the same command watches them again, `{cancel}` cancels them"
