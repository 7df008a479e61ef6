"""The W&B sweep in configs/sweeps: its command, as W&B's agent calls it, trains a run that W&B can rank."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from algorithms.commands import train
from algorithms.reporting.training_log import read_metrics
from algorithms.runs.config import load_experiment
from mo_deepdrive.support.yaml import read_mapping
from tests.helpers.paths import REPOSITORY

VALUES: dict[str, Any] = {
    "training.num_envs": 8,
    "training.total_timesteps": 512,
    "evaluation.episodes": 2,
    "evaluation.final_episodes": 2,
    "algorithm.learning_rate": 5e-05,
    "algorithm.advantage": "utility_gradient",
    "algorithm.steps": 8,
}


@pytest.fixture
def definition() -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((REPOSITORY / "configs/sweeps/wandb.yaml").read_text())
    return found


def value_at(values: dict[str, Any], key: str) -> Any:
    return reduce(lambda section, name: section[name], key.split("."), values)


def test_the_command_is_the_installed_one_and_every_value_is_valid_for_the_experiment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, definition: dict[str, Any]
) -> None:
    environment, program, command, *words, given = definition["command"]
    assert (environment, program, command, given) == ("${env}", "${program}", "train", "${args}")
    options = train.main.parse(words)
    assert definition["program"] == "mo-deepdrive"
    monkeypatch.chdir(tmp_path)  # an installed package has no checkout
    for key, parameter in definition["parameters"].items():
        for value in parameter.get("values") or [parameter["min"], parameter["max"]]:
            experiment = load_experiment(options.config, [*options.overrides, f"--{key}={value}"])
            assert value_at(experiment.to_dict(), key) == value
    assert experiment.logging.wandb is not None
    assert experiment.logging.wandb.project == definition["project"]


@pytest.mark.slow
@pytest.mark.processes
def test_a_run_has_the_values_and_the_id_from_the_agent_and_the_metric_of_the_sweep(
    tmp_path: Path, definition: dict[str, Any]
) -> None:
    pytest.importorskip("wandb")
    words = [sys.executable, "-m", "mo_deepdrive", *definition["command"][2:-1]]
    variables = {"WANDB_SWEEP_ID": "sweep001", "WANDB_RUN_ID": "short001", "WANDB_MODE": "offline"}
    done = subprocess.run(
        [*words, *(f"--{key}={value}" for key, value in VALUES.items())],
        cwd=tmp_path,
        env={**os.environ, **variables, "PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    (run,) = tmp_path.glob("runs/*/*")
    config = read_mapping(run / "config.yaml")
    assert {key: value_at(config, key) for key in VALUES} == VALUES
    assert (run / "wandb_id").read_text().strip() == "short001"
    assert list(run.glob("wandb/offline-run-*-short001"))
    assert np.isfinite(read_metrics(run / "metrics.csv")[definition["metric"]["name"]]).sum() > 1
