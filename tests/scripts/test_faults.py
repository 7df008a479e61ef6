"""Runs that went wrong, through the command line: their state, their message, and how they end."""

from __future__ import annotations

import json
import math
import os
import re
import signal
import subprocess
import time
from pathlib import Path

import pytest
import yaml
from safetensors.torch import load_file, save_file

from algorithms.learning.checkpoints import read_checkpoint
from tests.helpers.script_runs import TIMEOUT, Call, command, environment, refused, status

pytestmark = pytest.mark.slow

VALUES = {
    "environment": {"id": "tests.helpers.foul:foul-v0"},
    "utility": {"name": "linear", "arguments": {"weights": [1.0, 1.0]}},
    "algorithm": {"name": "mo_ppo", "hidden": [8]},
    "training": {"total_timesteps": 2560, "num_envs": 4},
    "evaluation": {"episodes": 2, "final_episodes": 2, "interval": 1280},
    "logging": {"save_figures": False},
}


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """The YAML file of an experiment on an environment of a user."""
    path = tmp_path / "own.yaml"
    path.write_text(yaml.safe_dump(VALUES))
    return path


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--environment.arguments={reward: .nan, after: 200}", "foul-v0, environment 0: reward 'gain' = nan"),
        ("--environment.arguments={observation: 1e30, after: 200}", "observation component 0 = "),
        (
            "--utility={name: tests.helpers.foul:late_root, arguments: {}}",
            "utility 'tests.helpers.foul:late_root' = nan",
        ),
        (
            "--environment.arguments={reward: .nan, after: 1000}",
            "in the final evaluation: foul-v0, environment 0:",
        ),
    ],
)
def test_a_run_that_went_wrong_fails_in_one_line_and_keeps_its_last_checkpoint(
    config: Path, tmp_path: Path, call: Call, option: str, message: str
) -> None:
    code, _, error = call("train", "--config", config, "--output", "run", "--evaluation.final_episodes=1600", option)
    assert code == 1
    (line,) = error.splitlines()
    assert re.match(r"error: in the ((update after|evaluation at) step [\d,]+|final evaluation): ", line)
    assert message in line
    found = status(tmp_path / "run")
    assert (found["state"], found["reason"]) == ("failed", line.removeprefix("error: "))
    if found["step"]:
        read_checkpoint(tmp_path / "run" / "checkpoint.safetensors", {})
    if "final" in message:
        code, _, error = call("evaluate", "run", "--trust")
        assert (code, message.removeprefix("in the final evaluation: ") in error) == (1, True), error


def test_commands_refuse_a_checkpoint_that_has_diverged(finished: Path, tmp_path: Path, call: Call) -> None:
    run = tmp_path / "run"
    run.mkdir()
    for path in finished.iterdir():
        if path.is_file():
            (run / path.name).write_bytes(path.read_bytes())
    file = run / "checkpoint.safetensors"
    tensors, identity = load_file(file), read_checkpoint(file, {})[1]
    tensors["vehicle_0.actor.body.0.weight"].fill_(math.nan)
    save_file(tensors, file, {"checkpoint": json.dumps(identity)})
    refused(call("evaluate", run), "has 'vehicle_0.actor.body.0.weight' with nan; every number must be finite")
    code, _, error = call("table", run)
    assert (code, "checkpoint.safetensors: 'vehicle_0.actor.body.0.weight' is not finite" in error) == (2, True)


@pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")
@pytest.mark.parametrize("where", ["evaluation", "warm-up"])
def test_ctrl_c_ends_an_evaluation_without_an_end(config: Path, tmp_path: Path, where: str) -> None:
    options = ["--environment.arguments={length: 0, pause: 0.01}", "--output", "run"]
    if where == "warm-up":
        config.write_text(yaml.safe_dump({**VALUES, "utility": None, "algorithm": {"name": "pcn"}}))
    process = subprocess.Popen(
        command("train", "--config", config, *options),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        env=environment(),
    )
    try:
        while not (tmp_path / "run" / "metrics.csv").exists() and process.poll() is None:
            time.sleep(0.05)
        time.sleep(1.0)
        started = time.monotonic()
        process.send_signal(signal.SIGINT)
        out, error = process.communicate(timeout=TIMEOUT)
        assert time.monotonic() - started < 60.0
    finally:
        process.kill()
    assert process.returncode == 130, out + error
    assert "interrupted at step 0; resume with: " in out
    assert "Traceback" not in error
    assert status(tmp_path / "run")["state"] == "interrupted"
