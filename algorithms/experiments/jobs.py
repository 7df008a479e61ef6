"""Runs to be made: each is trained, gone on with, or left alone where it is finished."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from rich.console import Console

from algorithms.common.atomic_io import atomic_write
from algorithms.experiments.config import Experiment, make_experiment
from algorithms.experiments.run_directory import InUse, Run, read_status
from algorithms.experiments.training import Stopped, finish, resume, stopped, train

# Of a config: they say where and how loudly a run is made, not what comes out of it.
FREE = ("training.device", "training.threads", "logging")

Outcome = Literal["trained", "already there", "stopped"]
Watch = Callable[[int, Mapping[str, float]], None]


@dataclass(frozen=True)
class Job:
    """A run that is wanted.

    Attributes:
        name: for messages.
        experiment: resolved.
        path: the run's directory.
        id: of a run whose directory is named by what determines it, so that no other can be there; also its id in
            Weights & Biases.
    """

    name: str
    experiment: Experiment = field(hash=False)
    path: Path
    id: str | None = None

    @property
    def done(self) -> bool:
        """Whether nothing is left to do: trained and evaluated, or pruned.

        Raises:
            ValueError: if another experiment has the directory, naming what differs.
        """
        if self.id is None:
            self.check()
        return read_status(self.path).get("state") in ("finished", "pruned")

    def check(self) -> None:
        """Refuse a directory that holds another experiment.

        Raises:
            ValueError: naming what differs.
        """
        if not (self.path / "config.yaml").is_file():
            return
        changed = differences(Run.open(self.path).experiment.to_dict(), self.experiment.to_dict())
        if changed:
            raise ValueError(
                f"run directory {str(self.path)!r} holds another experiment: {'; '.join(changed)}; "
                "delete it or choose another folder"
            )

    def packed(self) -> dict[str, Any]:
        """Plain values that travel to other processes, for :meth:`unpack`."""
        return {"name": self.name, "experiment": self.experiment.to_dict(), "path": str(self.path), "id": self.id}

    @classmethod
    def unpack(cls, values: Mapping[str, Any]) -> Job:
        """The job that :meth:`packed` gave."""
        experiment = make_experiment(values["experiment"])
        return cls(values["name"], experiment, Path(values["path"]), values["id"])


def differences(first: Mapping[str, Any], second: Mapping[str, Any], prefix: str = "") -> list[str]:
    """The keys whose values differ between two resolved experiments, and both values; not those of FREE."""
    found: list[str] = []
    for key in dict.fromkeys([*first, *second]):
        name = prefix + key
        one, other = first.get(key), second.get(key)
        if name in FREE or one == other:
            continue
        if isinstance(one, Mapping) and isinstance(other, Mapping):
            found += differences(one, other, f"{name}.")
        else:
            found.append(f"{name} = {one!r} there, {other!r} wanted")
    return found


def perform(job: Job, *, watch: Watch | None = None, stop: Callable[[], bool] | None = None) -> Outcome:
    """Make a run, or go on with it from its checkpoint; what it says goes to train.log in its directory.

    Args:
        job: the run.
        watch, stop: as for :func:`algorithms.experiments.training.train`.

    Returns:
        "stopped" if a signal or ``stop`` ended it early; it is saved then.

    Raises:
        InUse: if another process trains in the directory.
        ValueError: for a directory that holds something else, or an experiment that cannot be built.
        Stopped: if something could not be written.
    """
    if job.done:
        return "already there"
    try:
        run, begun = _take(job)
    except OSError as error:
        raise stopped(f"the run cannot be written: {error}", error) from error
    try:
        if job.done:  # by the process that held it until now
            return "already there"
        _keep_wandb_id(job)
        agent = resume(run)
        with (job.path / "train.log").open("a") as log:
            console = Console(file=log, width=120)
            if train(run, agent, console, resumed=begun, watch=watch, stop=stop) is not None:
                return "stopped"
            finish(run, agent, console)
    except OSError as error:
        raise stopped(f"the run cannot be written: {error}", error) from error
    except Exception as error:
        with contextlib.suppress(OSError):  # the disk may be what failed; the error itself is on its way
            run.set_status("failed", run.status.get("step", 0), describe(error))
        raise
    finally:
        run.unlock()
    return "trained"


def _take(job: Job) -> tuple[Run, bool]:
    """The run, locked, and whether it had been begun."""
    config = job.path / "config.yaml"
    if not config.is_file():
        try:
            return Run.make(job.experiment, job.path), False
        except InUse:
            raise
        except ValueError:
            if not config.is_file():  # otherwise another process has made it meanwhile
                raise
    job.check()
    run = Run.open(job.path)
    run.lock()
    return run, True


class Failed(Exception):
    """What a run raised, in words: other processes may not know its type."""


def describe(error: BaseException) -> str:
    """An error in one line; of those that are not meant for users, with its type."""
    text = " ".join(str(error).split())
    return text if isinstance(error, (ValueError, Stopped, OSError, Failed)) else f"{type(error).__name__}: {text}"


def _keep_wandb_id(job: Job) -> None:
    """Let W&B know the run by its id, wherever and however often it is made."""
    if job.id is not None and job.experiment.logging.wandb is not None:
        atomic_write(job.path / "wandb_id", f"{job.id}\n".encode())
