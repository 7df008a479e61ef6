"""Other libraries' algorithms, as far as that needs none of them: the table, their view of a world, policies."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import mo_gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from algorithms.common.env_adapter import EnvAdapter, make_env
from algorithms.evaluation.evaluate import evaluate_each
from algorithms.experiments.config import load_experiment
from algorithms.experiments.progress_bar import make_console
from algorithms.experiments.run_directory import Run
from algorithms.peers import PEERS, Peer, PeerConfig, Task
from algorithms.peers.environment import PeerEnv, Recorder
from algorithms.peers.running import evaluate_front, prepare, run_peer
from algorithms.peers.task import Policies, Seen
from mo_deepdrive.utilities import make_utility

ONE_WAYPOINT = "mo-deepdrive-one-waypoint-v0"
FIXED = {"fixed_destination": True, "time_limit": 3.0}


def make_task(env_id: str = ONE_WAYPOINT, arguments: dict[str, Any] | None = None, **changes: Any) -> Task:
    arguments = FIXED if arguments is None else arguments
    worlds = EnvAdapter(make_env(env_id, 1, arguments))
    task = Task(
        new=lambda **more: mo_gymnasium.make(env_id, **arguments, **more),
        env=worlds,
        config=PeerConfig(),
        utility=None,
        steps=50,
        num_envs=2,
        seed=5,
        device="cpu",
        reference_point=None,
        recorder=Recorder(worlds.objectives, None, 10, lambda step, metrics: None),
    )
    return replace(task, **changes)


def constant(task: Task, actions: list[int]) -> Policies:
    """One policy per action, which always takes it."""
    table = np.array(actions)
    return Policies(task, lambda rows, seen: table[rows], table[:, None].astype(float), ("action",))


def forward(task: Task) -> Policies:
    """A foreign algorithm that learns nothing: it drives a little and gives three policies."""
    env = task.make()
    env.reset()
    for _ in range(task.steps):
        if any(env.step(7)[2:4]):
            env.reset()
    return constant(task, [0, 2, 3])


# ------------------------------------------------------------------------------------------------ the view of a world


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("arguments", [{}, {"action_type": "continuous"}])
def test_a_world_in_the_peers_form_passes_gymnasiums_check(arguments: dict[str, Any]) -> None:
    env = make_task(arguments=arguments).make()
    env.unwrapped.spec = None  # the check would make it again from there, in another form
    check_env(env, skip_render_check=True)


@pytest.mark.parametrize("nominal", [True, False])
def test_peers_see_observations_and_rewards_in_nominal_units_unless_told_otherwise(nominal: bool) -> None:
    task = make_task(config=PeerConfig(nominal_scales=nominal))
    seen, plain = task.make(), mo_gymnasium.make(ONE_WAYPOINT, **FIXED)
    o, r = task.env.observation_scales, task.env.objective_scales
    unit = (o, r) if nominal else (np.ones_like(o), np.ones_like(r))
    np.testing.assert_allclose(seen.reset()[0], plain.reset(seed=5)[0] / unit[0], rtol=1e-6)
    for action in (3, 3, 9, 3):
        first, second = seen.step(np.int64(action)), plain.step(action)
        assert first[0].dtype == first[1].dtype == np.float32
        np.testing.assert_allclose(first[0], second[0] / unit[0], rtol=1e-6)
        np.testing.assert_allclose(first[1], second[1] / unit[1], rtol=1e-6)


def test_continuous_actions_beyond_the_box_are_clipped() -> None:
    task = make_task(arguments={"action_type": "continuous"})
    episodes = []
    for action in ([0.0, 1.0, -1.0], [0.0, 7.0, -3.0]):
        env = task.make()
        env.reset()
        episodes.append(env.step(np.array(action, dtype=np.float32))[0])
    np.testing.assert_array_equal(*episodes)


def test_discrete_observations_of_other_environments_become_vectors() -> None:
    env = make_task("deep-sea-treasure-v0", {}).make()
    observation, _ = env.reset()
    assert observation.shape == env.observation_space.shape
    assert env.step(env.action_space.sample())[1].shape == (2,)


def test_worlds_start_from_seeds_of_their_own_and_do_not_repeat_them() -> None:
    task = make_task(arguments={})
    first, same, second = task.make(0), task.make(0), task.make(1)
    start = first.reset()[0]
    np.testing.assert_array_equal(start, same.reset()[0])
    assert not np.array_equal(start, second.reset()[0])
    assert not np.array_equal(start, first.reset()[0])
    assert first.action_space.sample() == same.action_space.sample()


def test_a_specification_makes_one_world_after_the_other() -> None:
    spec = make_task(arguments={}).spec()
    starts = [mo_gymnasium.make(spec).reset()[0] for _ in range(2)]
    assert not np.array_equal(*starts)
    assert isinstance(mo_gymnasium.make(spec, render_mode="rgb_array").env, PeerEnv)


def test_steps_are_counted_and_the_episodes_that_ended_are_logged() -> None:
    lines: list[tuple[int, dict[str, float]]] = []
    utility = make_utility("one_waypoint_linear", ("distance", "destination", "g_force", "jerk"))
    recorder = Recorder(utility.objectives, utility, 20, lambda step, metrics: lines.append((step, metrics)))
    task = make_task(recorder=recorder)
    env, silent = task.make(), task.make(recorded=False)
    for each in (env, silent):
        each.reset()
    returns = np.zeros(4)
    for _ in range(30):
        _, reward, terminated, truncated, _ = env.step(3)
        silent.step(0)
        returns += reward * task.reward_scales
    assert truncated
    assert not terminated
    for _ in range(30):
        env.reset()
        env.step(0)
    assert recorder.steps == 60
    assert [step for step, _ in lines] == [20, 40, 60]
    assert "train/length" not in lines[0][1]
    assert lines[1][1]["train/length"] == 30
    assert lines[1][1]["train/success"] == 0.0
    assert lines[1][1]["train/return/distance"] == pytest.approx(returns[0], rel=1e-5)
    assert lines[1][1]["train/utility"] == pytest.approx(float(utility(returns)), rel=1e-5)


# ------------------------------------------------------------------------------------------------------------ policies


def test_policies_see_what_the_episode_has_come_to_in_their_own_units() -> None:
    task = make_task()
    seen: list[Seen] = []

    def choose(rows: Any, what: Seen) -> Any:
        seen.append(what)
        return np.full(len(rows), 3)

    policies = Policies(task, choose, np.zeros((2, 0)), gamma=0.5)
    found = evaluate_each(policies.at, 2, make_env(ONE_WAYPOINT, 2, FIXED), episodes=1, seed=0, gamma=1.0)
    assert [each.decisions.tolist() for each in seen] == [[t, t] for t in range(30)]
    env = task.make()
    observation, _ = env.reset()
    accrued, factor = np.zeros(4), 1.0
    for each in seen[:10]:
        np.testing.assert_allclose(each.observations[0], observation, rtol=1e-6)
        np.testing.assert_allclose(each.accrued[1], accrued, rtol=1e-4, atol=1e-6)
        observation, reward, *_ = env.step(3)
        accrued, factor = accrued + factor * reward, factor * 0.5
    assert found[0].lengths[0, 0] == 30


def test_a_policy_is_found_by_its_condition() -> None:
    policies = constant(make_task(), [0, 2, 3])
    assert policies.policy([2.0]).rows.tolist() == [1]
    assert len(policies) == 3


def test_the_utility_of_scaled_returns_is_that_of_the_returns() -> None:
    utility = make_utility("one_waypoint_nonlinear", ("distance", "destination", "g_force", "jerk"))
    task = make_task(utility=utility)
    returns = np.array([[12.0, 1.0, -4.0, -90.0], [0.5, 0.0, -1.0, -10.0]], dtype=np.float32)
    scaled = returns / task.reward_scales
    np.testing.assert_allclose(task.utility_of_scaled(scaled), utility(returns), rtol=1e-5)
    tensor = torch.tensor(scaled, requires_grad=True)
    task.utility_of_scaled(tensor).sum().backward()
    assert tensor.grad is not None
    assert task.utility_of_scaled(scaled[0], None).shape == ()


# --------------------------------------------------------------------------------------------------------------- peers


def test_every_peer_says_what_it_is() -> None:
    for name, peer in PEERS.items():
        assert name.partition(".")[0] == peer.path.partition(".")[0]
        assert set(peer.actions) <= {"discrete", "continuous"}
        assert peer.Config() == peer.Config(**peer.Config().model_dump())


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("morl_baselines.capql", {}, "takes continuous actions; the environment has discrete ones"),
        ("morl_baselines.envelope", {"arguments": {"action_type": "continuous"}}, "takes discrete actions"),
        ("morl_baselines.pgmorl", {"arguments": {"action_type": "continuous"}}, "2 to 3 objectives; the environment"),
        ("stable_baselines3.ppo", {}, "learns for a known utility"),
        ("morl_baselines.pcn", {"env_id": "mo-deepdrive-intersection-v0", "arguments": {}}, "drives one vehicle"),
    ],
)
def test_a_peer_that_does_not_fit_says_what_it_needs(name: str, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PEERS[name].check(name, make_task(**changes))


def test_a_peer_for_fronts_takes_no_utility() -> None:
    utility = make_utility("one_waypoint_linear", ("distance", "destination", "g_force", "jerk"))
    with pytest.raises(ValueError, match="learns a front; it takes no utility"):
        PEERS["morl_baselines.pcn"].check("morl_baselines.pcn", make_task(utility=utility))


def test_a_peer_that_is_not_there_says_what_the_import_says() -> None:
    peer = Peer("no_such_library.module:Class", "no-such-library", False, ("discrete",), forward)
    assert peer.obstacle() == "ModuleNotFoundError: No module named 'no_such_library'"
    assert replace(peer, path="json:Class").obstacle() == "AttributeError: module 'json' has no attribute 'Class'"
    assert replace(peer, path="json:loads").obstacle() is None


def test_importing_the_table_imports_no_library_of_a_peer() -> None:
    code = (
        "import sys, algorithms.peers; print([m for m in ('morl_baselines', 'stable_baselines3') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# ---------------------------------------------------------------------------------------------------------------- runs


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


def test_a_run_with_a_peer_has_what_a_run_of_ours_has(
    front_config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    peer = replace(PEERS["morl_baselines.pcn"], path="json:loads", package="numpy", adapter=forward)
    monkeypatch.setitem(PEERS, "morl_baselines.pcn", peer)
    run = Run.create(load_experiment(front_config), tmp_path / "run")
    run_peer(run, make_console())
    about = json.loads((run.path / "evaluation.json").read_text())
    assert about["step"] == 50
    assert about["wall_clock"] > 0.0
    assert about["evaluated_policies"] == 3
    assert about["policies"]["front"]["hypervolume"]["value"] > 0.0
    names = {"front.csv", "fronts.csv", "metrics.csv", "curves.png", "scatter.png", "peer.log", "config.yaml"}
    assert names <= {path.name for path in run.path.iterdir()}
    assert run.status["state"] == "finished"
    assert Run.open(run.path).experiment == run.experiment


def test_a_front_is_evaluated_on_the_experiments_seeds(front_config: Path) -> None:
    experiment = load_experiment(front_config, ["--evaluation.final_episodes=2", "--evaluation.seed=77"])
    front = evaluate_front(constant(make_task(), [0, 2, 3, 3]), experiment)
    assert (front.episodes, front.seed) == (2, 77)
    assert front.condition_names == ("action",)
    assert 1 <= len(front) <= 3
    np.testing.assert_array_equal(front.low, front.high)


def test_a_peer_that_is_not_installed_is_refused_before_anything_starts(
    front_config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = replace(PEERS["morl_baselines.pcn"], path="no_such_library:Class")
    monkeypatch.setitem(PEERS, "morl_baselines.pcn", missing)
    with pytest.raises(ValueError, match="cannot run here: ModuleNotFoundError"):
        prepare(load_experiment(front_config), lambda step, metrics: None)


def test_the_command_line_lists_peers_and_refuses_our_own_algorithms(repository: Path) -> None:
    script = repository / "scripts" / "peers.py"

    def call(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, str(script), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=False, cwd=repository)

    listed = call("--list")
    assert listed.returncode == 0
    assert all(name in listed.stdout for name in PEERS)
    ours = call("--config", "configs/one_waypoint/a2c_linear.yaml")
    assert ours.returncode == 2
    assert "is not another library's" in ours.stderr
