"""Runs to be made: each is trained, gone on with, or left alone where it is finished; several at a time."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from algorithms.experiment import Experiment, make_experiment
from algorithms.runs import Run
from algorithms.training import Stopped, build, finish, train

# Of a config: they say where and how loudly a run is made, not what comes out of it.
FREE = ("training.device", "training.threads", "logging")

Outcome = Literal["trained", "already there"]


@dataclass(frozen=True)
class Job:
    """A run that is wanted.

    Attributes:
        name: for messages.
        experiment: resolved.
        path: the run's directory.
    """

    name: str
    experiment: Experiment
    path: Path

    @property
    def finished(self) -> bool:
        """Whether the run is there, trained and evaluated.

        Raises:
            ValueError: if another experiment has the directory, naming what differs.
        """
        if not (self.path / "config.yaml").is_file():
            return False
        run = Run.open(self.path)
        changed = differences(run.experiment.to_dict(), self.experiment.to_dict())
        if changed:
            raise ValueError(
                f"run directory {str(self.path)!r} holds another experiment: {'; '.join(changed)}; "
                "delete it or choose another folder"
            )
        return run.status.get("state") == "finished"


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


def perform(job: Job) -> Outcome:
    """Make a run, or go on with it from its checkpoint; what it says goes to train.log in its directory.

    Raises:
        ValueError: for a directory that holds something else, or that another process trains in.
        Stopped: if something could not be written.
        KeyboardInterrupt: if SIGINT or SIGTERM came; the run is saved.
    """
    if job.finished:
        return "already there"
    begun = (job.path / "config.yaml").is_file()
    agent = build(job.experiment)
    if begun:
        run = Run.open(job.path)
        run.lock()
        if run.checkpoint.exists():
            agent.load(run.checkpoint)
    else:
        run = Run.create(job.experiment, job.path)
    try:
        with (job.path / "train.log").open("a") as log:
            console = Console(file=log, width=120)
            if train(run, agent, console, resumed=begun) is not None:
                raise KeyboardInterrupt
            finish(run, agent, console)
    finally:
        run.unlock()
    return "trained"


def _perform(name: str, experiment: dict[str, Any], path: str) -> Outcome:
    """:func:`perform` in another process, to which plain values travel."""
    try:
        return perform(Job(name, make_experiment(experiment), Path(path)))
    except KeyboardInterrupt:
        os._exit(130)  # everything is saved; a worker that lived on would take the next job from its queue


def _apart() -> None:
    """Ctrl-C reaches the parent alone, which stops the workers by one signal: a second would not let them save."""
    if os.name == "posix":
        os.setsid()


def perform_all(jobs: Sequence[Job], workers: int, console: Console) -> list[tuple[Job, str]]:
    """Make the runs that are missing, ``workers`` at a time, each in a worker process.

    Args:
        jobs: those that are finished are passed over.
        workers: processes.
        console: for the progress.

    Returns:
        The jobs that failed, each with its error.

    Raises:
        ValueError: before anything starts, if a directory holds another experiment.
        Stopped: if a worker process died.
        KeyboardInterrupt: if the user stops it; what was being trained has been saved.
    """
    missing = [job for job in jobs if not job.finished]
    failed: list[tuple[Job, str]] = []
    if not missing:
        return failed
    columns = (TextColumn("runs"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with (
        ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _apart) as pool,
        Progress(*columns, console=console, disable=not console.is_terminal) as progress,
    ):
        task = progress.add_task("runs", total=len(missing))
        try:
            for job, error in _completed(pool, missing):
                progress.advance(task)
                if error is not None:
                    failed.append((job, error))
                what = "done" if error is None else f"FAILED: {error}"
                progress.console.print(f"{job.name}: {what}", markup=False, highlight=False, soft_wrap=True)
        except KeyboardInterrupt:
            for process in multiprocessing.active_children():
                process.terminate()  # SIGTERM, at which training saves
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return failed


def _completed(pool: ProcessPoolExecutor, jobs: Sequence[Job]) -> Iterator[tuple[Job, str | None]]:
    """Every job as it ends, with its error."""
    waiting: dict[Future[Any], Job] = {
        pool.submit(_perform, job.name, job.experiment.to_dict(), str(job.path)): job for job in jobs
    }
    while waiting:
        done, _ = wait(waiting, return_when=FIRST_COMPLETED)
        for future in done:
            job = waiting.pop(future)
            try:
                future.result()
            except (ValueError, Stopped, OSError) as error:
                yield job, str(error)
            except BrokenProcessPool:
                raise Stopped(
                    "a worker process died (out of memory, or killed); the same command again goes on from there"
                ) from None
            except Exception as error:
                yield job, f"{type(error).__name__}: {error}"
            else:
                yield job, None
