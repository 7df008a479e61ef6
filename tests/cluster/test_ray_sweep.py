"""Sweeps on Ray give the same results as on this machine, despite killed workers, interrupts and a restarted head."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.short_runs import assert_whole
from tests.helpers.slurm import free_ports
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

pytest.importorskip("ray.tune", reason="Ray is not installed: pip install --editable '.[sweep]'")


def processes(title: str) -> list[int]:
    """Ids of the processes on this machine whose title or command line contains ``title``."""
    numbers = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):  # the process has ended meanwhile
                if title in (entry / "cmdline").read_bytes().decode(errors="replace"):
                    numbers.append(int(entry.name))
    return numbers


def kill(title: str) -> int:
    """Send SIGKILL to all such processes; returns their number."""
    numbers = [number for number in processes(title) if number != os.getpid()]
    for number in numbers:
        with contextlib.suppress(ProcessLookupError):
            os.kill(number, signal.SIGKILL)
    return len(numbers)


def test_own_code_is_trained_and_a_run_that_fails_is_reported_with_its_reason(tmp_path: Path) -> None:
    """Also where the working directory has a package of the name of ours."""
    (tmp_path / "algorithms").mkdir()
    (tmp_path / "algorithms" / "__init__.py").write_text("raise SystemExit('the wrong package')")
    utilities = ["one_waypoint_linear", broken_utility(tmp_path, "RAY_JOB_ID")]
    file = write_sweep(tmp_path, grid={"algorithm.name": [own_algorithm(tmp_path)], "utility.name": utilities})
    done = run_sweep(file, "--on", "ray", "--output", "sweep")
    assert (done.returncode, [status(run)["state"] for run in runs(tmp_path / "sweep")]) == (1, ["finished", "failed"])
    assert "1 done, 0 running, 1 failed" in done.stdout
    assert "FAILED algorithm.name=kl_penalty:KLPenalty utility.name=broken:utility seed 0" in done.stdout
    assert "no [red] licence on this node" in done.stdout


def test_embedded_ray_gives_the_same_results_and_reports_every_objective(short: Reference, tmp_path: Path) -> None:
    done = run_sweep(short.file, "--on", "ray", "--output", tmp_path)
    assert done.returncode == 0
    assert_same_sweep(short.directory, tmp_path)
    results = sorted((tmp_path / "ray").rglob("result.json"))
    assert len(results) == 6
    for path in results:
        reports = [json.loads(line) for line in path.read_text().splitlines()]
        for objective in ("distance", "destination", "g_force", "jerk"):
            assert all(f"eval/greedy/return/{objective}" in report for report in reports)
        final = json.loads(
            (tmp_path / "runs").glob(f"*-{path.parent.name}").__next__().joinpath("evaluation.json").read_text()
        )
        value = final["policies"]["greedy"]["return/distance"]["value"]
        assert reports[-1]["final/greedy/return/distance"] == value
    again = run_sweep(short.file, "--on", "ray", "--output", tmp_path)
    assert again.returncode == 0
    assert "6 done" in again.stdout


def test_killed_actors_resume_from_their_checkpoints(long: Reference, tmp_path: Path) -> None:
    with start_sweep(long.file, "--on", "ray", "--output", tmp_path / "ray") as process:
        eventually(lambda: runs_in_progress(tmp_path / "ray"))
        assert kill("ray::ResourceTrainable") >= 1
        out, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, out
    assert_same_sweep(tmp_path / "ray", long.directory)


def test_an_interrupted_sweep_is_saved_and_resumed_by_the_same_command(long: Reference, tmp_path: Path) -> None:
    with start_sweep(long.file, "--on", "ray", "--output", tmp_path / "ray", "--workers", "1") as process:
        eventually(lambda: runs_in_progress(tmp_path / "ray"))
        code, out = interrupt(process)
    assert code == 130
    assert "the same command resumes" in out
    states = {status(run).get("state") for run in runs(tmp_path / "ray")}
    assert "interrupted" in states
    assert states <= {"interrupted", "finished", None}
    assert run_sweep(long.file, "--on", "ray", "--output", tmp_path / "ray").returncode == 0
    assert_same_sweep(tmp_path / "ray", long.directory)


def test_early_stopping_prunes_the_worse_runs(tmp_path: Path) -> None:
    asha = {"metric": "greedy/utility_esr", "grace_period": 10_000, "reduction_factor": 2}
    file = write_sweep(
        tmp_path,
        overrides={"training.total_timesteps": 60_000, "training.num_envs": 64, "evaluation.interval": 10_000},
        grid={"algorithm.learning_rate": [0.003, 1e-9]},
        seeds=2,
        ray={"asha": asha},
    )
    done = run_sweep(file, "--on", "ray", "--output", tmp_path / "asha", "--workers", "1")
    assert done.returncode == 0
    states = [status(run)["state"] for run in runs(tmp_path / "asha")]
    assert set(states) == {"finished", "pruned"}
    for run in runs(tmp_path / "asha"):
        if status(run)["state"] == "pruned":
            assert status(run)["step"] < 60_000
            assert not (run / "evaluation.json").exists()
        else:
            assert_whole(run)
    before = {run: (run / "status.json").read_bytes() for run in runs(tmp_path / "asha")}
    again = run_sweep(file, "--on", "ray", "--output", tmp_path / "asha")
    assert again.returncode == 0
    assert {run: (run / "status.json").read_bytes() for run in before} == before


class Head:
    """A Ray cluster of one node, which ``--address auto`` finds with the head's environment."""

    def __init__(self, folder: Path):
        # By default Ray's processes wait 60 seconds for a head that does not answer.
        patience = {"RAY_gcs_rpc_server_reconnect_timeout_s": "5"}
        self.environment = {**os.environ, "RAY_TMPDIR": str(folder), **patience}

    def start(self) -> None:
        ray = Path(sys.executable).with_name("ray")
        (port,) = free_ports(1)
        options = ["--head", f"--port={port}", "--num-cpus=2", "--disable-usage-stats", "--include-dashboard=false"]
        done = subprocess.run(
            [ray, "start", *options], env=self.environment, capture_output=True, text=True, check=False, timeout=120
        )
        assert done.returncode == 0, done.stdout + done.stderr

    def kill(self, *names: str) -> None:
        for name in names or ("gcs_server", "raylet/raylet", "ray::", "log_monitor.py"):
            kill(name)


@pytest.fixture
def head() -> Iterator[Head]:
    with tempfile.TemporaryDirectory(
        prefix="ray-", dir="/tmp", ignore_cleanup_errors=True
    ) as folder:  # paths of sockets must be short
        started = Head(Path(folder))
        started.start()
        yield started
        started.kill()


def test_a_sweep_on_a_running_cluster_survives_the_restart_of_its_head(
    head: Head, long: Reference, tmp_path: Path
) -> None:
    sweep = tmp_path / "ray"
    options = ("--on", "ray", "--address", "auto", "--output", sweep)
    with start_sweep(long.file, *options, environment=head.environment) as process:
        eventually(lambda: runs_in_progress(sweep))
        head.kill()
        os.killpg(process.pid, signal.SIGKILL)  # it would only notice after a minute
        process.communicate(timeout=60)
    assert not all(status(run).get("state") == "finished" for run in runs(sweep))
    head.start()
    assert run_sweep(long.file, *options, environment=head.environment).returncode == 0
    assert_same_sweep(sweep, long.directory)


def test_an_unreachable_cluster_is_an_error(tmp_path: Path) -> None:
    (port,) = free_ports(1)
    done = run_sweep(
        write_sweep(tmp_path), "--on", "ray", "--address", f"127.0.0.1:{port}", "--output", tmp_path / "ray"
    )
    assert done.returncode == 1
    assert f"error: --address 127.0.0.1:{port}" in done.stderr
    assert "Traceback" not in done.stderr
