"""Choosing a policy of a front through the command line, against a plain computation over the policies' episodes."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from algorithms.runs.build import build, load_policy
from algorithms.runs.config import load_experiment
from algorithms.runs.policy_evaluation import evaluate_front
from algorithms.runs.run_directory import Run
from mo_deepdrive.evaluation.env_adapter import make_env
from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.evaluation.front import Front
from mo_deepdrive.utilities import make_utility
from tests.helpers.paths import REPOSITORY
from tests.helpers.script_runs import Call, Done, refused

pytestmark = pytest.mark.slow

EPISODES, SEED = 3, 21
ARGUMENTS = {"time_limit": 3}
DRIVING = f"""
environment: {{id: mo-deepdrive-one-waypoint-v0, arguments: {ARGUMENTS}}}
algorithm:
  name: pcn
  learning_rate: 1e-2
  hidden: [32, 32]
  batch_size: 128
  gradient_steps: 100
  warmup_episodes: 64
  persistence: 0.95
  buffer_size: 100
  horizon_reduction: 0
  horizon_scale: 20.0
training: {{total_timesteps: 3000, num_envs: 16, seed: 3}}
evaluation: {{episodes: 1, final_episodes: 2}}
"""

Choose = Callable[..., Done]


@pytest.fixture
def choose(call: Call, monkeypatch: pytest.MonkeyPatch) -> Choose:
    """Run the script in the test's folder, on lines long enough for its table."""
    monkeypatch.setattr("algorithms.runs.console.make_console", lambda: Console(width=250))
    return functools.partial(call, "choose")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that learnt a front, with the files that choosing reads."""
    folder = tmp_path_factory.mktemp("front")
    (folder / "driving.yaml").write_text(DRIVING)
    experiment = load_experiment(folder / "driving.yaml")
    run = Run.create(experiment, folder / "run")
    run.unlock()
    agent = build(experiment)
    agent.train(experiment.training.total_timesteps)
    agent.save(run.checkpoint)
    front = evaluate_front(agent, experiment, episodes=2, seed=2_000_000)
    assert len(front) > 3
    front.write(run.path, {"step": agent.step})
    return run.path


@pytest.fixture(scope="module")
def returns(folder: Path) -> np.ndarray:
    """(K, E, d) returns of every policy, each evaluated alone."""
    experiment = Run.open(folder).experiment
    agent = build(experiment, num_envs=1)
    agent.load(folder / "checkpoint.safetensors", policy_only=True)
    env = make_env("mo-deepdrive-one-waypoint-v0", 1, ARGUMENTS)
    found = [
        evaluate(agent.policy(condition), env, episodes=EPISODES, seed=SEED, gamma=0.99).returns[:, 0]
        for condition in Front.read(folder).conditions
    ]
    return np.array(found)


def chosen(done: Done, folder: Path) -> int:
    """The policy that the last line names."""
    code, out, error = done
    assert code == 0, out + error
    (number,) = re.findall(rf"policy (\d+) of {re.escape(str(folder / 'front.csv'))}", out.replace("\n", ""))
    assert f"policy {number}: chosen" in out
    return int(number)


def numbers_of(out: str, row: str) -> list[float]:
    """The first number of every cell of a row of the table."""
    (line,) = [line for line in out.splitlines() if line.strip().startswith(row)]
    cells = re.split(r" {2,}", line.strip().removeprefix(row).strip())
    return [float(cell.split()[0].rstrip("%")) for cell in cells]


SETTINGS = ["--episodes", EPISODES, "--seed", SEED]
NAMES = ("distance", "destination", "g_force", "jerk")


def weighted(returns: np.ndarray, scales: np.ndarray, **weights: float) -> Any:
    return sum(weight * returns[:, :, NAMES.index(name)].mean(axis=1) for name, weight in weights.items())


def of_utility(name: str) -> Callable[..., Any]:
    return lambda returns, scales: make_utility(name, NAMES)(returns).mean(axis=1)


def short_of(returns: np.ndarray, scales: np.ndarray, target: list[float]) -> Any:
    return -np.linalg.norm(np.maximum(0.0, target - returns.mean(axis=1)) / scales, axis=1)


# Options, what they make a policy worth of its returns (K, E, d) and the scales, and the row of the table that has it.
CHOICES: dict[str, tuple[list[str], Callable[..., Any], str]] = {
    "weights": (
        ["--weights", "distance=1", "g_force=0.3", "jerk=0.004"],
        functools.partial(weighted, distance=1.0, g_force=0.3, jerk=0.004),
        "weighted sum",
    ),
    **{
        name: (["--utility", name], of_utility(name), f"expected {name}")
        for name in ("one_waypoint_linear", "one_waypoint_nonlinear")
    },
    "arguments": (
        ["--utility", "linear", "--arguments", "{weights: [0, 0, 1, 0]}"],
        functools.partial(weighted, g_force=1.0),
        "expected linear",
    ),
    "own": (
        ["--utility", "wishes:squared"],
        lambda returns, scales: -((returns[..., 0] - 0.2) ** 2).mean(axis=1),
        "expected wishes:squared",
    ),
    "target": (
        ["--target", "distance=100", "jerk=0"],
        functools.partial(short_of, target=[100.0, -math.inf, -math.inf, 0.0]),
        "minus the distance to the target",
    ),
}


@pytest.mark.parametrize("name", CHOICES)
def test_the_policy_that_is_worth_most_is_chosen(
    folder: Path, returns: np.ndarray, choose: Choose, tmp_path: Path, name: str
) -> None:
    (tmp_path / "wishes.py").write_text("def squared(returns):\n    return -((returns[..., 0] - 0.2) ** 2)\n")
    options, worth_of, row = CHOICES[name]
    done = choose(folder, *SETTINGS, *options)
    scales = build(Run.open(folder).experiment, num_envs=1).scales
    k, worth = chosen(done, folder), worth_of(returns, scales)
    assert worth[k] == pytest.approx(worth.max(), abs=1e-6)
    assert numbers_of(done[1], row)[0] == pytest.approx(worth.max(), rel=1e-3, abs=1e-4)
    for i, objective in enumerate(NAMES):
        assert numbers_of(done[1], objective)[0] == pytest.approx(returns[k, :, i].mean(), rel=0.02, abs=1e-3)


def test_a_preference_for_two_vehicles_names_the_objectives_of_each(tmp_path: Path, call: Call, choose: Choose) -> None:
    settings = [
        "--environment.arguments={time_limit: 3}",
        "--algorithm={name: conditioned_mo_ppo, hidden: [8], max_policies: 4}",
        "--training={total_timesteps: 512, num_envs: 8}",
        "--evaluation={episodes: 1, final_episodes: 2}",
        "--logging.save_figures=false",
    ]
    run = tmp_path / "run"
    code, out, error = call("train", "--config", "intersection/conditioned", *settings, "--output", run)
    assert code == 0, out + error
    assert "hypervolume" not in out
    front = Front.read(run)
    assert front.objectives[:1] + front.objectives[6:7] == ("vehicle_0/distance", "vehicle_1/distance")
    done = choose(run, *SETTINGS, "--weights", "vehicle_1/distance=1", "vehicle_0/jerk=0.001")
    k = chosen(done, run)
    agent = load_policy(Run.open(run))
    env = make_env("mo-deepdrive-intersection-v0", 1, ARGUMENTS)
    found = [
        evaluate(agent.policy(condition), env, episodes=EPISODES, seed=SEED, gamma=0.99).returns
        for condition in front.conditions
    ]
    worth = [(each[:, 1, 0] + 0.001 * each[:, 0, 4]).mean() for each in found]
    assert worth[k] == pytest.approx(max(worth))
    assert numbers_of(done[1], "vehicle_1/distance")[0] == pytest.approx(found[k][:, 1, 0].mean(), rel=0.02, abs=1e-3)
    refused(choose(run, "--weights", "jerk=1"), "unknown objective 'jerk'", "vehicle_0/jerk")


def test_one_policy_is_scored_without_a_choice(
    folder: Path, returns: np.ndarray, choose: Choose, tmp_path: Path
) -> None:
    worst = int(returns[:, :, 0].mean(axis=1).argmin())
    options = [*SETTINGS, "--weights", "distance=1", "--policy", worst]
    code, out, error = choose(folder, *options, "--video", tmp_path / "drive.mp4")
    assert code == 0, out + error
    assert "1 policy by weighted sum" in out
    assert f"policy {worst} of {folder / 'front.csv'}" in out.replace("\n", "")
    assert f"policy {worst} of the front" in out
    assert "chosen" not in out
    assert numbers_of(out, "weighted sum") == pytest.approx([returns[worst, :, 0].mean()], rel=1e-3, abs=1e-4)
    assert (tmp_path / "drive.mp4").stat().st_size > 0


@pytest.mark.parametrize(
    ("options", "messages"),
    [
        (["--weights", "distanc=1"], ["--weights 'distanc=1'", "did you mean 'distance'?"]),
        (["--target", "speed=1"], ["--target 'speed=1': unknown objective 'speed'; ", "distance, g_force"]),
        (["--weights", "jerk=1e308"], ["is worth -inf; every policy must be worth a finite number"]),
        (["--utility", "linear", "--arguments", "{objectives: 3}"], ["'objectives' is set by the environment"]),
        (["--weights", "distance=1", "jerk=-1"], ["weights {'distance': 1.0, 'jerk': -1.0}", "must not be negative"]),
        (["--weights", "jerk=1", "--arguments", "{a: 1}"], ["--arguments can only be given with --utility"]),
        (["--utility", "linear", "--arguments", "[1]"], ["--arguments '[1]' must be a mapping"]),
        (["--utility", "linear", "--arguments", "{weights: [1]}"], ["weights"]),
        (["--weights", "jerk=1", "--policy", "-1"], ["--policy -1 must be from 0 to", "a policy of front.csv"]),
    ],
)
def test_invalid_options_are_refused_by_name(
    folder: Path, choose: Choose, options: list[str], messages: list[str]
) -> None:
    refused(choose(folder, *options), *messages)


def test_runs_without_a_front_are_refused(folder: Path, choose: Choose, tmp_path: Path) -> None:
    refused(choose("nowhere", "--weights", "jerk=1"), "'nowhere' is not a run directory")
    config = REPOSITORY / "configs" / "one_waypoint" / "a2c_linear.yaml"
    Run.create(load_experiment(config), tmp_path / "single").unlock()
    refused(choose("single", "--weights", "jerk=1"), "'single' learnt one policy", "mo-deepdrive evaluate")
    unfinished = tmp_path / "unfinished"
    unfinished.mkdir()
    (unfinished / "config.yaml").write_bytes((folder / "config.yaml").read_bytes())
    refused(choose("unfinished", "--weights", "jerk=1"), "'unfinished' holds no front")
    for name in ("front.csv", "evaluation.json"):
        (unfinished / name).write_bytes((folder / name).read_bytes())
    refused(choose("unfinished", "--weights", "jerk=1"), "checkpoint.safetensors", "cannot be read")
