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
from algorithms.common.metrics_file import FrontsFile, read_metrics
from algorithms.common.pareto import hypervolume, non_dominated
from algorithms.evaluation.front import Front
from tests.helpers.paths import REPOSITORY

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
  store_episodes: 100
  haste: 0
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
FRONT_RESULTS = RESULTS | {"fronts.csv", "front.csv"}
PICTURES = {"importance.png", "reduction.png", "parallel.png", "scatter.png", "bars.png"}
RESULTS |= {"evaluation.csv", "episodes.csv"}

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
            if not line.startswith(("  advantage", "  accrued_gamma", "  observe_accrued", "  observe_discount"))
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


@pytest.mark.parametrize("algorithm", sorted(name for name, cls in ALGORITHMS.items() if cls.known_utility))
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


# Algorithms that learn a front.


@pytest.fixture(scope="module")
def finished_front(scripts: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run that learnt a front."""
    folder = tmp_path_factory.mktemp("front")
    (folder / "front.yaml").write_text(FRONT)
    assert scripts["train"].main(["--config", str(folder / "front.yaml"), "--output", str(folder / "run")]) == 0
    return folder / "run"


def test_a_run_of_a_front_leaves_everything_in_its_directory(finished_front: Path) -> None:
    run = finished_front
    assert {path.name for path in run.iterdir()} - {".lock"} == FRONT_RESULTS | PICTURES
    assert (status(run)["state"], status(run)["step"]) == ("finished", 6240)
    columns = read_metrics(run / "metrics.csv")
    for name in ("train/return/jerk", "train/length", "loss/policy", "policy/command_error", "eval/front/hypervolume"):
        assert np.isfinite(columns[name]).any(), name
    for name in [*PICTURES, "curves.png"]:
        assert (run / name).read_bytes().startswith(b"\x89PNG")
    assert (run / "video.mp4").read_bytes()[4:8] == b"ftyp"

    front, about = Front.read(run), json.loads((run / "evaluation.json").read_text())
    assert len(front) > 2
    assert non_dominated(front.discounted).all()
    assert (front.gamma, front.episodes, front.seed) == (0.99, 1, 1_000_000)
    assert about["step"] == 6240
    assert about["reference_point"] == [-1.0, -0.1, -10.0, -500.0]
    numbers = {name: estimate["value"] for name, estimate in about["policies"]["front"].items()}
    assert numbers["cardinality"] == len(front)
    assert numbers["hypervolume"] == pytest.approx(hypervolume(front.discounted, about["reference_point"]))
    assert numbers["success"] == 0.0


def test_the_last_of_the_logged_fronts_is_the_front_of_the_run(finished_front: Path) -> None:
    with (finished_front / "fronts.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    front = Front.read(finished_front)
    columns = [f"discounted_return/{name}" for name in front.objectives]
    last = [[float(row[name]) for name in columns] for row in rows if row["step"] == "6240"]
    np.testing.assert_array_equal(last, front.discounted)
    metrics = read_metrics(finished_front / "metrics.csv")
    evaluated = np.isfinite(metrics["eval/front/cardinality"])
    assert evaluated.sum() >= 5
    for step, count in zip(metrics["step"][evaluated], metrics["eval/front/cardinality"][evaluated], strict=True):
        assert [row["policy"] for row in rows if float(row["step"]) == step] == [str(k) for k in range(int(count))]


def stop_at(monkeypatch: pytest.MonkeyPatch, step: int, happens: Callable[[], None]) -> None:
    """Let something happen when the first front past ``step`` has been written."""
    write = FrontsFile.write

    def spy(self: FrontsFile, at: int, front: Front) -> None:
        write(self, at, front)
        if at >= step:
            happens()

    monkeypatch.setattr(FrontsFile, "write", spy)


def crash() -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")
@pytest.mark.parametrize("text", [FRONT, SEA_FRONT], ids=["driving", "deep-sea-treasure"])
def test_an_interrupted_and_resumed_run_of_a_front_is_the_same_run(
    tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    monkeypatch.setattr("algorithms.experiments.training.film_front", lambda *arguments, **options: None)
    monkeypatch.setattr("algorithms.reporting.front_report.draw_front", lambda *arguments, **options: None)
    (tmp_path / "front.yaml").write_text(text)
    run, whole = tmp_path / "run", tmp_path / "whole"
    first = ["--config", "front.yaml", "--output", run]
    total = 6000 if text is FRONT else 2000
    steps = [0]
    for arguments, part, happens, expected in (
        (first, 0.2, lambda: signal.raise_signal(signal.SIGINT), 130),
        (["--resume", run], 0.4, crash, 1),
        (["--resume", run], 0.7, lambda: signal.raise_signal(signal.SIGTERM), 143),
    ):
        with monkeypatch.context() as context:
            stop_at(context, int(part * total), happens)
            code, out, error = call("train", *arguments)
        assert code == expected, out + error
        steps.append(status(run)["step"])
        assert steps[-2] <= steps[-1] < total
    assert steps[1] > 0
    assert steps[3] > steps[1]
    code, out, error = call("train", "--resume", run)
    assert code == 0, out + error
    assert call("train", "--config", "front.yaml", "--output", whole)[0] == 0

    def rows(path: Path) -> list[dict[str, str]]:
        with (path / "metrics.csv").open(newline="") as file:
            return [{**row, "time/steps_per_second": ""} for row in csv.DictReader(file)]

    assert rows(run) == rows(whole)
    for name in ("fronts.csv", "front.csv", "evaluation.json"):
        assert (run / name).read_bytes() == (whole / name).read_bytes(), name
    tensors, again = (load_file(each / "checkpoint.safetensors") for each in (whole, run))
    assert tensors.keys() == again.keys()
    for name, array in tensors.items():
        np.testing.assert_array_equal(array, again[name], err_msg=name)


def test_evaluate_repeats_the_front_at_the_end_of_training(finished_front: Path, tmp_path: Path, call: Call) -> None:
    code, out, error = call("evaluate", finished_front, "--output", "numbers")
    assert code == 0, out + error
    for name in ("front.csv", "evaluation.json"):
        assert (tmp_path / "numbers" / name).read_bytes() == (finished_front / name).read_bytes(), name
    assert {path.name for path in (tmp_path / "numbers").iterdir()} == PICTURES | {"front.csv", "evaluation.json"}
    assert "hypervolume" in out
    for name in ("distance", "destination", "g_force", "jerk", "arrivals", "decisions"):
        assert name in out


def test_evaluate_shows_a_front_on_other_episodes_and_films_it(
    finished_front: Path, tmp_path: Path, call: Call
) -> None:
    before = sorted((path.name, path.stat().st_mtime_ns) for path in finished_front.iterdir())
    options = ["--episodes", 3, "--seed", 9, "--video", "drive.mp4", "--output", "numbers"]
    code, out, error = call("evaluate", finished_front, *options)
    assert code == 0, out + error
    front = Front.read(tmp_path / "numbers")
    assert (front.episodes, front.seed) == (3, 9)
    np.testing.assert_array_equal(front.low, front.returns)  # every episode is the same
    assert (tmp_path / "drive.mp4").stat().st_size > 1000
    assert sorted((path.name, path.stat().st_mtime_ns) for path in finished_front.iterdir()) == before
    refused(call("evaluate", finished_front, "--episodes", 0), "--episodes 0")


@pytest.mark.parametrize("algorithm", ["mo_a2c", "pcn"])
def test_runs_on_other_environments_are_evaluated(
    tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch, algorithm: str
) -> None:
    monkeypatch.setattr("algorithms.experiments.training.film_front", lambda *arguments, **options: None)
    monkeypatch.setattr("algorithms.experiments.training.record", lambda *arguments, **options: None)
    (tmp_path / "other.yaml").write_text(SEA_FRONT if algorithm == "pcn" else TREASURE)
    run = tmp_path / "run"
    assert call("train", "--config", "other.yaml", "--output", run, "--training.total_timesteps=600")[0] == 0
    code, out, error = call("evaluate", run, "--output", "numbers")
    assert code == 0, out + error
    assert (tmp_path / "numbers" / "evaluation.json").read_text() == (run / "evaluation.json").read_text()


def test_plot_draws_runs_of_fronts(finished_front: Path, tmp_path: Path, call: Call) -> None:
    code, out, error = call("plot", finished_front, "--output", "curves.pdf")
    assert code == 0, out + error
    assert "pcn: 1 seed" in out
    assert (tmp_path / "curves.pdf").read_bytes().startswith(b"%PDF")


def test_fronts_that_cannot_be_learnt_are_refused_before_anything_starts(tmp_path: Path, call: Call) -> None:
    (tmp_path / "front.yaml").write_text(FRONT)
    config = ["--config", "front.yaml"]
    refused(call("train", *config, "--utility.name=one_waypoint_linear"), "learns a front for every utility")
    crossing = "--environment={id: mo-deepdrive-intersection-v0, arguments: {fixed_destination: false}}"
    refused(call("train", *config, crossing), "algorithm 'pcn' drives one vehicle; the environment has 2")
    refused(call("train", *config, "--evaluation.reference_point=[1.0]"), "needs 4 numbers")
    refused(call("train", *config, "--evaluation.gamma=0.9"), "evaluation.reference_point must be given")
    refused(call("train", *config, "--environment.arguments.cost_sign=paper"), "a front needs 'maximise'")
    refused(call("train", *config, "--algorithm.objective_scales=[1.0]"), "objective_scales = [1.0] needs 4 numbers")
    peer = REPOSITORY / "configs" / "peers" / "pcn.yaml"
    refused(call("train", "--config", peer), "'morl_baselines.pcn' is another library's; scripts/peers.py runs it")
    assert [path.name for path in tmp_path.iterdir()] == ["front.yaml"]
