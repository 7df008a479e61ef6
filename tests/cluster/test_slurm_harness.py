"""The Slurm that the cluster tests start: what it does with arrays, signals, requeued jobs, and submitit's jobs."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from slurm import CREDENTIAL_LIFETIME, SlurmCluster, slurm_cluster, unavailable

pytestmark = pytest.mark.skipif(bool(unavailable()), reason=unavailable() or "available")


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SlurmCluster]:
    with slurm_cluster(tmp_path_factory.mktemp("slurm"), cpus=4, grace=30) as started:
        yield started


def submit(cluster: SlurmCluster, folder: Path, script: str, *options: str) -> str:
    """Submit a shell script that writes to "log" in the folder; returns the job's id."""
    path = folder / "script.sh"
    path.write_text(f"#!/bin/bash\n{script}\n")
    return cluster.run(
        "sbatch", "--parsable", f"--output={folder}/log", "--open-mode=append", f"--chdir={folder}", *options, str(path)
    )


def wait_for_lines(path: Path, count: int, timeout: float = 30.0) -> list[str]:
    """The lines of a file once there are so many."""
    deadline = time.monotonic() + timeout
    while True:
        lines = path.read_text().splitlines() if path.exists() else []
        if len(lines) >= count:
            return lines
        assert time.monotonic() < deadline, f"{path} has {lines}"
        time.sleep(0.05)


def test_an_array_runs_two_tasks_at_a_time(cluster: SlurmCluster, tmp_path: Path) -> None:
    script = "echo $(date +%s.%N) 1; sleep 1; echo $(date +%s.%N) -1"
    job = submit(cluster, tmp_path, script, "--array=0-3%2")
    cluster.wait_for(job)
    assert set(cluster.states(job)) == {f"{job}_{task}" for task in range(4)}
    events = sorted(tuple(map(float, line.split())) for line in wait_for_lines(tmp_path / "log", 8))
    running = [sum(change for _, change in events[: index + 1]) for index in range(len(events))]
    assert max(running) == 2
    assert running[-1] == 0


def test_a_requeued_job_runs_again(cluster: SlurmCluster, tmp_path: Path) -> None:
    script = 'echo run ${SLURM_RESTART_COUNT:-0} >> runs; [ -n "$SLURM_RESTART_COUNT" ] || exec sleep 100'
    job = submit(cluster, tmp_path, script)
    wait_for_lines(tmp_path / "runs", 1)
    start = time.monotonic()
    cluster.run("scontrol", "requeue", job)
    assert wait_for_lines(tmp_path / "runs", 2) == ["run 0", "run 1"]
    waited = time.monotonic() - start
    print(f"run again {waited:.1f} seconds after scontrol requeue")
    assert CREDENTIAL_LIFETIME - 1 < waited < CREDENTIAL_LIFETIME + 10
    cluster.wait_for(job)


def test_signals_reach_the_shell_or_the_steps(cluster: SlurmCluster, tmp_path: Path) -> None:
    step = "trap 'echo step >> signals' USR2; echo >> ready; for _ in {1..600}; do sleep 0.05; done"
    script = f"trap 'echo shell >> signals' USR2; srun bash -c \"{step}\" & wait; wait; wait"
    job = submit(cluster, tmp_path, script)
    wait_for_lines(tmp_path / "ready", 1)
    cluster.run("scancel", "--signal=USR2", job)
    assert wait_for_lines(tmp_path / "signals", 1) == ["step"]
    cluster.run("scancel", "--signal=USR2", "--batch", job)
    assert wait_for_lines(tmp_path / "signals", 2) == ["step", "shell"]
    time.sleep(0.3)
    assert len(wait_for_lines(tmp_path / "signals", 2)) == 2
    cluster.run("scancel", job)
    cluster.wait_for(job, "CANCELLED")


def test_a_restarted_controller_loses_nothing(cluster: SlurmCluster, tmp_path: Path) -> None:
    script = "echo $SLURM_ARRAY_TASK_ID >> started; sleep 6; echo $SLURM_ARRAY_TASK_ID >> ended"
    job = submit(cluster, tmp_path, script, "--array=0-3%2")
    wait_for_lines(tmp_path / "started", 2)
    before = cluster.daemons["slurmctld"].pid
    cluster.restart_controller()
    assert cluster.daemons["slurmctld"].pid != before
    cluster.wait_for(job)
    for name in ("started", "ended"):
        assert sorted(wait_for_lines(tmp_path / name, 4)) == ["0", "1", "2", "3"]


def square(number: int) -> tuple[int, str]:
    return number**2, os.environ["SLURM_ARRAY_TASK_ID"]


class Resumable:
    """Waits in its first run; a later one, made by its checkpoint, returns at once."""

    def __init__(self, log: Path, runs: int = 0) -> None:
        self.log, self.runs = log, runs

    def __call__(self, seconds: float) -> tuple[int, str]:
        with self.log.open("a") as log:
            log.write(f"run {self.runs}\n")
        time.sleep(0.0 if self.runs else seconds)
        return self.runs, os.environ.get("SLURM_RESTART_COUNT", "0")

    def checkpoint(self, seconds: float) -> Any:
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(Resumable(self.log, self.runs + 1), seconds)


@pytest.fixture
def executor(cluster: SlurmCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """submitit's executor on the cluster, whose jobs can import this module."""
    submitit = pytest.importorskip("submitit")
    monkeypatch.setenv("SLURM_CONF", str(cluster.configuration))
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    executor = submitit.AutoExecutor(tmp_path / "submitit", cluster="slurm")
    executor.update_parameters(timeout_min=60, slurm_array_parallelism=2, mem_gb=1, cpus_per_task=1)
    return executor


def test_a_submitit_array_returns_its_results(executor: Any) -> None:
    jobs = executor.map_array(square, [2, 3, 4])
    assert [job.result() for job in jobs] == [(4, "0"), (9, "1"), (16, "2")]


@pytest.mark.parametrize("by", ["scancel", "urgent"])
def test_a_preempted_submitit_job_goes_on(cluster: SlurmCluster, executor: Any, tmp_path: Path, by: str) -> None:
    executor.update_parameters(cpus_per_task=4)
    job = executor.submit(Resumable(tmp_path / "runs"), 60.0)
    wait_for_lines(tmp_path / "runs", 1)
    if by == "scancel":
        cluster.run("scancel", "--signal=USR2", job.job_id)
    else:
        urgent = submit(cluster, tmp_path, "sleep 1", "--partition=urgent", "--cpus-per-task=4")
        cluster.wait_for(urgent)
    assert wait_for_lines(tmp_path / "runs", 2, timeout=60.0) == ["run 0", "run 1"]
    assert job.result() == (1, "1")
    cluster.wait_for(job.job_id)
    assert "Caught signal SIGUSR2" in job.stderr()
    assert "this job is preempted" in job.stderr()


def running(folder: Path) -> str:
    """The processes whose command line names a folder, as pgrep prints them."""
    return subprocess.run(["pgrep", "--full", "--list-full", str(folder)], capture_output=True, text=True).stdout


def test_nothing_is_left_running(tmp_path: Path) -> None:
    folder = tmp_path / ("long" * 30)

    def interrupted() -> None:
        with slurm_cluster(folder) as cluster:
            script = (
                "setsid --fork sleep 1000; env --ignore-environment sleep 1000 & srun bash -c 'echo >> ready'; wait"
            )
            submit(cluster, tmp_path, script)
            wait_for_lines(tmp_path / "ready", 1)
            clusters.append(cluster)
            processes.extend(cluster.processes())
            assert running(folder) != ""
            raise KeyboardInterrupt

    clusters: list[SlurmCluster] = []
    processes: list[int] = []
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert len(processes) >= 8  # munged, slurmctld and its helper, slurmd, the job's step, its shell and two sleeps
    assert clusters[0].processes() == []
    assert not [process for process in processes if Path(f"/proc/{process}").exists() and "Z" not in state(process)]
    assert running(folder) == ""
    assert not clusters[0].runtime.exists()


def state(process: int) -> str:
    """The state of a process, as /proc tells: "Z" for one that has ended and not been waited for."""
    return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]


def test_what_does_not_start_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("slurm.CONFIGURATION", "NoSuchOption=1\n")
    with (
        pytest.raises(RuntimeError, match=r"slurmctld ended with 1(.|\n)*slurmctld.out(.|\n)*NoSuchOption"),
        slurm_cluster(tmp_path),
    ):
        pass
    assert running(tmp_path) == ""
