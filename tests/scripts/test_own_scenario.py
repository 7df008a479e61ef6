"""Training in a scenario and with an objective from outside the package, as docs/extend.md says."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from algorithms.reporting.training_log import read_metrics
from tests.helpers.paths import REPOSITORY
from tests.helpers.script_runs import Call, refused, status

pytestmark = pytest.mark.slow

SHORT = [
    "--training.total_timesteps=1000",
    "--training.num_envs=4",
    "--algorithm.hidden=[8]",
    "--environment.arguments.time_limit=1",
    "--evaluation.episodes=2",
    "--evaluation.final_episodes=4",
    "--evaluation.interval=500",
    "--logging.interval=4",
]


@pytest.fixture
def folder(examples: None, tmp_path: Path) -> Path:
    for name in ("effort.py", "two_bicycles.py", "two_bicycles.yaml"):
        shutil.copy(REPOSITORY / "docs" / "examples" / name, tmp_path)
    return tmp_path


def test_a_run_is_trained_evaluated_and_drawn(folder: Path, call: Call) -> None:
    code, out, error = call("train", "--config", "two_bicycles.yaml", "--output", "run", *SHORT)
    assert code == 0, error
    assert "return/effort" in out
    assert status(folder / "run")["state"] == "finished"
    columns = read_metrics(folder / "run" / "metrics.csv")
    assert np.nanmin(columns["train/return/effort"]) < 0.0
    assert (folder / "run" / "video.mp4").stat().st_size > 0
    refused(call("evaluate", "run"), "environment.id = 'two_bicycles:mo-deepdrive-two-bicycles-v0'", "--trust")
    code, out, error = call("evaluate", "run", "--trust", "--episodes", "2")
    assert code == 0, error
    assert "return/effort" in out
    assert call("plot", "run", "--output", "curves.png")[0] == 0
    assert (folder / "curves.png").stat().st_size > 0


def test_worker_processes_import_the_module(folder: Path, call: Call) -> None:
    keys = dict(option.removeprefix("--").split("=") for option in SHORT)
    keys["logging.save_figures"] = "false"
    overrides = "".join(f"  {key}: {value}\n" for key, value in keys.items())
    (folder / "sweep.yaml").write_text(
        f"config: two_bicycles.yaml\noverrides:\n{overrides}grid: {{algorithm.steps: [8]}}\nseeds: 1\n"
    )
    code, out, error = call("sweep", "--config", "sweep.yaml", "--output", "sweep", "--workers", "1")
    assert code == 0, out + error
    assert "1 done" in out
