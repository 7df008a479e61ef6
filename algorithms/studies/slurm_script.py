"""The Slurm batch script of a sweep: which options of sbatch it has, and its text.

:func:`sbatch_options` is the place to change the script; submitit writes the text around the options. Print it with
``mo-deepdrive sweep --config FILE --on slurm --dry-run``. For sweeps/one_waypoint it is::

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

Each task of the array unpickles and calls its :class:`algorithms.studies.slurm.ArrayTask`.
"""

from __future__ import annotations

import math
import shlex
import sys
from typing import TYPE_CHECKING, Any

import submitit

from mo_deepdrive.support.atomic_io import own_path

if TYPE_CHECKING:
    from pathlib import Path

    from algorithms.studies.sweep_settings import BackendSettings

MAX_ARRAY_TASKS = 1000  # Slurm's default limit is 1001 (MaxArraySize)


# submitit's own command, `python -m submitit.core._submit`, looks for packages in the working directory first, and
# would take any package algorithms for ours.
START = (
    "import sys; sys.path = [*filter(None, sys.path), str()]; import mo_deepdrive.__main__; "
    "from submitit.core.submission import submitit_main; submitit_main()"
)


class TaskExecutor(submitit.SlurmExecutor):
    """Starts tasks that look for packages in the working directory last, like the commands."""

    @property
    def _submitit_command_str(self) -> str:
        return shlex.join([sys.executable, "-u", "-c", START, str(self.folder)])


class _ScriptWriter(TaskExecutor):
    """Writes the script on machines without Slurm, too."""

    @classmethod
    def affinity(cls) -> int:
        return 1


def slurm_folder(sweep: Path) -> Path:
    """Where the logs of the jobs and the ids of submitted jobs are.

    Raises:
        ValueError: if a link leads out of the sweep.
    """
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


def batch_script(tasks: int, settings: BackendSettings, sweep: Path) -> str:
    """The text of the batch script for an array of ``tasks`` tasks, or for the first array if there are several."""
    executor = _ScriptWriter(slurm_folder(sweep), max_num_timeout=settings.slurm.max_requeues)
    executor.update_parameters(**sbatch_options(settings, sweep.name))
    if tasks > 1:
        executor.parameters["map_count"] = min(MAX_ARRAY_TASKS, tasks)
    return executor._make_submission_file_text(executor._submitit_command_str, "")
