"""The Slurm cluster of the tests reports why it cannot start, and leaves no processes behind."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

import pytest

from tests.helpers.slurm import SlurmCluster, slurm_cluster, unavailable

pytestmark = pytest.mark.skipif(bool(unavailable()), reason=unavailable() or "available")


def submit(cluster: SlurmCluster, folder: Path, script: str, *options: str) -> str:
    """Submit a shell script that writes to "log" in the folder; returns the job's id."""
    path = folder / "script.sh"
    path.write_text(f"#!/bin/bash\n{script}\n")
    return cluster.run(
        "sbatch", "--parsable", f"--output={folder}/log", "--open-mode=append", f"--chdir={folder}", *options, str(path)
    )


def wait_for_lines(path: Path, count: int, timeout: float = 30.0) -> list[str]:
    """Wait until a file has ``count`` lines; returns them."""
    deadline = time.monotonic() + timeout
    while True:
        lines = path.read_text().splitlines() if path.exists() else []
        if len(lines) >= count:
            return lines
        assert time.monotonic() < deadline, f"{path} has {lines}"
        time.sleep(0.05)


def running(folder: Path) -> str:
    """The processes whose command line contains a folder, as printed by pgrep."""
    return subprocess.run(["pgrep", "--full", "--list-full", str(folder)], capture_output=True, text=True).stdout


def test_no_process_is_left_running(tmp_path: Path) -> None:
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
    """The state of a process in /proc: "Z" for one that has ended but has not been waited for."""
    return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]


def test_a_daemon_that_does_not_start_is_reported_with_its_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.helpers.slurm.CONFIGURATION", "NoSuchOption=1\n")
    with (
        pytest.raises(RuntimeError, match=r"slurmctld ended with 1(.|\n)*slurmctld.out(.|\n)*NoSuchOption"),
        slurm_cluster(tmp_path),
    ):
        pass
    assert running(tmp_path) == ""
