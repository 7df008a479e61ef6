"""A sweep on Ray Tune: embedded in this process, or on a cluster that is running."""

from __future__ import annotations

import logging
import queue
import socket
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import ray
from ray import tune
from ray.tune.schedulers import ASHAScheduler, TrialScheduler

from algorithms.common.metrics_file import read_metrics
from algorithms.experiments.dashboard import Dashboard
from algorithms.experiments.jobs import Job, describe, perform
from algorithms.experiments.run_directory import InUse, Run, read_status
from algorithms.experiments.training import DiskFull, Stopped
from algorithms.experiments.worker_pool import BUSY, DIED
from algorithms.sweeps.manifest import read_manifest
from algorithms.sweeps.scores import final_metrics
from algorithms.sweeps.settings import AshaSettings, SweepSettings

Report = dict[str, Any]
GIB = 2**30
KNOCK = 10.0  # s


class RunTrainable(tune.Trainable):
    """A run of the sweep as a Tune trial: it reports every evaluation, per objective, and the final one.

    The run's directory is its checkpoint: a trial that is begun again, by whatever actor, goes on from there. Training
    has a thread of its own, so that Tune is answered, and its wish to stop heard, at any time.
    """

    def setup(self, config: dict[str, Any]) -> None:
        """Begin."""
        self._reports: queue.SimpleQueue[Report | BaseException] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._last: Report = {}
        self._thread = threading.Thread(
            target=self._work, args=(config, self._reports, self._stop), daemon=True, name="training"
        )
        self._thread.start()

    def reset_config(self, new_config: dict[str, Any]) -> bool:
        """Begin another run in the same process."""
        self.cleanup()
        self.setup(new_config)
        return True

    def step(self) -> Report:
        """The next report; raises what the run raised where another try may help."""
        report = self._reports.get()
        if isinstance(report, BaseException):
            raise report
        self._last = {**self._last, **report}
        return self._last

    def cleanup(self) -> None:
        """Stop, which saves."""
        self._stop.set()
        self._thread.join()

    @staticmethod
    def _work(
        config: dict[str, Any], reports: queue.SimpleQueue[Report | BaseException], stop: threading.Event
    ) -> None:
        def watch(step: int, metrics: Mapping[str, float]) -> None:
            if any(name.startswith("eval/") for name in metrics):
                reports.put({"step": step, **metrics})

        try:
            sweep = Path(config["sweep"])
            (job,) = (row.job(sweep) for row in read_manifest(sweep) if row.id == config["run"]["id"])
            for step, metrics in _evaluations(job):
                watch(step, metrics)
            while not stop.is_set():
                try:
                    if perform(job, watch=watch, stop=stop.is_set) == "stopped":
                        break
                    final = {f"final/{name}": value for name, value in final_metrics(job.path).items()}
                    reports.put({**final, "done": True})
                    return
                except InUse:
                    stop.wait(BUSY)
            reports.put({"done": True, "stopped": True})
        except DiskFull as error:
            reports.put({"done": True, "error": describe(error), "disk_full": True})
        except (Stopped, OSError) as error:
            reports.put(RuntimeError(describe(error)))
        except Exception as error:  # it would only repeat itself
            reports.put({"done": True, "error": describe(error)})


def _evaluations(job: Job) -> list[tuple[int, dict[str, float]]]:
    """What a run that has been begun has already logged up to its last checkpoint: early stopping must know it."""
    path = job.path / "metrics.csv"
    if not path.is_file():
        return []
    columns = read_metrics(path)
    steps = columns.pop("step")
    last = read_status(job.path).get("step", 0)
    return [
        (int(step), {name: float(column[i]) for name, column in columns.items() if not np.isnan(column[i])})
        for i, step in enumerate(steps)
        if step <= last
    ]


class _Asha(ASHAScheduler):
    """Successive halving that remembers whom it stopped."""

    def __init__(self, settings: AshaSettings, most: int):
        super().__init__(
            time_attr="step",
            metric=f"eval/{settings.metric}",
            mode=settings.direction[:3],
            max_t=most,
            grace_period=min(settings.grace_period, most),
            reduction_factor=settings.reduction_factor,
            stop_last_trials=False,
        )
        self.pruned: set[str] = set()

    def on_trial_result(self, tune_controller: Any, trial: Any, result: Report) -> str:
        decision = super().on_trial_result(tune_controller, trial, result)
        if decision == TrialScheduler.STOP and not result.get("done"):
            self.pruned.add(trial.config["run"]["id"])
        return decision


class _Here:
    """Belongs to this process: of what Tune saves of a sweep nothing is read again, the run directories tell."""

    def __getstate__(self) -> dict[str, Any]:
        return {}


class _Listener(_Here, tune.Callback):
    """Shows the progress and keeps the errors."""

    def __init__(self, jobs: Sequence[Job], monitor: Dashboard):
        self._jobs = {job.id: job for job in jobs}
        self._monitor = monitor
        self.failed: dict[Job, str] = {}
        self.disk_full: str | None = None

    def on_step_end(self, iteration: int, trials: list[Any], **info: Any) -> None:
        self._monitor.update()

    def on_trial_result(self, iteration: int, trials: list[Any], trial: Any, result: Report, **info: Any) -> None:
        if "error" in result:
            self._note(trial, result["error"])
        if "disk_full" in result:
            self.disk_full = result["error"]

    def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        text = str(trial.get_error() or trial.get_pickled_error() or "")
        died = "ActorDiedError" in text or "ActorUnavailableError" in text or "OutOfMemoryError" in text
        self._note(trial, DIED if died else text.strip().splitlines()[-1])

    def _note(self, trial: Any, reason: str) -> None:
        job = self._jobs[trial.config["run"]["id"]]
        self.failed[job] = reason
        self._monitor.failed(job, reason)


class _Stopper(_Here, tune.Stopper):
    """Ends everything when asked to; what is going on is saved."""

    def __init__(self, stop: Callable[[], bool]):
        self._asked = stop

    def __call__(self, trial_id: str, result: Report) -> bool:
        return False

    def stop_all(self) -> bool:
        return self._asked()


def make_on_ray(
    jobs: Sequence[Job],
    settings: SweepSettings,
    sweep: Path,
    monitor: Dashboard,
    *,
    stop: Callable[[], bool],
    address: str | None = None,
    workers: int | None = None,
) -> dict[Job, str]:
    """Make the runs as trials of Ray Tune.

    Args:
        jobs: the runs; those that are done are passed over (with early stopping, reported from their files).
        settings: the sweep's.
        sweep: its directory, which all nodes see under the same path.
        monitor: shows the progress.
        stop: asked several times a second; True saves what is going on and returns.
        address: of a running cluster, or "auto"; None starts Ray within this process and ends it afterwards.
        workers: runs at a time; None for as many as Ray has resources for.

    Returns:
        The jobs that failed, each with its reason.

    Raises:
        Stopped: if there is no such cluster.
        DiskFull: when there is no space left.
    """
    asha = None if settings.ray.asha is None else _Asha(settings.ray.asha, max(map(_steps, jobs)))
    wanted = [job for job in jobs if asha is not None or not job.done]
    # Runs that have been begun tell early stopping first how they were.
    wanted.sort(key=lambda job: -read_status(job.path).get("step", 0))
    listener = _Listener(wanted, monitor)
    _connect(address)
    try:
        tuner = tune.Tuner(
            tune.with_resources(RunTrainable, _resources(settings)),
            param_space={
                "sweep": str(sweep.resolve()),
                "run": tune.grid_search([{"id": job.id, "name": job.name} for job in wanted]),
            },
            tune_config=tune.TuneConfig(
                scheduler=asha,
                reuse_actors=True,
                max_concurrent_trials=workers,
                trial_name_creator=_name,
                trial_dirname_creator=_name,
            ),
            run_config=tune.RunConfig(
                name=time.strftime("%Y%m%d-%H%M%S"),
                storage_path=str(sweep.resolve() / "ray"),
                checkpoint_config=tune.CheckpointConfig(checkpoint_at_end=False),  # a run's directory is its checkpoint
                failure_config=tune.FailureConfig(max_failures=settings.retries),
                callbacks=[listener],
                stop=_Stopper(lambda: stop() or listener.disk_full is not None),
                verbose=0,
            ),
        )
        tuner.fit()
    finally:
        ray.shutdown()
    if listener.disk_full is not None:
        raise DiskFull(listener.disk_full)
    pruned = set() if asha is None else asha.pruned
    for job in wanted:
        if job.id in pruned and not job.done:
            run = Run.open(job.path)
            run.set_status("pruned", run.status.get("step", 0))
    return {job: reason for job, reason in listener.failed.items() if not job.done}


def _steps(job: Job) -> int:
    return job.experiment.training.total_timesteps


def _name(trial: Any) -> str:
    return str(trial.config["run"]["id"])


def _resources(settings: SweepSettings) -> dict[str, float]:
    needs = settings.resources
    memory = {} if needs.memory_gb is None else {"memory": needs.memory_gb * GIB}
    return {"cpu": needs.cpus, **({"gpu": needs.gpus} if needs.gpus else {}), **memory}


def _connect(address: str | None) -> None:
    """Begin with Ray: embedded, or on a running cluster.

    Raises:
        Stopped: if there is none.
    """
    quiet = {"log_to_driver": False, "logging_level": logging.ERROR}
    try:
        if address is None:
            ray.init(address="local", include_dashboard=False, **quiet)
        else:
            _knock(address)
            ray.init(address=address, **quiet)
    except (OSError, ValueError) as error:
        hint = "if the cluster asks for a token, set RAY_AUTH_MODE=token"
        raise Stopped(f"--address {address}: {' '.join(str(error).split())} ({hint})") from None


def _knock(address: str) -> None:
    """Find out quickly whether anybody is at ``host:port``; Ray itself tries for minutes.

    Raises:
        OSError: if nobody is.
    """
    host, _, port = address.rpartition(":")
    if host and port.isdecimal() and "/" not in host:
        socket.create_connection((host, int(port)), timeout=KNOCK).close()
