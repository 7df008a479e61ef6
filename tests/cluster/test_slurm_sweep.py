"""Sweeps on a real Slurm give the same results as on this machine, also after pre-emption, requeues and killed jobs."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.slurm import SlurmCluster, slurm_cluster, unavailable
from tests.helpers.sweep_files import (
    PATIENCE,
    Reference,
    assert_same_sweep,
    broken_utility,
    eventually,
    interrupt,
    own_algorithm,
    run_sweep,
    runs,
    runs_in_progress,
    start_sweep,
    status,
    write_sweep,
)

pytestmark = pytest.mark.skipif(bool(unavailable()), reason=unavailable() or "available")


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SlurmCluster]:
    """A cluster with a common setting: pre-empted jobs get SIGTERM."""
    with slurm_cluster(tmp_path_factory.mktemp("slurm")) as started:
        yield started


def jobs(sweep: Path) -> list[str]:
    """Ids of the submitted jobs of a sweep."""
    file = sweep / "slurm" / "jobs.json"
    return list(json.loads(file.read_text())) if file.is_file() else []


def kill_job(cluster: SlurmCluster, job: str) -> None:
    """Send SIGKILL to every Python process of an array task, as if it ran out of memory."""
    array, _, task = job.partition("_")
    marks = (f"SLURM_ARRAY_JOB_ID={array}".encode(), f"SLURM_ARRAY_TASK_ID={task}".encode())
    for number in cluster.processes():
        with contextlib.suppress(OSError):  # the process has ended meanwhile
            entry = Path("/proc") / str(number)
            values = (entry / "environ").read_bytes().split(b"\0")
            if all(mark in values for mark in marks) and b"python" in (entry / "cmdline").read_bytes():
                os.kill(number, signal.SIGKILL)


def interrupted(sweep: Path) -> list[Path]:
    """Runs that were saved before their end."""
    return [run for run in runs(sweep) if status(run).get("state") == "interrupted"]


def log(sweep: Path) -> str:
    """The output of the jobs."""
    return "\n".join(path.read_text() for path in sorted((sweep / "slurm").glob("*.out")))


def test_slurm_gives_the_same_results(cluster: SlurmCluster, short: Reference, tmp_path: Path) -> None:
    sweep = tmp_path / "slurm"
    for _ in range(2):  # the second time, nothing is left to do
        done = run_sweep(short.file, "--on", "slurm", "--output", sweep, environment=cluster.environment)
        assert done.returncode == 0, log(sweep)
        assert len(jobs(sweep)) == 3  # an array of three tasks, of two runs each
    assert_same_sweep(sweep, short.directory)


def test_own_code_is_trained_and_a_run_that_fails_is_reported_with_its_reason(
    cluster: SlurmCluster, tmp_path: Path
) -> None:
    sweep = tmp_path / "slurm"
    utilities = ["one_waypoint_linear", broken_utility(tmp_path, "SLURM_JOB_ID")]
    file = write_sweep(tmp_path, grid={"algorithm.name": [own_algorithm(tmp_path)], "utility.name": utilities})
    done = run_sweep(file, "--on", "slurm", "--output", sweep, environment=cluster.environment)
    assert (done.returncode, [status(run)["state"] for run in runs(sweep)]) == (1, ["finished", "failed"]), log(sweep)
    assert "1 done, 0 running, 1 failed" in done.stdout
    assert "FAILED algorithm.name=kl_penalty:KLPenalty utility.name=broken:utility seed 0" in done.stdout
    assert "no [red] licence on this node" in done.stdout


def test_the_dry_run_prints_a_script_that_sbatch_accepts(cluster: SlurmCluster, tmp_path: Path) -> None:
    slurm = {"partition": "main", "array_parallelism": 2, "setup": ["export GREETING=hello"], "additional": {"nice": 7}}
    file = write_sweep(tmp_path, seeds=2, resources={"cpus": 1, "memory_gb": 1.5, "minutes": 7}, slurm=slurm)
    done = run_sweep(
        file, "--on", "slurm", "--dry-run", "--output", tmp_path / "slurm", environment=cluster.environment
    )
    assert done.returncode == 0
    assert not (tmp_path / "slurm").exists()
    for line in ("--array=0-3%2", "--partition=main", "--mem=1536MB", "--time=7", "--nice=7", "--requeue"):
        assert f"#SBATCH {line}\n" in done.stdout
    assert "#SBATCH --signal=USR2@90\n" in done.stdout
    assert "\nexport GREETING=hello\n" in done.stdout
    script = tmp_path / "script.sh"
    script.write_text(done.stdout)
    answer = subprocess.run(
        ["sbatch", "--test-only", str(script)], env=cluster.environment, capture_output=True, text=True, check=False
    )
    assert answer.returncode == 0, answer.stderr


def test_a_job_near_its_time_limit_saves_requeues_itself_and_resumes(
    cluster: SlurmCluster, long: Reference, tmp_path: Path
) -> None:
    sweep = tmp_path / "slurm"
    with start_sweep(long.file, "--on", "slurm", "--output", sweep, environment=cluster.environment) as process:
        eventually(lambda: len(runs_in_progress(sweep)) == 2)
        submitted = jobs(sweep)
        for job in submitted:
            cluster.run("scancel", "--signal=USR2", job)
        eventually(lambda: interrupted(sweep), 60)
        out, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, out + log(sweep)
    assert jobs(sweep) == submitted  # requeued by themselves, not submitted again
    assert "Requeued job" in log(sweep)
    assert_same_sweep(sweep, long.directory)


def test_pre_empted_jobs_are_saved_and_resume(cluster: SlurmCluster, long: Reference, tmp_path: Path) -> None:
    sweep = tmp_path / "slurm"
    with start_sweep(long.file, "--on", "slurm", "--output", sweep, environment=cluster.environment) as process:
        eventually(lambda: len(runs_in_progress(sweep)) == 2)
        submitted = jobs(sweep)
        cluster.run("sbatch", "--partition=urgent", "--cpus-per-task=2", "--output=/dev/null", "--wrap=sleep 1")
        eventually(lambda: interrupted(sweep), 60)
        out, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, out + log(sweep)
    assert jobs(sweep) == submitted
    assert_same_sweep(sweep, long.directory)


def test_killed_jobs_are_submitted_again_and_cancelled_ones_are_not(
    cluster: SlurmCluster, long: Reference, tmp_path: Path
) -> None:
    sweep = tmp_path / "slurm"
    with start_sweep(long.file, "--on", "slurm", "--output", sweep, environment=cluster.environment) as process:
        eventually(lambda: len(runs_in_progress(sweep)) == 2)
        first, second = jobs(sweep)
        kill_job(cluster, first)
        cluster.run("scancel", second)
        out, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1, log(sweep)
    assert len(jobs(sweep)) == 3
    assert f"Slurm job {second} ended (CANCELLED)" in out
    # Slurm calls a job cancelled before its processes have ended: until then the run is being saved, or even finishes.
    eventually(lambda: not cluster.run("squeue", "--noheader"))
    assert "finished" in [status(run)["state"] for run in runs(sweep)]
    assert run_sweep(long.file, "--on", "slurm", "--output", sweep, environment=cluster.environment).returncode == 0
    assert_same_sweep(sweep, long.directory)


def test_the_submitting_command_can_be_interrupted_and_repeated_after_a_restart_of_the_controller(
    cluster: SlurmCluster, long: Reference, tmp_path: Path
) -> None:
    sweep = tmp_path / "slurm"
    options = ("--on", "slurm", "--output", sweep)
    assert run_sweep(long.file, *options, "--no-wait", environment=cluster.environment).returncode == 0
    submitted = jobs(sweep)
    assert len(submitted) == 2
    with start_sweep(long.file, *options, environment=cluster.environment) as process:
        eventually(lambda: runs_in_progress(sweep))
        code, out = interrupt(process, signal.SIGINT)
    assert code == 130
    assert f"scancel {submitted[0].partition('_')[0]}" in out
    cluster.restart_controller()
    assert run_sweep(long.file, *options, environment=cluster.environment).returncode == 0
    assert jobs(sweep) == submitted
    assert_same_sweep(sweep, long.directory)


def test_the_error_without_slurm_says_so(tmp_path: Path) -> None:
    environment = {**os.environ, "PATH": "/nowhere"}
    done = run_sweep(write_sweep(tmp_path), "--on", "slurm", "--output", tmp_path / "s", environment=environment)
    assert done.returncode == 2
    assert "Slurm is not installed" in done.stderr
