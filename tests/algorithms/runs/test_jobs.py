"""Jobs: runs are made once, resumed where they were stopped, a crash or a kill included, and never mixed up."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from algorithms.runs.config import make_experiment
from algorithms.runs.interrupts import DiskFull, JobFailed, Stopped
from algorithms.runs.jobs import DIED, Job, WorkerDied, perform, perform_all, verdict
from algorithms.runs.progress import Dashboard
from algorithms.runs.run_directory import InUse, Run, read_status
from tests.helpers.short_runs import VALUES, assert_same_run, assert_whole, job, quiet
from tests.helpers.sweep_files import eventually


def test_a_directory_with_another_experiment_is_refused_before_anything_starts(tmp_path: Path) -> None:
    perform(job(tmp_path))
    other = Job("other", job(tmp_path, total_timesteps=961).experiment, tmp_path / "seed0")
    fresh = job(tmp_path, seed=1)
    with pytest.raises(ValueError, match=r"training.total_timesteps = 960 there, 961 wanted"):
        perform_all([fresh, other], 1, Dashboard([], quiet()))
    assert not fresh.path.exists()


def with_device(wanted: Job, device: str) -> Job:
    """The same job on another device, which this machine need not have."""
    values = wanted.experiment.to_dict()
    values["training"]["device"] = device
    return replace(wanted, experiment=make_experiment(values, here=False))


def test_a_run_that_was_started_takes_over_device_and_logging_but_not_threads(tmp_path: Path) -> None:
    wanted = job(tmp_path, threads=1)
    Run.create(with_device(wanted, "cuda:99").experiment, wanted.path).unlock()
    changed = job(tmp_path, threads=2).experiment
    logging = changed.logging.model_copy(update={"checkpoint_interval": 77})
    changed = changed.model_copy(update={"logging": logging})
    assert perform(replace(wanted, experiment=changed), stop=lambda: True) == "stopped"
    experiment = Run.open(wanted.path).experiment
    assert (experiment.training.device, experiment.training.threads) == ("cpu", 1)
    assert experiment.logging.checkpoint_interval == 77
    before = (wanted.path / "config.yaml").stat()
    assert perform(replace(wanted, experiment=changed)) == "trained"
    assert (wanted.path / "config.yaml").stat() == before


def test_what_a_killed_process_leaves_incomplete_is_made_again(tmp_path: Path) -> None:
    wanted = job(tmp_path)
    wanted.path.mkdir()
    for name in (".lock", ".config.yaml.abcdefgh.tmp", "versions.json", "status.json"):
        (wanted.path / name).write_text("{")
    assert perform(wanted) == "trained"
    assert not list(wanted.path.glob(".*.tmp"))
    (wanted.path / ".metrics.csv.abcdefgh.tmp").write_text("torn")
    Run.open(wanted.path).lock()
    assert not list(wanted.path.glob(".*.tmp"))


OWN_CODE = "def utility(returns):\n    return returns[..., 0]\n"


def test_a_job_may_import_what_its_own_experiment_names_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "jobs_code.py").write_text(OWN_CODE)
    (tmp_path / "other_code.py").write_text(OWN_CODE)
    monkeypatch.syspath_prepend(tmp_path)
    experiment = make_experiment({**VALUES, "utility": {"name": "jobs_code:utility"}})
    wanted = Job.unpack(Job("own", experiment, tmp_path / "own").packed())
    assert perform(wanted, stop=lambda: True) == "stopped"
    assert wanted.open().status["state"] == "interrupted"
    config = wanted.path / "config.yaml"
    text = config.read_text()
    config.write_text(text.replace("jobs_code:utility", "other_code:utility"))
    with pytest.raises(
        ValueError, match=r"has utility\.name = 'other_code:utility', code that would be imported and run"
    ):
        perform(wanted)
    assert "other_code" not in sys.modules
    config.write_text(text)
    assert perform(wanted) == "trained"


@pytest.mark.parametrize(
    ("error", "verdicts"),
    [
        (DiskFull("full"), ["stop", "stop", "stop"]),
        (InUse("held"), ["wait", "wait", "wait"]),
        (WorkerDied("killed"), ["retry", "retry", "fail"]),
        (Stopped("unwritable"), ["retry", "retry", "fail"]),
        (OSError("unreadable"), ["retry", "retry", "fail"]),
        (JobFailed("KeyError: 'x'"), ["fail", "fail", "fail"]),
        (ValueError("invalid"), ["fail", "fail", "fail"]),
    ],
)
def test_what_a_retry_may_mend_is_retried_as_often_as_allowed(error: Exception, verdicts: list[str]) -> None:
    assert [verdict(error, attempts, retries=2) for attempts in (1, 2, 3)] == verdicts


# ----------------------------------------------------------------------------------------------------- worker processes


def with_workers(test: Callable[..., None]) -> Callable[..., None]:
    """Mark a test that starts and kills processes."""
    marks = (pytest.mark.processes, pytest.mark.slow, pytest.mark.skipif(os.name != "posix", reason="signals"))
    for mark in marks:
        test = mark(test)
    return test


def make(jobs: list[Job], workers: int = 1, **options: object) -> dict[Job, str]:
    return perform_all(jobs, workers, Dashboard(jobs, quiet()), **options)


def saved(wanted: Job) -> bool:
    return read_status(wanted.path).get("step", 0) > 0


@with_workers
def test_jobs_in_parallel_give_the_same_runs_as_alone_and_are_not_repeated(tmp_path: Path) -> None:
    together = [job(tmp_path / "together", seed) for seed in (0, 1, 2)]
    assert make(together, 2) == {}
    alone = job(tmp_path / "alone", 1)
    perform(alone)
    assert_same_run(together[1].path, alone.path)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}
    assert make(together, 2) == {}
    assert before == {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}


@with_workers
def test_a_run_whose_worker_always_dies_fails_with_a_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "deadly.py").write_text(
        "import multiprocessing, os, signal\n"
        "def utility(returns):\n"
        "    if multiprocessing.parent_process() is not None:\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "    return returns[..., 0]\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    deadly = Job("deadly", make_experiment({**VALUES, "utility": {"name": "deadly:utility"}}), tmp_path / "deadly")
    good = job(tmp_path)
    failed = make([deadly, good], 1, retries=2)
    assert failed == {deadly: f"{DIED}, 3 times"}
    assert good.done
    status = read_status(deadly.path)
    assert (status["state"], status["reason"]) == ("failed", failed[deadly])


@with_workers
def test_workers_save_and_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    wanted = job(tmp_path, total_timesteps=2_000_000, num_envs=256)
    context = multiprocessing.get_context("fork")
    driver = context.Process(target=make, args=([wanted],))
    driver.start()
    eventually(lambda: saved(wanted))
    assert driver.pid is not None
    os.kill(driver.pid, signal.SIGKILL)
    driver.join()
    eventually(lambda: read_status(wanted.path)["state"] == "interrupted", 30)
    run = Run.open(wanted.path)
    eventually(lambda: lockable(run), 30)


def lockable(run: Run) -> bool:
    try:
        run.lock()
    except ValueError:
        return False
    run.unlock()
    return True


@with_workers
def test_workers_killed_at_random_lose_nothing_and_repeat_nothing(tmp_path: Path) -> None:
    jobs = [job(tmp_path / "killed", seed, total_timesteps=8_000, num_envs=8) for seed in range(16)]
    generator = random.Random(0)
    kills = 0
    over = threading.Event()

    def killer() -> None:
        nonlocal kills
        while not over.is_set():
            enough = sum(wanted.done for wanted in jobs) + generator.randint(1, 2)
            while not over.wait(0.05) and sum(wanted.done for wanted in jobs) < enough:
                pass
            over.wait(generator.uniform(0.0, 0.2))
            workers = [child.pid for child in multiprocessing.active_children() if child.pid is not None]
            if workers and not over.is_set():
                os.kill(generator.choice(workers), signal.SIGKILL)
                kills += 1

    thread = threading.Thread(target=killer)
    thread.start()
    try:
        failed = make(jobs, 2, retries=1000)
    finally:
        over.set()
        thread.join()
    assert failed == {}
    assert kills >= 3
    assert sorted(path.name for path in (tmp_path / "killed").iterdir()) == sorted(wanted.path.name for wanted in jobs)
    for wanted in jobs:
        assert wanted.done
        assert_whole(wanted.path)
    for seed in (0, 15):
        whole = job(tmp_path / "whole", seed, total_timesteps=8_000, num_envs=8)
        perform(whole)
        assert_same_run(jobs[seed].path, whole.path)
