"""Tiny runs through the command lines of the scripts."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from algorithms.reporting.training_log import read_metrics
from tests.helpers.paths import REPOSITORY

TIMEOUT = 240


def exit_code(main: Callable[[list[str]], int], *arguments: object) -> int:
    try:
        return int(main([str(argument) for argument in arguments]))
    except SystemExit as end:
        return int(end.code or 0)


DRIVING = """
environment:
  id: mo-deepdrive-one-waypoint-v0
  arguments: {time_limit: 1}
utility: {name: one_waypoint_linear}
algorithm: {name: mo_a2c, learning_rate: 1e-3, steps: 8, hidden: [8]}
training: {total_timesteps: 2000, num_envs: 4, seed: 5}
evaluation: {episodes: 4, final_episodes: 6, interval: 1000}
logging: {interval: 4}
"""
TREASURE = """
environment: {id: deep-sea-treasure-v0}
utility: {name: linear, arguments: {weights: [1, 0.1]}}
algorithm: {name: mo_a2c, steps: 8, hidden: [8]}
training: {total_timesteps: 320, num_envs: 2}
evaluation: {episodes: 2, final_episodes: 2, interval: 160}
"""
FRONT = """
environment:
  id: mo-deepdrive-one-waypoint-v0
  arguments: {time_limit: 3, fixed_destination: true}
algorithm:
  name: pcn
  learning_rate: 1e-2
  hidden: [32, 32]
  batch_size: 128
  gradient_steps: 50
  warmup_episodes: 32
  persistence: 0.95
  buffer_size: 100
  horizon_reduction: 0
  horizon_scale: 20.0
training: {total_timesteps: 6000, num_envs: 16, seed: 5}
evaluation: {episodes: 1, final_episodes: 1, interval: 1500}
logging: {interval: 2, checkpoint_interval: 1000}
"""
SEA_FRONT = """
environment: {id: deep-sea-treasure-v0}
algorithm: {name: pcn, hidden: [16, 16], gradient_steps: 5, warmup_episodes: 16, objective_scales: [20.0, 20.0]}
training: {total_timesteps: 2000, num_envs: 4}
evaluation: {episodes: 1, final_episodes: 1, interval: 400, reference_point: [0.0, -25.0]}
logging: {interval: 2, checkpoint_interval: 400}
"""
RESULTS = {"config.yaml", "versions.json", "status.json", "checkpoint.safetensors", "metrics.csv", "tensorboard"}
RESULTS |= {"evaluation.json", "curves.png", "video.mp4"}
FRONT_RESULTS = RESULTS | {"fronts.csv", "front.csv", "explore.html"}
PICTURES = {"importance.png", "reduction.png", "scatter.png"}
RESULTS |= {"evaluation.csv", "episodes.csv"}

Done = tuple[int, str, str]  # exit code, standard output, standard error
Call = Callable[..., Done]


def command(script: str, *arguments: Any) -> list[str]:
    """The command line of a command, to run it in a new process."""
    return [sys.executable, "-m", "mo_deepdrive", script, *map(str, arguments)]


def environment() -> dict[str, str]:
    """The environment variables of a script's process."""
    return {**os.environ, "PYTHONPATH": str(REPOSITORY), "WANDB_MODE": "disabled"}


def refused(done: Done, *messages: str) -> None:
    """Assert that a script ended with code 2 and one message on standard error, which contains ``messages``."""
    code, out, error = done
    assert code == 2, out + error
    assert "Traceback" not in error
    message = error[error.index("error: ") :]
    for part in messages:
        assert part in message


def status(run: Path) -> dict[str, Any]:
    return json.loads((run / "status.json").read_text())


def interrupt(run: Path, step: int, number: signal.Signals, *arguments: Any) -> Done:
    """Train in a new process and send it a signal when it is past ``step``."""
    process = subprocess.Popen(
        command("train", *arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=run.parent,
        env=environment(),
    )
    try:
        deadline = time.monotonic() + TIMEOUT
        while process.poll() is None and time.monotonic() < deadline:
            # A resumed run starts by cutting its metrics back to the checkpoint.
            steps = read_metrics(run / "metrics.csv")["step"] if (run / "metrics.csv").exists() else []
            if len(steps) and steps[-1] >= step:
                break
            time.sleep(0.005)
        process.send_signal(number)
        out, error = process.communicate(timeout=TIMEOUT)
    finally:
        process.kill()
    return process.returncode, out, error


def copied(finished: Path, folder: Path, state: str) -> Path:
    """A run in folder/"run" with the config and checkpoint of another run."""
    run = folder / "run"
    run.mkdir()
    for name in ("config.yaml", "versions.json", "checkpoint.safetensors"):
        (run / name).write_bytes((finished / name).read_bytes())
    (run / "status.json").write_text(json.dumps({"state": state}))
    return run
