"""Runs of peers, with an adapter that needs none of the libraries."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from algorithms.peers import PEERS
from algorithms.peers.running import prepare, run_peer
from algorithms.runs.config import load_experiment
from algorithms.runs.console import make_console
from algorithms.runs.report import evaluate_front
from algorithms.runs.run_directory import Run
from mo_deepdrive.utilities import make_utility
from tests.helpers.peers import ONE_WAYPOINT, constant_policies, fake_adapter, make_task


@pytest.fixture
def front_config(tmp_path: Path) -> Path:
    path = tmp_path / "peer.yaml"
    path.write_text(
        f"environment: {{id: {ONE_WAYPOINT}, arguments: {{fixed_destination: true, time_limit: 3.0}}}}\n"
        "algorithm: {name: morl_baselines.pcn}\n"
        "training: {total_timesteps: 50, num_envs: 1}\n"
        "evaluation: {final_episodes: 1}\n"
    )
    return path


@pytest.mark.slow
def test_the_run_of_a_peer_has_the_same_files_as_other_runs(
    front_config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    peer = replace(PEERS["morl_baselines.pcn"], path="json:loads", package="numpy", adapter=fake_adapter)
    monkeypatch.setitem(PEERS, "morl_baselines.pcn", peer)
    run = Run.create(load_experiment(front_config), tmp_path / "run")
    run_peer(run, make_console())
    about = json.loads((run.path / "evaluation.json").read_text())
    assert about["step"] == 50
    assert about["wall_clock"] > 0.0
    assert about["evaluated_policies"] == 3
    assert about["policies"]["front"]["hypervolume"]["value"] > 0.0
    quiet = Run.create(load_experiment(front_config, ["--logging.save_figures=false"]), tmp_path / "quiet")
    run_peer(quiet, make_console())
    assert not {"curves.png", "scatter.png", "video.mp4"} & {path.name for path in quiet.path.iterdir()}
    names = {"front.csv", "fronts.csv", "metrics.csv", "curves.png", "scatter.png", "peer.log", "config.yaml"}
    assert names <= {path.name for path in run.path.iterdir()}
    assert run.status["state"] == "finished"
    assert Run.open(run.path).experiment == run.experiment


@pytest.mark.slow
def test_a_peer_is_scored_as_the_task_of_the_suite_that_its_experiment_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "stable_baselines3.ppo"
    still = replace(
        PEERS[name], path="json:loads", package="numpy", adapter=lambda task, _: constant_policies(task, [0])
    )
    monkeypatch.setitem(PEERS, name, still)
    task = ["--environment={id: mo-deepdrive-static-obstacle-v1, arguments: {fixed_destination: false}}"]
    task += ["--utility.name=static_obstacle_linear", "--evaluation={task: K1, final_episodes: 1}"]
    run = Run.create(load_experiment("peers/ppo", [*task, "--logging.save_figures=false"]), tmp_path / "run")
    run_peer(run, make_console())
    stochastic = json.loads((run.path / "evaluation.json").read_text())["policies"]["stochastic"]
    assert {name for name in stochastic if name.startswith("suite/")} == {
        "suite/score",
        "suite/yaw_friction",
        "suite/action_delay",
    }


def test_a_front_is_evaluated_in_the_split_of_the_experiment_once_where_all_episodes_are_the_same(
    front_config: Path,
) -> None:
    settings = load_experiment(front_config, ["--evaluation.split=validation"])
    policies = constant_policies(make_task(), [0, 2, 3, 3])
    front = evaluate_front(policies, settings, episodes=2, seed=settings.evaluation.final_seed)
    assert (front.episodes, front.seed) == (1, 2_000_000)
    assert front.condition_names == ("action",)
    assert 1 <= len(front) <= 3


def test_a_peer_that_is_not_installed_is_refused_before_training(
    front_config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = replace(PEERS["morl_baselines.pcn"], path="no_such_library:Class")
    monkeypatch.setitem(PEERS, "morl_baselines.pcn", missing)
    with pytest.raises(ValueError, match="cannot run here: ModuleNotFoundError"):
        prepare(load_experiment(front_config), lambda step, metrics: None)


def test_a_peer_learns_the_utility_of_its_vehicle_and_refuses_guides_and_partners(
    front_config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    peer = replace(PEERS["stable_baselines3.ppo"], path="json:loads", package="numpy")
    monkeypatch.setitem(PEERS, "stable_baselines3.ppo", peer)
    own = ["--algorithm.name=stable_baselines3.ppo", "--utility.name=one_waypoint_linear"]
    own += ["--utility.vehicles.vehicle_0.name=one_waypoint_nonlinear"]
    task = prepare(load_experiment(front_config, own), lambda step, metrics: None)
    assert task.utility is not None
    assert float(task.utility(np.array([0.0, 1.0, 0.0, 0.0]))) == float(
        make_utility("one_waypoint_nonlinear", task.env.objectives)(np.array([0.0, 1.0, 0.0, 0.0]))
    )
    for key, value in (("guides", {"vehicle_0": {"driver": "gap_6"}}), ("partners", {"vehicle_1": ["gap_6"]})):
        given = load_experiment(front_config, [*own, f"--training.{key}={json.dumps(value)}"])
        with pytest.raises(ValueError, match=rf"training\.{key}: algorithm 'stable_.*' cannot train with {key}"):
            prepare(given, lambda step, metrics: None)


@pytest.mark.slow
def test_the_command_line_lists_peers_and_refuses_our_own_algorithms(repository: Path) -> None:
    def call(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "mo_deepdrive", "peers", *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=False, cwd=repository)

    listed = call("--list")
    assert listed.returncode == 0
    assert all(name in listed.stdout for name in PEERS)
    ours = call("--config", "configs/one_waypoint/a2c_linear.yaml")
    assert ours.returncode == 2
    assert "is not another library's" in ours.stderr
