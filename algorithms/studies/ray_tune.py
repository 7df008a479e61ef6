"""The Ray Tune backend: runs a sweep on Ray started in this process, or on an existing cluster."""

from __future__ import annotations

import logging
import os
import queue
import socket
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import ray
from ray import tune
from ray.exceptions import RayError
from ray.tune.error import TuneError
from ray.tune.schedulers import ASHAScheduler, TrialScheduler

from algorithms.reporting.run_records import final_metrics
from algorithms.reporting.training_log import rows_until
from algorithms.runs.interrupts import DiskFull, JobFailed, Stopped, describe
from algorithms.runs.jobs import BUSY, DIED, Job, WorkerDied, perform, record, verdict
from algorithms.runs.run_directory import METRICS_FILE, read_status
from mo_deepdrive.evaluation.metrics import EVALUATION, STEP
from mo_deepdrive.support.atomic_io import own_path
from mo_deepdrive.support.machine import GIB

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from algorithms.runs.progress import Dashboard
    from algorithms.studies.settings import AshaSettings, PlanSettings

TuneReport = dict[str, Any]
CONNECT_TIMEOUT = 10.0  # s, to find out whether a cluster can be reached


class RunTrainable(tune.Trainable):  # type: ignore[misc]  # Ray's types are not checked
    """A run of the sweep as a Tune trial, which reports every evaluation during training and the final one.

    The run's directory is its checkpoint: a restarted trial resumes from it, on whatever actor. Training runs in a
    separate thread, so that the actor can respond to Tune at any time.
    """

    def setup(self, config: dict[str, Any]) -> None:
        """Start the training thread, with the working directory and the modules of who started the sweep."""
        os.chdir(config["folder"])
        if config["folder"] not in sys.path:
            sys.path.append(config["folder"])
        self._reports: queue.SimpleQueue[TuneReport | BaseException] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._last: TuneReport = {}
        self._thread = threading.Thread(target=self._train, args=(config["run"],), daemon=True)
        self._thread.start()

    def reset_config(self, new_config: dict[str, Any]) -> bool:
        """Start another run in the same process."""
        self.cleanup()
        self.setup(new_config)
        return True

    def step(self) -> TuneReport:
        """Wait for the next report; an error after which Tune should retry the run is raised."""
        report = self._reports.get()
        if isinstance(report, BaseException):
            raise report
        self._last |= report
        return {**self._last}

    def cleanup(self) -> None:
        """Stop training, which saves a checkpoint."""
        self._stop.set()
        self._thread.join()

    def _train(self, packed: dict[str, Any]) -> None:
        reports, stop = self._reports, self._stop  # reset_config replaces them

        def watch(step: int, metrics: Mapping[str, float]) -> None:
            if any(name.startswith(EVALUATION) for name in metrics):
                reports.put({STEP: step, **metrics})

        try:
            job = Job.unpack(packed)
            # What a resumed run logged up to its last checkpoint, which early stopping needs.
            logged = rows_until(job.path / METRICS_FILE, read_status(job.path).get("step", 0)).fill_nan(None)
            for row in logged.to_dicts():
                watch(row.pop(STEP), {name: value for name, value in row.items() if value is not None})
            while not stop.is_set():
                try:
                    if perform(job, watch=watch, stop=stop.is_set) == "stopped":
                        break
                    final = {f"final/{name}": value for name, value in final_metrics(job.path).items()}
                    reports.put({**final, "done": True})
                    return
                except Exception as error:
                    if verdict(error, 1, 1) != "wait":
                        raise
                    stop.wait(BUSY)
            reports.put({"done": True, "stopped": True})
        except Exception as error:
            outcome = verdict(error, 1, 1)  # Tune counts the attempts
            if outcome == "retry":
                reports.put(RuntimeError(describe(error)))
            else:
                reports.put({"done": True, "error": describe(error), "disk_full": outcome == "stop"})


class _RecordingAsha(ASHAScheduler):  # type: ignore[misc]  # Ray's types are not checked
    """Asynchronous successive halving that records which runs it pruned."""

    def __init__(self, settings: AshaSettings, max_steps: int):
        super().__init__(
            time_attr=STEP,
            metric=EVALUATION + settings.metric,
            mode=settings.direction[:3],
            max_t=max_steps,
            grace_period=min(settings.grace_period, max_steps),
            reduction_factor=settings.reduction_factor,
            stop_last_trials=False,
        )
        self.pruned: set[str] = set()

    def on_trial_result(self, tune_controller: Any, trial: Any, result: TuneReport) -> str:
        decision: str = super().on_trial_result(tune_controller, trial, result)
        if decision == TrialScheduler.STOP and not result.get("done"):
            self.pruned.add(trial.config["run"]["id"])
        return decision


class _Driver(tune.Callback, tune.Stopper):  # type: ignore[misc]  # Ray's types are not checked
    """Updates the dashboard, collects errors, and stops all trials once ``stop`` returns True or the disk is full."""

    def __init__(self, jobs: Sequence[Job], monitor: Dashboard, stop: Callable[[], bool]):
        self._jobs = {job.id: job for job in jobs}
        self._monitor, self._stop = monitor, stop
        self.failed: dict[Job, str] = {}
        self.disk_full: str | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Nothing for Tune's own checkpoints, which are not read again: the run directories have all the state."""
        return {}

    def __call__(self, _trial_id: str, _result: TuneReport) -> bool:
        return False

    def stop_all(self) -> bool:
        return self._stop() or self.disk_full is not None

    def on_step_end(self, *_arguments: Any, **_info: Any) -> None:
        self._monitor.update()

    def on_trial_result(self, *_arguments: Any, trial: Any, result: TuneReport, **_info: Any) -> None:
        if "error" in result:
            self._record(trial, JobFailed(result["error"]))
            self.disk_full = result["error"] if result["disk_full"] else self.disk_full

    def on_trial_error(self, *_arguments: Any, trial: Any, **_info: Any) -> None:
        text = str(trial.get_error() or trial.get_pickled_error() or "")
        died = "ActorDiedError" in text or "ActorUnavailableError" in text or "OutOfMemoryError" in text
        self._record(trial, WorkerDied(DIED) if died else JobFailed(text.strip().splitlines()[-1]))

    def _record(self, trial: Any, error: JobFailed) -> None:
        job = self._jobs[trial.config["run"]["id"]]
        self.failed[job] = record(job, error)
        self._monitor.failed(job, self.failed[job])


def run_on_ray(
    jobs: Sequence[Job],
    settings: PlanSettings,
    sweep: Path,
    monitor: Dashboard,
    *,
    stop: Callable[[], bool],
    address: str | None = None,
    workers: int | None = None,
) -> dict[Job, str]:
    """As :meth:`.execution.Backend.train`; with early stopping, finished runs report what they logged."""
    longest = max(job.experiment.training.total_timesteps for job in jobs)
    asha = None if settings.ray.asha is None else _RecordingAsha(settings.ray.asha, longest)
    wanted = [job for job in jobs if asha is not None or not job.done]
    # Runs that have already started come first: early stopping compares the others with them.
    wanted.sort(key=lambda job: -read_status(job.path).get("step", 0))
    needs = settings.resources
    resources = {"cpu": needs.cpus, "gpu": needs.gpus, "memory": (needs.memory_gb or 0.0) * GIB}
    driver = _Driver(wanted, monitor, stop)
    _connect(address, sweep)
    try:
        tune.Tuner(
            tune.with_resources(RunTrainable, {name: amount for name, amount in resources.items() if amount}),
            param_space={
                "folder": str(Path.cwd()),
                "run": tune.grid_search([replace(job, path=job.path.resolve()).packed() for job in wanted]),
            },
            tune_config=tune.TuneConfig(
                scheduler=asha,
                reuse_actors=True,
                max_concurrent_trials=workers,
                trial_name_creator=lambda trial: trial.config["run"]["id"],
                trial_dirname_creator=lambda trial: trial.config["run"]["id"],
            ),
            run_config=tune.RunConfig(
                name=time.strftime("%Y%m%d-%H%M%S"),
                storage_path=str(own_path(sweep.resolve(), "ray")),
                checkpoint_config=tune.CheckpointConfig(checkpoint_at_end=False),  # a run's directory is its checkpoint
                failure_config=tune.FailureConfig(max_failures=settings.retries),
                callbacks=[driver],
                stop=driver,
                verbose=0,
            ),
        ).fit()
    except (RayError, TuneError, ConnectionError) as error:  # those of runs are in their reports
        last = " ".join(str(error).strip().splitlines()[-1:])
        hint = "Ray cannot continue, perhaps because its head has died"
        raise Stopped(f"{hint}: {type(error).__name__}: {last}") from None
    finally:
        ray.shutdown()
    if driver.disk_full is not None:
        raise DiskFull(driver.disk_full)
    pruned = set() if asha is None else asha.pruned
    for job in wanted:
        if job.id in pruned and not job.done:
            run = job.open()
            run.set_status("pruned", run.status.get("step", 0))
    return {job: reason for job, reason in driver.failed.items() if not job.done}


def _connect(address: str | None, sweep: Path) -> None:
    """Start Ray in this process, or connect to a running cluster.

    Ray's workers look for packages first in the working directory of this moment; in that of the sweep they find none.
    Elsewhere, too, there may be another package ``algorithms``.
    """
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    quiet["runtime_env"] = {"worker_process_setup_hook": "mo_deepdrive.__main__.load_algorithms"}
    folder = Path.cwd()
    os.chdir(sweep)
    try:
        if address is None:
            ray.init(address="local", include_dashboard=False, **quiet)
        else:
            host, _, port = address.rpartition(":")
            if host and port.isdecimal() and "/" not in host:  # Ray itself would keep trying for minutes
                socket.create_connection((host, int(port)), timeout=CONNECT_TIMEOUT).close()
            ray.init(address=address, **quiet)
    except (OSError, ValueError) as error:
        hint = "if the cluster asks for a token, set RAY_AUTH_MODE=token"
        raise Stopped(f"--address {address}: {' '.join(str(error).split())} ({hint})") from None
    finally:
        os.chdir(folder)
