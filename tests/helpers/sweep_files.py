"""Sweeps of runs of a second or less, and the command line that runs them."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

from algorithms.experiments import worker_pool as pool
from tests.helpers.paths import REPOSITORY
from tests.helpers.short_runs import VALUES, assert_same_run, assert_whole

ROOT = REPOSITORY
LONG = {"training.total_timesteps": 500_000, "training.num_envs": 64}  # some seconds


@dataclass(frozen=True)
class Reference:
    """A sweep's file, and the directory of that sweep run without interruption on this machine."""

    file: Path
    directory: Path


def write_sweep(folder: Path, **settings: Any) -> Path:
    """Write a sweep's file in ``folder``: the short experiment as its base and, by default, two learning rates."""
    base = folder / "base.yaml"
    base.write_text(yaml.safe_dump(VALUES))
    if "search" not in settings:
        settings.setdefault("grid", {"algorithm.learning_rate": [0.001, 0.003]})
    path = folder / "short.yaml"
    path.write_text(yaml.safe_dump({"config": str(base), **settings}))
    return path


def sweep_command(file: Path, *options: str | Path) -> list[str]:
    """The command line of scripts/sweep.py."""
    return [sys.executable, str(ROOT / "scripts" / "sweep.py"), "--config", str(file), *map(str, options)]


def run_sweep(
    file: Path, *options: str | Path, environment: Mapping[str, str] | None = None, timeout: float = 300.0
) -> subprocess.CompletedProcess[str]:
    """Run the command line to its end and print its output, so that pytest shows it where a test fails."""
    done = subprocess.run(
        sweep_command(file, *options),
        env=dict(environment or os.environ),
        cwd=file.parent,
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )
    print(done.stdout, done.stderr)
    return done


@contextlib.contextmanager
def start_sweep(
    file: Path, *options: str | Path, environment: Mapping[str, str] | None = None
) -> Iterator[subprocess.Popen[str]]:
    """Start the command line; it is killed at the end of the context."""
    process = subprocess.Popen(
        sweep_command(file, *options),
        env=dict(environment or os.environ),
        cwd=file.parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()


def runs(sweep: Path) -> list[Path]:
    """The run directories in a sweep's manifest."""
    return [sweep / json.loads(line)["directory"] for line in (sweep / "manifest.jsonl").read_text().splitlines()]


def status(run: Path) -> dict[str, Any]:
    """The content of a run's status.json; empty if there is none."""
    try:
        return json.loads((run / "status.json").read_text())
    except FileNotFoundError:
        return {}


def begun(sweep: Path) -> list[Path]:
    """Runs that have a checkpoint and are still running."""
    return [
        run
        for run in (sweep / "runs").glob("*")
        if status(run).get("step", 0) > 0 and status(run)["state"] == "running"
    ]


def broken_utility(folder: Path, where: str) -> str:
    """Write a custom utility that fails if the environment variable ``where`` is set; its name for the YAML."""
    (folder / "broken.py").write_text(
        "import os\n"
        "def utility(returns):\n"
        f"    if {where!r} in os.environ:\n"
        "        raise RuntimeError('no licence on this node')\n"
        "    return returns[..., 0]\n"
    )
    return "broken:utility"


def eventually(condition: Callable[[], Any], seconds: float = 120.0) -> None:
    """Wait until the condition holds."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"the condition did not hold within {seconds:g} seconds"
        time.sleep(0.05)


def interrupt(process: subprocess.Popen[str], number: int = signal.SIGINT) -> tuple[int, str]:
    """Send a signal and wait; the exit code and the output."""
    process.send_signal(number)
    out, _ = process.communicate(timeout=120)
    print(out)
    return process.returncode, out


def assert_same_sweep(first: Path, second: Path) -> None:
    """Assert that both sweeps have the same manifest, byte for byte, and the same runs, each once and complete."""
    assert (first / "manifest.jsonl").read_bytes() == (second / "manifest.jsonl").read_bytes()
    for sweep in (first, second):
        wanted = runs(sweep)
        assert len(set(wanted)) == len(wanted)
        assert {path.name for path in (sweep / "runs").iterdir()} == {path.name for path in wanted}
    for one, other in zip(runs(first), runs(second), strict=True):
        assert_same_run(one, other)
        assert_whole(one)
        assert_whole(other)


@contextlib.contextmanager
def forked_workers() -> Iterator[None]:
    """Fork worker processes from this one, which has imported everything, instead of starting new interpreters."""
    context = multiprocessing.get_context("fork")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            pool._Workers, "_executor", staticmethod(lambda: ProcessPoolExecutor(1, context, pool._begin_worker))
        )
        yield


@contextlib.contextmanager
def small_disk(folder: Path, kilobytes: int) -> Iterator[None]:
    """Mount a small file system at ``folder``; the test is skipped where this process may not mount one."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "none", str(folder)]
    try:
        mounted = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip("there is no mount command")
    if mounted.returncode:
        pytest.skip(f"no file system can be mounted: {mounted.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def enlarge_disk(folder: Path, kilobytes: int) -> None:
    """Make a :func:`small_disk` larger."""
    subprocess.run(["mount", "-o", f"remount,size={kilobytes}k", str(folder)], check=True)
