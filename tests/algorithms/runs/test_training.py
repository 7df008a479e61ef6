"""Training a run: what a resumed run finds in its directory, and which runs can be trained longer."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest

import algorithms.runs.config
from algorithms import ALGORITHMS
from algorithms.runs.config import make_experiment
from algorithms.runs.jobs import Job, perform
from algorithms.runs.run_directory import changed_files, read_status
from algorithms.runs.training import reopen, train_and_finish
from mo_deepdrive.support.yaml import dump
from tests.helpers.short_runs import VALUES, assert_same_run, job, quiet

TOTAL = 960


def stopped_job(folder: Path, step: int = 320) -> Job:
    """A run that was stopped at its first checkpoint from ``step`` on, of which all rows are there."""
    wanted = job(folder)
    seen: list[int] = []
    assert (
        perform(wanted, watch=lambda at, _: seen.append(at), stop=lambda: bool(seen) and seen[-1] >= step) == "stopped"
    )
    return wanted


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")
@pytest.mark.parametrize(("algorithm", "method"), [("mo_a2c", "evaluate"), ("mo_a2c", "update"), ("pcn", "update")])
def test_a_run_that_is_interrupted_in_the_middle_resumes_to_the_same_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, algorithm: str, method: str
) -> None:
    whole, wanted = (of_length(tmp_path / name, TOTAL, algorithm, **CONSTANT[algorithm]) for name in ("whole", "run"))
    perform(whole)
    original, calls = getattr(ALGORITHMS[algorithm], method), []

    def interrupted(agent: Any, *arguments: Any) -> Any:
        calls.append(agent.step)
        result = original(agent, *arguments)
        if len(calls) == (2 if method == "evaluate" else 8):
            for _ in range(2):
                signal.raise_signal(signal.SIGINT)
        return result

    with monkeypatch.context() as patch:
        patch.setattr(ALGORITHMS[algorithm], method, interrupted)
        assert perform(wanted) == "stopped"
    status = read_status(wanted.path)
    assert status["state"] == "interrupted"
    assert 0 < status["step"] < TOTAL
    assert perform(wanted) == "trained"
    rest = ("fronts.csv", "front.csv") if algorithm == "pcn" else ("episodes.csv",)
    assert_same_run(whole.path, wanted.path, ("evaluation.json", *rest))


@pytest.mark.slow
def test_a_run_that_was_killed_after_its_checkpoint_is_resumed_silently(tmp_path: Path) -> None:
    wanted = stopped_job(tmp_path / "killed")
    with (wanted.path / "metrics.csv").open("a") as file:
        width = len((wanted.path / "metrics.csv").read_text().splitlines()[0].split(","))
        file.write("480" + ",1.0" * (width - 1) + "\n480,1.")  # written after the checkpoint; the last row is torn
    whole = job(tmp_path / "whole")
    for each in (wanted, whole):
        assert perform(each) == "trained"
    assert "warning" not in (wanted.path / "train.log").read_text()
    assert_same_run(wanted.path, whole.path)


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs the names of open files")
def test_metrics_reach_the_disk_before_each_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[str] = []
    fsync = os.fsync

    def record(descriptor: int) -> None:
        name = Path(f"/proc/self/fd/{descriptor}").readlink().name
        synced.append(name.lstrip(".").split(".")[0])
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", record)
    wanted = job(tmp_path)
    perform(wanted)
    checkpoints = [i for i, name in enumerate(synced) if name == "checkpoint"]
    assert len(checkpoints) == 11
    for i in checkpoints:
        assert synced[i - 1] == "metrics"


CONSTANT: dict[str, dict[str, Any]] = {
    "mo_a2c": {},
    "pcn": {"hidden": [8, 8], "warmup_episodes": 4, "gradient_steps": 2},
    "conditioned_mo_ppo": {"entropy_end": 0.01, "cost_growth": 0.0, "max_policies": 4},
}
GUIDES = {"vehicle_0": {"driver": "one_waypoint_linear-ppo"}}


def of_length(folder: Path, steps: int, algorithm: str, *, guides: Any = None, **settings: Any) -> Job:
    """A job of an algorithm, which learns for this number of steps."""
    known = algorithm not in ("pcn", "conditioned_mo_ppo")
    size = {} if algorithm == "pcn" else {"steps": 8, "hidden": [8]}
    arguments = {"time_limit": 1} if guides else {"time_limit": 1, "fixed_destination": True}
    values = {
        **VALUES,
        "environment": {**VALUES["environment"], "arguments": arguments},
        "utility": VALUES["utility"] if known else None,
        "algorithm": {"name": algorithm, **size, **settings},
        "training": {**VALUES["training"], "total_timesteps": steps, "guides": guides or {}},
        "evaluation": {**VALUES["evaluation"], "interval": 320},
        "logging": {**VALUES["logging"], "checkpoint_interval": 96},
    }
    return Job("", make_experiment(values), folder)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", CONSTANT)
def test_a_finished_run_is_trained_longer_as_if_it_had_been_to_be_so_long(tmp_path: Path, algorithm: str) -> None:
    whole, first = (of_length(tmp_path / f"{n}", n, algorithm, **CONSTANT[algorithm]) for n in (TOTAL, 320))
    perform(whole)
    perform(first)
    (run,), agent = reopen(str(first.path), total_timesteps=TOTAL)
    assert read_status(first.path)["state"] == "running"
    assert train_and_finish(run, agent, quiet(), resumed=True) is None
    run.unlock()
    for name in ("config.yaml", "checkpoint.safetensors", "evaluation.json"):
        assert (first.path / name).read_bytes() == (whole.path / name).read_bytes(), name
    assert changed_files(first.path) == []


@pytest.mark.parametrize(
    ("algorithm", "settings", "steps", "message"),
    [
        ("mo_a2c", {"learning_rate_end": 0.0}, 960, "cannot be trained longer, .*: algorithm.learning_rate_end = 0.0"),
        ("conditioned_mo_ppo", {}, 960, "algorithm.entropy_end = 0.001, algorithm.cost_growth = 0.15"),
        ("ppo", {"guides": GUIDES}, 960, "training.guides.vehicle_0.until = 0.5"),
        ("mo_a2c", {}, 96, "training.total_timesteps = 96 must be more than the 320 of the run"),
        ("mo_a2c", {}, "many", "'training.total_timesteps' = 'many': Input should be a valid integer"),
    ],
)
def test_runs_that_depend_on_their_length_are_not_trained_longer(
    tmp_path: Path, algorithm: str, settings: dict[str, Any], steps: Any, message: str
) -> None:
    text = dump(of_length(tmp_path / "run", 320, algorithm, **settings).experiment.to_dict())
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(ValueError, match=message):
        reopen(str(tmp_path), total_timesteps=steps)
    assert {path.name for path in tmp_path.iterdir()} <= {"config.yaml", ".lock"}
    assert (tmp_path / "config.yaml").read_text() == text


def test_a_run_is_not_trained_without_the_logger_that_it_asks_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(algorithms.runs.config.importlib.util, "find_spec", lambda _: None)
    values = {**VALUES, "logging": {**VALUES["logging"], "wandb": {"project": "p"}}}
    with pytest.raises(ValueError, match=r"logging\.wandb needs wandb: pip install --editable '\.\[wandb\]'"):
        perform(Job("", make_experiment(values), tmp_path / "run"))
    assert not (tmp_path / "run" / "checkpoint.safetensors").exists()
