"""Training, interrupting and resuming through the command line, with tiny runs."""

from __future__ import annotations

import errno
import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest
import yaml

from algorithms.reporting import videos
from algorithms.reporting.training_log import read_metrics
from mo_deepdrive.evaluation.front import Front
from mo_deepdrive.evaluation.pareto import hypervolume, non_dominated
from tests.helpers.script_runs import (
    FRONT,
    FRONT_RESULTS,
    PICTURES,
    RESULTS,
    TREASURE,
    Call,
    copied,
    interrupt,
    refused,
    status,
)
from tests.helpers.short_runs import assert_same_run

pytestmark = pytest.mark.slow

NO_FIGURES = "--logging.save_figures=false"
FILE, LEARNS_A_FRONT = ["--config", "driving.yaml"], ["--config", "front.yaml"]
CROSSING = "--environment={id: mo-deepdrive-intersection-v0, arguments: {fixed_destination: false}}"


def test_training_leaves_everything_in_its_directory(finished: Path) -> None:
    assert {path.name for path in finished.iterdir()} - {".lock"} == RESULTS
    assert status(finished)["state"] == "finished"
    assert status(finished)["step"] == 2016
    columns = read_metrics(finished / "metrics.csv")
    for name in ("train/utility", "loss/policy", "eval/greedy/utility_esr", "eval/stochastic/success"):
        assert np.isfinite(columns[name]).any(), name
    policies = json.loads((finished / "evaluation.json").read_text())["policies"]
    for policy in ("greedy", "stochastic"):
        numbers = policies[policy]
        assert numbers["utility_esr"]["low"] <= numbers["utility_esr"]["value"] <= numbers["utility_esr"]["high"]
        for name in ("utility_ser", "success", "end/collision", "end/off_lane", "end/time_limit"):
            assert name in numbers
        for name in ("return/distance", "discounted_return/distance", "mean_g_force", "max_jerk"):
            assert name in numbers
    assert (finished / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert (finished / "video.mp4").read_bytes()[4:8] == b"ftyp"
    assert len((finished / "episodes.csv").read_text().splitlines()) == 1 + 2 * 6


@pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")
def test_an_interrupted_and_resumed_run_is_the_same_run(driving: Path, call: Call) -> None:
    run, whole = driving.parent / "run", driving.parent / "whole"
    options = ["--config", driving, "--training.total_timesteps=24000", "--evaluation.interval=6000", NO_FIGURES]
    code, out, error = interrupt(run, 6_000, signal.SIGINT, *options, "--output", run)
    assert code == 130, out + error
    assert f"--resume {run}" in out
    first = status(run)
    assert first["state"] == "interrupted"
    assert 6_000 <= first["step"] < 24_000
    code, out, error = interrupt(run, first["step"] + 6_000, signal.SIGTERM, "--resume", run)
    assert code == 143, out + error
    assert first["step"] < status(run)["step"] < 24_000
    assert call("train", "--resume", run)[0] == 0
    assert call("train", *options, "--output", whole)[0] == 0
    assert_same_run(whole, run)


def test_a_full_disk_stops_training_and_the_run_can_be_resumed(
    driving: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = driving.parent / "run"
    fsync, checkpoints = os.fsync, 0

    def full(descriptor: int) -> None:
        nonlocal checkpoints
        large = os.fstat(descriptor).st_size > 10_000
        checkpoints += large
        if large and checkpoints > 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        fsync(descriptor)

    with monkeypatch.context() as context:
        context.setattr(os, "fsync", full)
        code, out, error = call("train", "--config", driving, "--output", run, "--algorithm.hidden=[32]")
    assert code == 1, out + error
    assert "error: training stopped at step" in error
    assert "No space left on device; the checkpoint of step" in error
    assert f"--resume {run}" in error
    assert status(run)["state"] == "failed"
    assert not list(run.glob("*.tmp"))
    assert call("train", "--resume", run)[0] == 0
    assert status(run)["state"] == "finished"


def test_broken_checkpoints_and_those_of_other_agents_are_refused(finished: Path, tmp_path: Path, call: Call) -> None:
    run = copied(finished, tmp_path, "interrupted")
    checkpoint, config = run / "checkpoint.safetensors", run / "config.yaml"
    whole, text = checkpoint.read_bytes(), config.read_text()
    checkpoint.write_bytes(whole[: len(whole) // 2])
    refused(call("train", "--resume", run), "checkpoint.safetensors", "cannot be read")
    checkpoint.write_bytes(whole)
    config.write_text(text.replace("hidden: [8]", "hidden: [9]"))
    refused(call("train", "--resume", run), "hidden = [8]", "[9]")
    config.write_text(yaml.safe_dump({**yaml.safe_load(text), "algorithm": {"name": "a2c", "hidden": [8]}}))
    refused(call("train", "--resume", run), "algorithm = 'mo_a2c'", "'a2c'")


BAD_INPUT: list[tuple[list[str], tuple[str, ...]]] = [
    (["--config", "nowhere.yaml"], ("'nowhere.yaml' does not exist",)),
    ([*FILE, "--algorithm.learning_rat=1"], ("did you mean 'learning_rate'?",)),
    ([*FILE, "--utility.name=one_waypoint_liner"], ("one_waypoint_linear",)),
    ([*FILE, "--utility.name=own:wrong"], ("own:wrong", "gives shape (4,)")),
    ([*FILE, "--environment.id=CartPole-v1"], ("CartPole-v1", "cannot be made")),
    ([*FILE, "surplus"], ("'surplus' is not of the form",)),
    ([*FILE, "--output", "own.py/run"], ("Not a directory: 'own.py/run'",)),
    ([*FILE, "--output", "."], ("is not empty",)),
    (["--resume", "nowhere"], ("'nowhere' is not a run directory",)),
    (["--resume", "nowhere", "--seed", "3"], ("cannot take --training.seed",)),
    ([*LEARNS_A_FRONT, CROSSING], ("algorithm 'pcn' drives one vehicle; the environment has 2",)),
    ([*LEARNS_A_FRONT, "--evaluation.reference_point=[1.0]"], ("needs 4 numbers",)),
    ([*LEARNS_A_FRONT, "--algorithm.objective_scales=[1.0]"], ("objective_scales = [1.0] needs 4 numbers",)),
    (["--config", "peers/pcn"], ("'morl_baselines.pcn' is another library's; mo-deepdrive peers runs it",)),
]


@pytest.mark.parametrize(("arguments", "messages"), BAD_INPUT)
def test_bad_input_is_refused_before_anything_starts(
    driving: Path, call: Call, arguments: list[str], messages: tuple[str, ...]
) -> None:
    (driving.parent / "own.py").write_text("def wrong(returns):\n    return returns\n")
    (driving.parent / "front.yaml").write_text(FRONT)
    before = sorted(driving.parent.iterdir())
    refused(call("train", *arguments), *messages)
    assert sorted(path for path in driving.parent.iterdir() if path.name != "__pycache__") == before


@pytest.mark.parametrize(
    ("algorithm", "name", "weights"),
    [("a2c", "deep-sea-treasure-v0", "[1, 0.1]"), ("mo_a2c", "minecart-v0", "[1, 1, 1]")],
)
def test_other_environments_can_be_trained_on(
    tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch, algorithm: str, name: str, weights: str
) -> None:
    monkeypatch.setattr(videos, "MAX_FRAMES", 100)  # an untrained policy drives the minecart for 1,000
    (tmp_path / "other.yaml").write_text(TREASURE)
    overrides = [f"--environment.id={name}", f"--utility.arguments.weights={weights}", f"--algorithm.name={algorithm}"]
    code, out, error = call("train", "--config", "other.yaml", "--seed", 2, *overrides)
    assert code == 0, out + error
    (run,) = (tmp_path / "runs" / "other").iterdir()
    assert run.name.startswith(f"{algorithm}-seed2-")
    assert {path.name for path in run.iterdir()} - {".lock"} == RESULTS
    assert "success" not in json.loads((run / "evaluation.json").read_text())["policies"]["greedy"]


# Algorithms that learn a front.


def test_a_run_of_a_front_leaves_everything_in_its_directory(finished_front: Path) -> None:
    run = finished_front
    assert {path.name for path in run.iterdir()} - {".lock"} == FRONT_RESULTS | PICTURES
    step = status(run)["step"]
    assert (status(run)["state"], step >= 6000) == ("finished", True)
    columns = read_metrics(run / "metrics.csv")
    for name in ("train/return/jerk", "loss/policy", "policy/command_error", "eval/front/hypervolume"):
        assert np.isfinite(columns[name]).any(), name
    for name in [*PICTURES, "curves.png"]:
        assert (run / name).read_bytes().startswith(b"\x89PNG")
    assert (run / "video.mp4").read_bytes()[4:8] == b"ftyp"

    front, about = Front.read(run), json.loads((run / "evaluation.json").read_text())
    assert len(front) > 2
    assert non_dominated(front.discounted).all()
    assert (front.gamma, front.episodes, front.seed) == (0.99, 1, 3_000_000)
    assert about["step"] == step
    assert about["reference_point"] == [-1.0, -0.1, -10.0, -500.0]
    numbers = {name: estimate["value"] for name, estimate in about["policies"]["front"].items()}
    assert numbers["cardinality"] == len(front)
    assert numbers["hypervolume"] == pytest.approx(hypervolume(front.discounted, about["reference_point"]))
    assert numbers["success"] == 0.0


def test_a_run_of_a_sweep_is_not_trained_longer(finished: Path, tmp_path: Path, call: Call) -> None:
    (tmp_path / "manifest.jsonl").touch()
    (tmp_path / "runs").mkdir()
    run = copied(finished, tmp_path / "runs", "finished")
    refused(call("train", "--resume", run, "--training.total_timesteps=1_000_000"), "one of the sweep")
