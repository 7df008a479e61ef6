"""Training, interrupting, resuming, evaluating and plotting through the real command line, with tiny runs."""

from __future__ import annotations

import csv
import errno
import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file

from algorithms import ALGORITHMS
from algorithms.logging import read_metrics

REPOSITORY = Path(__file__).resolve().parent.parent
TIMEOUT = 240
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
RESULTS = {"config.yaml", "versions.json", "status.json", "checkpoint.safetensors", "metrics.csv", "tensorboard"}
RESULTS |= {"evaluation.json", "evaluation.csv", "episodes.csv", "curves.png", "video.mp4"}

Done = tuple[int, str, str]  # exit code, standard output, standard error
Call = Callable[..., Done]


def command(script: str, *arguments: Any) -> list[str]:
    """The command line of a script, for a process of its own."""
    return [sys.executable, str(REPOSITORY / "scripts" / f"{script}.py"), *map(str, arguments)]


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(REPOSITORY), "WANDB_MODE": "disabled"}


@pytest.fixture(scope="module")
def scripts() -> dict[str, Any]:
    """The scripts as modules: ``main`` is what the command line runs, without the seconds that importing takes."""
    modules = {}
    for name in ("train", "evaluate", "plot"):
        spec = importlib.util.spec_from_file_location(name, REPOSITORY / "scripts" / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(modules[name])
    return modules


@pytest.fixture
def call(
    scripts: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Call:
    """Run a script in the test's folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)

    def call(script: str, *arguments: Any) -> Done:
        capfd.readouterr()
        code = scripts[script].main([str(argument) for argument in arguments])
        said = capfd.readouterr()
        return code, said.out, said.err

    return call


def refused(done: Done, *messages: str) -> None:
    """It ended with code 2 and one message on standard error."""
    code, out, error = done
    assert code == 2, out + error
    assert "Traceback" not in error
    message = error[error.index("error: ") :]
    for part in messages:
        assert part in message


@pytest.fixture
def driving(tmp_path: Path) -> Path:
    path = tmp_path / "driving.yaml"
    path.write_text(DRIVING)
    return path


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, made by a process of its own."""
    folder = tmp_path_factory.mktemp("finished")
    (folder / "driving.yaml").write_text(DRIVING)
    done = subprocess.run(
        command("train", "--config", "driving.yaml", "--output", "run"),
        capture_output=True,
        text=True,
        cwd=folder,
        env=environment(),
        timeout=TIMEOUT,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "run"


def status(run: Path) -> dict[str, Any]:
    return json.loads((run / "status.json").read_text())


def interrupt(run: Path, step: int, number: signal.Signals, *arguments: Any) -> Done:
    """Train in a process of its own and send it a signal when it is past ``step``."""
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
            # A resumed run begins by cutting its metrics back to the checkpoint.
            steps = read_metrics(run / "metrics.csv")["step"] if (run / "metrics.csv").exists() else []
            if len(steps) and steps[-1] >= step:
                break
            time.sleep(0.005)
        process.send_signal(number)
        out, error = process.communicate(timeout=TIMEOUT)
    finally:
        process.kill()
    return process.returncode, out, error


def test_training_leaves_everything_in_its_directory(finished: Path) -> None:
    assert {path.name for path in finished.iterdir()} - {".lock"} == RESULTS
    assert status(finished)["state"] == "finished"
    assert status(finished)["step"] == 2016
    columns = read_metrics(finished / "metrics.csv")
    for name in (
        "train/utility",
        "train/return/jerk",
        "loss/policy",
        "eval/greedy/utility_esr",
        "eval/stochastic/success",
    ):
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
    options = ["--config", driving, "--training.total_timesteps=24000", "--evaluation.interval=6000"]
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
    tensors, again = (load_file(each / "checkpoint.safetensors") for each in (whole, run))
    assert tensors.keys() == again.keys()
    for name, array in tensors.items():
        np.testing.assert_array_equal(array, again[name], err_msg=name)
    rows, resumed = (read_metrics(each / "metrics.csv") for each in (whole, run))
    assert rows.keys() == resumed.keys()
    for name in rows.keys() - {"time/steps_per_second"}:
        np.testing.assert_array_equal(rows[name], resumed[name], err_msg=name)
    assert (whole / "evaluation.json").read_text() == (run / "evaluation.json").read_text()


@pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")
def test_an_interrupted_run_on_another_environment_goes_on_to_its_end(tmp_path: Path, call: Call) -> None:
    (tmp_path / "other.yaml").write_text(TREASURE)
    run = tmp_path / "run"
    options = ["--config", "other.yaml", "--training.total_timesteps=8000", "--evaluation.interval=2000"]
    code, out, error = interrupt(run, 2_000, signal.SIGINT, *options, "--output", run)
    assert code == 130, out + error
    assert status(run)["step"] < 8_000
    code, out, error = call("train", "--resume", run)
    assert code == 0, out + error
    assert status(run) == {**status(run), "state": "finished", "step": 8_000}
    steps = read_metrics(run / "metrics.csv")["step"]
    assert (np.diff(steps) >= 0).all()


def test_a_finished_run_has_nothing_to_resume(finished: Path, call: Call) -> None:
    before = (finished / "checkpoint.safetensors").read_bytes()
    code, out, _ = call("train", "--resume", finished)
    assert code == 0
    assert "nothing to resume" in out
    assert (finished / "checkpoint.safetensors").read_bytes() == before


def test_a_full_disk_stops_training_and_the_run_can_go_on(
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


def copied(finished: Path, folder: Path, state: str) -> Path:
    """A run in folder/"run" with the config and checkpoint of another."""
    run = folder / "run"
    run.mkdir()
    for name in ("config.yaml", "versions.json", "checkpoint.safetensors"):
        (run / name).write_bytes((finished / name).read_bytes())
    (run / "status.json").write_text(json.dumps({"state": state}))
    return run


def test_broken_and_foreign_checkpoints_are_refused(finished: Path, tmp_path: Path, call: Call) -> None:
    run = copied(finished, tmp_path, "interrupted")
    checkpoint, config = run / "checkpoint.safetensors", run / "config.yaml"
    whole, text = checkpoint.read_bytes(), config.read_text()
    checkpoint.write_bytes(whole[: len(whole) // 2])
    refused(call("train", "--resume", run), "checkpoint.safetensors", "cannot be read")
    refused(call("evaluate", run), "checkpoint.safetensors", "cannot be read")
    checkpoint.write_bytes(whole)
    config.write_text(text.replace("hidden: [8]", "hidden: [9]"))
    refused(call("train", "--resume", run), "hidden = [8]", "[9]")
    config.write_text(text.replace("one-waypoint", "static-obstacle").replace("one_waypoint", "static_obstacle"))
    refused(call("evaluate", run), "environment", "mo-deepdrive-one-waypoint-v0")
    config.write_text(
        "\n".join(
            "  name: a2c" if line == "  name: mo_a2c" else line
            for line in text.splitlines()
            if not line.startswith(("  advantage", "  observe_discount"))
        )
    )
    refused(call("train", "--resume", run), "algorithm = 'mo_a2c'", "'a2c'")
    checkpoint.unlink()
    refused(call("evaluate", run), "checkpoint.safetensors")


def test_bad_input_is_refused_before_anything_starts(driving: Path, call: Call) -> None:
    folder = driving.parent
    before = sorted(folder.iterdir())
    (folder / "own.py").write_text("def wrong(returns):\n    return returns\n")
    config = ["--config", driving]
    refused(call("train", "--config", "nowhere.yaml"), "'nowhere.yaml' does not exist")
    refused(call("train", *config, "--algorithm.learning_rat=1"), "did you mean 'learning_rate'?")
    refused(call("train", *config, "--algorithm.gamma=2"), "'gamma' = 2", "less than or equal to 1")
    refused(call("train", *config, "--utility.name=one_waypoint_liner"), "one_waypoint_linear")
    refused(call("train", *config, "--utility.name=own:wrong"), "own:wrong", "gives shape (2, 4)")
    refused(call("train", *config, "--environment.id=CartPole-v1"), "CartPole-v1", "cannot be made")
    refused(call("train", *config, "surplus"), "'surplus' is not of the form")
    refused(call("train", *config, "--output", "own.py/run"), "own.py", "cannot be written")
    refused(call("train", *config, "--output", "."), "is not empty")
    refused(call("train", "--resume", "nowhere"), "'nowhere' is not a run directory")
    refused(call("train", "--resume", "nowhere", "--seed", "3"), "cannot take --seed=3")
    refused(call("evaluate", "nowhere"), "'nowhere' is not a run directory")
    refused(call("plot", "nowhere"), "'nowhere' is not a run directory")
    assert sorted(path for path in folder.iterdir() if path.name not in ("own.py", "__pycache__")) == before


def test_evaluate_prints_and_writes_its_numbers(finished: Path, tmp_path: Path, call: Call) -> None:
    options = ["--episodes", 5, "--seed", 9, "--video", "drive.mp4", "--stochastic", "--output", "numbers"]
    code, out, error = call("evaluate", finished, *options)
    assert code == 0, out + error
    for name in (
        "utility_esr",
        "utility_ser",
        "success",
        "discounted_return/jerk",
        "mean_g_force",
        "greedy",
        "stochastic",
    ):
        assert name in out
    assert (tmp_path / "drive.mp4").stat().st_size > 1000
    numbers = json.loads((tmp_path / "numbers" / "evaluation.json").read_text())
    assert (numbers["episodes"], numbers["seed"], numbers["step"]) == (5, 9, 2016)
    refused(call("evaluate", finished, "--episodes", 0), "--episodes 0")
    refused(call("evaluate", finished, "--video", "nowhere/drive.mp4"), "nowhere")


def test_evaluate_repeats_the_evaluation_at_the_end_of_training(finished: Path, tmp_path: Path, call: Call) -> None:
    code, out, error = call("evaluate", finished, "--output", "numbers")
    assert code == 0, out + error
    again = (tmp_path / "numbers" / "evaluation.json").read_text()
    assert again == (finished / "evaluation.json").read_text()


def test_plot_draws_runs(finished: Path, tmp_path: Path, call: Call) -> None:
    code, out, error = call("plot", finished, "--output", "curves.pdf")
    assert code == 0, out + error
    assert "mo_a2c: 1 seed" in out
    assert (tmp_path / "curves.pdf").read_bytes().startswith(b"%PDF")
    refused(call("plot", finished, finished), "the same seed")
    refused(call("plot", finished, "--output", "curves.xyz"), "xyz")


@pytest.mark.parametrize("algorithm", ["a2c", "mo_a2c"])
@pytest.mark.parametrize(("name", "weights"), [("deep-sea-treasure-v0", "[1, 0.1]"), ("minecart-v0", "[1, 1, 1]")])
def test_other_environments_are_trained_on(tmp_path: Path, call: Call, algorithm: str, name: str, weights: str) -> None:
    (tmp_path / "other.yaml").write_text(TREASURE)
    overrides = [f"--environment.id={name}", f"--utility.arguments.weights={weights}", f"--algorithm.name={algorithm}"]
    code, out, error = call("train", "--config", "other.yaml", "--seed", 2, *overrides)
    assert code == 0, out + error
    (run,) = (tmp_path / "runs" / "other").iterdir()
    assert run.name.startswith(f"{algorithm}-seed2-")
    assert {path.name for path in run.iterdir()} - {".lock"} == RESULTS
    assert "success" not in json.loads((run / "evaluation.json").read_text())["policies"]["greedy"]


def test_both_vehicles_of_the_intersection_are_reported(driving: Path, call: Call) -> None:
    overrides = ["--environment.id=mo-deepdrive-intersection-v0", "--utility.name=intersection_linear"]
    code, out, error = call("train", "--config", driving, *overrides, "--output", "run")
    assert code == 0, out + error
    numbers = json.loads((driving.parent / "run" / "evaluation.json").read_text())["policies"]["greedy"]
    for vehicle in ("vehicle_0", "vehicle_1"):
        assert f"{vehicle}/utility_esr" in numbers
        assert f"{vehicle}/return/lane_violation" in numbers
    header = (driving.parent / "run" / "metrics.csv").read_text().splitlines()[0].split(",")
    for name in ("success", "vehicle_0/return/distance", "vehicle_1/return/lane_violation"):
        assert f"eval/stochastic/{name}" in header


@pytest.mark.parametrize("algorithm", sorted(ALGORITHMS))
def test_the_vehicles_may_have_utilities_of_their_own(driving: Path, call: Call, algorithm: str) -> None:
    overrides = [
        "--environment.id=mo-deepdrive-intersection-v0",
        f"--algorithm.name={algorithm}",
        "--utility.name=intersection_linear",
        "--utility.vehicles.vehicle_1={name: linear, arguments: {weights: [0, 0, 2, 0, 0, 0]}}",
    ]
    code, out, error = call("train", "--config", driving, *overrides, "--output", "run")
    assert code == 0, out + error
    with (driving.parent / "run" / "episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    weights = {"distance": 0.5, "destination": 10.0, "g_force": 0.03, "collision": 4.0, "jerk": 0.0006}
    first = {**weights, "lane_violation": 0.06}
    for row in rows:
        returns = {name: float(row[f"return/{name}"]) for name in first}
        expected = 2 * returns["g_force"]
        if row["vehicle"] == "0":
            expected = sum(weight * returns[name] for name, weight in first.items())
        assert float(row["utility"]) == pytest.approx(expected, abs=1e-4)
    assert {row["vehicle"] for row in rows} == {"0", "1"}

    third = "--utility.vehicles.vehicle_2={name: linear}"
    refused(call("train", "--config", driving, *overrides[:-1], third), "utility.vehicles has 'vehicle_2'")
    foreign = "--utility.vehicles.vehicle_1={name: one_waypoint_linear}"
    refused(call("train", "--config", driving, *overrides[:-1], foreign), "one_waypoint_linear")
