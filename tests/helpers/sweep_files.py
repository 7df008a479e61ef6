"""Sweeps whose runs take a second or less, and scripts/sweep.py to train them."""

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

from algorithms.runs import jobs as pool
from tests.helpers.paths import REPOSITORY
from tests.helpers.short_runs import VALUES, assert_same_run, assert_whole

ROOT = REPOSITORY
PATIENCE = 600.0  # s: ends what hangs, and never what is slow because other tests use all cores


@dataclass(frozen=True)
class Reference:
    """A sweep's file, and its directory after training on this machine without interruption."""

    file: Path
    directory: Path


def write_sweep(folder: Path, **settings: Any) -> Path:
    """A sweep's file in ``folder``, based on the short experiment, by default with two learning rates."""
    base = folder / "base.yaml"
    base.write_text(yaml.safe_dump(VALUES))
    if "search" not in settings:
        settings.setdefault("grid", {"algorithm.learning_rate": [0.001, 0.003]})
    path = folder / "short.yaml"
    path.write_text(yaml.safe_dump({"config": str(base), **settings}))
    return path


def sweep_command(file: Path, *options: str | Path) -> list[str]:
    return [sys.executable, str(ROOT / "scripts" / "sweep.py"), "--config", str(file), *map(str, options)]


def run_sweep(
    file: Path, *options: str | Path, environment: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run the script; its output is printed, so that pytest shows it if the test fails."""
    done = subprocess.run(
        sweep_command(file, *options),
        env=dict(environment or os.environ),
        cwd=file.parent,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    print(done.stdout, done.stderr)
    return done


@contextlib.contextmanager
def start_sweep(
    file: Path, *options: str | Path, environment: Mapping[str, str] | None = None
) -> Iterator[subprocess.Popen[str]]:
    """Start the script; it is killed at the end of the context."""
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
    return [sweep / json.loads(line)["directory"] for line in (sweep / "manifest.jsonl").read_text().splitlines()]


def status(run: Path) -> dict[str, Any]:
    """The content of a run's status.json; empty if there is none."""
    try:
        return json.loads((run / "status.json").read_text())
    except FileNotFoundError:
        return {}


def runs_in_progress(sweep: Path) -> list[Path]:
    return [
        run
        for run in (sweep / "runs").glob("*")
        if status(run).get("step", 0) > 0 and status(run)["state"] == "running"
    ]


def broken_utility(folder: Path, where: str) -> str:
    """Write a utility that fails in training if an environment variable is set; returns its name for the YAML file."""
    (folder / "broken.py").write_text(
        "import os\n"
        "def utility(returns):\n"
        f"    if returns.any() and {where!r} in os.environ:\n"
        "        raise RuntimeError('no [red] licence on this node')\n"
        "    return returns[..., 0]\n"
    )
    return "broken:utility"


def long_runs(folder: Path) -> dict[str, Any]:
    """Write a utility that waits, for some ten seconds per run, most of them idle; returns overrides that use it."""
    (folder / "waiting.py").write_text(
        "import time\ndef utility(returns):\n    time.sleep(0.04)\n    return returns[..., 0]\n"
    )
    return {"training.total_timesteps": 40_000, "training.num_envs": 64, "utility.name": "waiting:utility"}


def own_algorithm(folder: Path) -> str:
    """Copy the worked example of an own algorithm; returns its name for the YAML file."""
    (folder / "kl_penalty.py").write_bytes((ROOT / "docs" / "examples" / "kl_penalty.py").read_bytes())
    return "kl_penalty:KLPenalty"


def eventually(condition: Callable[[], Any], seconds: float = PATIENCE) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "the condition did not hold in time"
        time.sleep(0.05)


def interrupt(process: subprocess.Popen[str], number: int = signal.SIGINT) -> tuple[int, str]:
    process.send_signal(number)
    out, _ = process.communicate(timeout=120)
    print(out)
    return process.returncode, out


def assert_same_sweep(first: Path, second: Path) -> None:
    """Both have the same manifest, byte for byte, and the same complete runs: weights, curves and final metrics."""
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
    """Fork worker processes from one that has imported everything, instead of starting new interpreters.

    Not from this one, of which Polars' threads would be missing.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["algorithms.runs.training", "tests.helpers.sweep_files"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            pool._Workers,
            "_executor",
            staticmethod(lambda: ProcessPoolExecutor(1, context, _begin_worker, (dict(os.environ),))),
        )
        yield


def _begin_worker(environment: dict[str, str]) -> None:
    os.environ.clear()
    os.environ.update(environment)
    pool._begin_worker()


@contextlib.contextmanager
def small_disk(folder: Path, kilobytes: int) -> Iterator[None]:
    """A small file system at ``folder``; skips the test if this process may not mount one."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "none", str(folder)]
    try:
        mounted = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip("there is no mount command")
    if mounted.returncode:
        pytest.skip(f"this process cannot mount a file system: {mounted.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def enlarge_disk(folder: Path, kilobytes: int) -> None:
    """Make a :func:`small_disk` larger."""
    subprocess.run(["mount", "-o", f"remount,size={kilobytes}k", str(folder)], check=True)
