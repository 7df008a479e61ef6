"""Training runs of a second or less, and assertions that two runs are the same."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from safetensors.numpy import load_file

from algorithms.runs.config import make_experiment
from algorithms.runs.jobs import Job

VALUES: dict[str, Any] = {
    "environment": {"id": "mo-deepdrive-one-waypoint-v0", "arguments": {"time_limit": 1}},
    "utility": {"name": "one_waypoint_linear"},
    "algorithm": {"name": "mo_a2c", "steps": 8, "hidden": [8]},
    "training": {"total_timesteps": 960, "num_envs": 4},
    "evaluation": {"episodes": 2, "final_episodes": 4},
    "logging": {"interval": 5, "save_figures": False},
}


def job(folder: Path, seed: int = 0, **training: Any) -> Job:
    """A job whose run directory is folder/seedN."""
    values = {**VALUES, "training": {**VALUES["training"], "seed": seed, **training}}
    total = values["training"]["total_timesteps"]
    values["evaluation"] = {**VALUES["evaluation"], "interval": total // 3}
    values["logging"] = {**VALUES["logging"], "checkpoint_interval": total // 10}
    return Job(f"seed {seed}", make_experiment(values), folder / f"seed{seed}")


def quiet() -> Console:
    """A console that captures its output."""
    return Console(file=io.StringIO(), width=200)


def printed(console: Console) -> str:
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def metrics(run: Path) -> list[dict[str, str]]:
    """The rows of metrics.csv, without the columns that measure time."""
    with (run / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows
    return [{name: value for name, value in row.items() if not name.startswith("time/")} for row in rows]


def assert_same_run(first: Path, second: Path, files: Sequence[str] = ("evaluation.json", "episodes.csv")) -> None:
    """Assert that both runs are finished, with equal checkpoints, metrics and ``files``."""
    for path in (first, second):
        assert json.loads((path / "status.json").read_text())["state"] == "finished"
    one, other = (load_file(path / "checkpoint.safetensors") for path in (first, second))
    assert one.keys() == other.keys()
    assert all(np.array_equal(one[key], other[key]) for key in one)
    assert metrics(first) == metrics(second)
    for name in files:
        assert (first / name).read_bytes() == (second / name).read_bytes()


def assert_whole(run: Path) -> None:
    """Assert that a finished run has no incomplete row, no temporary file, and no step logged twice."""
    assert not list(run.glob(".*.tmp"))
    rows = metrics(run)
    assert all(None not in row and None not in row.values() for row in rows)
    steps = [int(row["step"]) for row in rows]
    assert steps == sorted(steps)
    evaluated = [int(row["step"]) for row in rows if row.get("eval/greedy/utility_esr")]
    assert len(evaluated) == len(set(evaluated))
