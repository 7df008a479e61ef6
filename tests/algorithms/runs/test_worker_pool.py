"""Several runs at a time: each is made once, resumed after a crash, an interrupt or a full disk, and never torn."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import threading
from pathlib import Path

import pytest

from algorithms.runs.config import make_experiment
from algorithms.runs.jobs import DIED, Job, perform, perform_all
from algorithms.runs.progress import Dashboard
from algorithms.runs.run_directory import Run, read_status
from tests.helpers.short_runs import VALUES, assert_same_run, assert_whole, job, quiet
from tests.helpers.sweep_files import eventually

pytestmark = [pytest.mark.processes, pytest.mark.slow, pytest.mark.skipif(os.name != "posix", reason="signals")]


def make(jobs: list[Job], workers: int = 1, **options: object) -> dict[Job, str]:
    return perform_all(jobs, workers, Dashboard(jobs, quiet()), **options)


def saved(wanted: Job) -> bool:
    return read_status(wanted.path).get("step", 0) > 0


def test_jobs_in_parallel_give_the_same_runs_as_alone_and_are_not_repeated(tmp_path: Path) -> None:
    together = [job(tmp_path / "together", seed) for seed in (0, 1, 2)]
    assert make(together, 2) == {}
    alone = job(tmp_path / "alone", 1)
    perform(alone)
    assert_same_run(together[1].path, alone.path)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}
    assert make(together, 2) == {}
    assert before == {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}


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
