"""Runs that have hardly been trained, for the tests of planning."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from algorithms.runs.build import build
from algorithms.runs.config import load_experiment
from algorithms.runs.run_directory import Run


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., Path]:
    def make(env_id: str = "mo-deepdrive-one-waypoint-v0", algorithm: str = "a2c", **arguments: Any) -> Path:
        config = tmp_path / "experiment.yaml"
        settings: dict[str, Any] = {
            "environment": {"id": env_id, "arguments": arguments},
            "algorithm": {"name": algorithm, "hidden": [4]},
            "training": {"total_timesteps": 1, "num_envs": 8},
        }
        if algorithm == "pcn":
            settings["algorithm"] |= {"warmup_episodes": 8, "gradient_steps": 1, "max_policies": 5}
        else:
            weights = [1.0] * (5 if "obstacle" in env_id else 4)
            settings["utility"] = {"name": "linear", "arguments": {"weights": weights}}
        config.write_text(json.dumps(settings), encoding="utf-8")
        experiment = load_experiment(config)
        run = Run.create(experiment, tmp_path / "untrained" / f"{algorithm}-seed0")
        agent = build(experiment)
        agent.train(1)
        agent.save(run.checkpoint)
        return run.path

    return make
