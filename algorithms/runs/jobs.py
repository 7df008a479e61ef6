"""A job trains a run, resumes it, or skips it if it is finished; the one rule of what becomes of a run that failed."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from algorithms.reporting.run_records import INCIDENTAL, Recorded, flatten
from algorithms.runs.config import Experiment, check_loggers, find_algorithm, make_experiment, peer_running
from algorithms.runs.console import make_console, open_log
from algorithms.runs.interrupts import DiskFull, JobFailed, Stopped, describe, stopped_by
from algorithms.runs.run_directory import CONFIG_FILE, InUse, Run, imported_paths, is_run, read_status
from mo_deepdrive.support.atomic_io import atomic_write
from mo_deepdrive.support.yaml import read_mapping

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

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
    def exists(self) -> bool:
        """Whether the run was started before."""
        return is_run(self.path)

    @property
    def done(self) -> bool:
        """Whether the run is finished (trained and evaluated) or pruned."""
        if self.id is None and self.exists:
            self.open()
        return read_status(self.path).get("state") in ("finished", "pruned")

    def open(self) -> Run:
        """The run in the directory, which has this experiment, and may import what it names."""
        mine = imported_paths(self.experiment.to_dict()).values()
        theirs = imported_paths(read_mapping(self.path / CONFIG_FILE)) if self.exists else {}
        changed = [f"{key} = {name!r} there" for key, name in theirs.items() if name not in mine]
        if not changed:
            run = Run.open(self.path, trust=True)
            changed = differences(run.experiment.to_dict(), self.experiment.to_dict())
        if changed:
            raise ValueError(
                f"run directory {str(self.path)!r} holds another experiment: {'; '.join(changed)}; "
                "delete it or choose another folder"
            )
        return run

    def packed(self) -> dict[str, Any]:
        """Plain values to send to another process, for :meth:`unpack`."""
        return {"name": self.name, "experiment": self.experiment.to_dict(), "path": str(self.path), "id": self.id}

    def without_code(self) -> Job:
        """The job for a process that only starts workers: without the Config, whose module imports torch."""
        algorithm = self.experiment.algorithm
        plain = algorithm.model_copy(update={"config": Recorded(**algorithm.config.model_dump(mode="json"))})
        return replace(self, experiment=self.experiment.model_copy(update={"algorithm": plain}))

    @classmethod
    def unpack(cls, values: Mapping[str, Any]) -> Job:
        """The job from the values of :meth:`packed`."""
        experiment = make_experiment(values["experiment"])
        return cls(values["name"], experiment, Path(values["path"]), values["id"])


def differences(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[str]:
    """A line per key that differs between an experiment and the wanted one; INCIDENTAL keys are not compared."""
    there, wanted = flatten(first), flatten(second)
    return [
        f"{key} = {there.get(key)!r} there, {wanted.get(key)!r} wanted"
        for key in there | wanted
        if not {key, key.partition(".")[0]} & {*INCIDENTAL} and there.get(key) != wanted.get(key)
    ]


def perform(job: Job, *, watch: Watch | None = None, stop: Callable[[], bool] | None = None) -> JobOutcome:
    """Train a run from the beginning or its checkpoint, and evaluate it; its output goes to its train.log.

    ``watch`` and ``stop`` are those of :func:`algorithms.runs.training.train`.

    Returns:
        "already there" if it was finished before; "stopped" if a signal or ``stop`` ended it early, after saving.
    """
    if job.done:
        return "already there"
    # As late as this: the process that hands out jobs needs no torch, which takes seconds and much memory.
    from algorithms.runs.training import resume, train_and_finish

    try:
        run, resumed = _lock(job)
    except OSError as error:
        raise stopped_by(error, f"the run cannot be written: {error}") from error
    try:
        if job.done:  # finished by the process that held the lock until now
            return "already there"
        if resumed:
            _take_over_settings(run, job.experiment)
        check_loggers(run.experiment)
        if job.id is not None and run.experiment.logging.wandb is not None:
            atomic_write(job.path / "wandb_id", f"{job.id}\n".encode())  # repeated attempts continue one W&B run
        with open_log(job.path / "train.log") as log:
            if find_algorithm(run.experiment.algorithm.name).is_peer:
                peer_running().run_peer(run, make_console(log))
                return "trained"
            agent = resume(run)
            if train_and_finish(run, agent, make_console(log), resumed=resumed, watch=watch, stop=stop) is not None:
                return "stopped"
    except OSError as error:
        raise stopped_by(error, f"the run cannot be written: {error}") from error
    except Exception as error:
        with contextlib.suppress(OSError):  # it may be the reason; the original error is raised in any case
            run.set_status("failed", run.status.get("step", 0), describe(error))
        raise
    finally:
        run.unlock()
    return "trained"


def _lock(job: Job) -> tuple[Run, bool]:
    """The run, locked, and whether it was started before."""
    if not job.exists:
        try:
            return Run.create(job.experiment, job.path), False
        except InUse:
            raise
        except ValueError:
            if not job.exists:  # otherwise another process has created it in the meantime
                raise
    run = job.open()
    run.lock()
    return run, True


def _take_over_settings(run: Run, wanted: Experiment) -> None:
    """Continue a run with the job's logging and, if possible, on its device; config.yaml says so.

    The number of threads stays that of the run, because it changes last bits.
    """
    before = run.experiment
    # Worlds that stay on a device draw other random numbers, so that their checkpoints are others.
    stays = run.checkpoint.exists() and before.is_resident != wanted.is_resident
    device = (before if stays else wanted).training.device
    training = before.training.model_copy(update={"device": device})
    after = before.model_copy(update={"training": training, "logging": wanted.logging})
    run.experiment = make_experiment(after.to_dict(), f"experiment {str(run.path / CONFIG_FILE)!r}")
    if run.experiment != before:
        run.write_config()


class WorkerDied(JobFailed):
    """The process, actor or Slurm job of a run ended before the run did."""


def verdict(error: BaseException, attempts: int, retries: int) -> Literal["stop", "wait", "retry", "fail"]:
    """What happens after an error of a run.

    - "stop" all runs if the disk is full: none could be saved.
    - "wait" if another process trains the run, and try again after BUSY seconds.
    - "retry" if its worker died, or it could not read or write: it resumes from its checkpoint.
    - "fail" after ``retries`` of these, and for any other error, which would happen again.

    ``attempts`` is how often the run has been started.
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
