"""The examples that use RLlib: that of docs/lab/rllib.md (its runner, learners, a run, its curve), and a tutorial's."""

from __future__ import annotations

import csv
import importlib
from collections import Counter
from typing import Any

import numpy as np
import pytest

from tests.helpers.paths import REPOSITORY

pytest.importorskip("ray.rllib", reason="Ray is not installed: make test-ray")

from collections.abc import Iterator
from pathlib import Path

from mo_deepdrive.envs.rllib import DrivingMultiAgentEnv

EXAMPLES = REPOSITORY / "docs" / "examples"
# Both ends of an episode: a vehicle may fail, and the time limit comes soon.
SHORT = {"utility": "intersection_linear", "time_limit": 6.0, "harmful_g_force": 0.25}
WORLDS, DECISIONS = 4, 80


@pytest.fixture
def agents(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module("rllib_agents")


@pytest.fixture(params=["vector"])
def algorithm(request: pytest.FixtureRequest, agents: Any, cluster: None) -> Iterator[Any]:
    config = agents.make_config(total_timesteps=4000, seed=5)
    config.environment(env_config=SHORT)
    config.env_runners(num_envs_per_env_runner=WORLDS, rollout_fragment_length=DECISIONS)
    config.training(train_batch_size_per_learner=WORLDS * DECISIONS, minibatch_size=64)
    if request.param == "own":
        config.env_runner_cls = None
    made = config.build_algo()
    yield made
    made.stop()


def chunks_of_the_first_world(algorithm: Any, samples: int) -> list[Any]:
    """What the runner returns of it, in order; the worlds follow each other in every sample."""
    chunks = []
    for _ in range(samples):
        steps = 0
        for chunk in algorithm.env_runner.sample():
            if steps < DECISIONS:
                chunks.append(chunk)
            steps += len(chunk)
        assert steps == WORLDS * DECISIONS
    return chunks


def test_the_runner_returns_the_episodes_of_the_rllib_environment(algorithm: Any) -> None:
    """The same seed and actions give the same vectors, observations and ends there, bit for bit."""
    env = DrivingMultiAgentEnv(SHORT)
    seed: int | None = 5  # of the config; the first world has it, the next ones those that follow
    running, counts = None, Counter[str]()
    for chunk in chunks_of_the_first_world(algorithm, samples=4):
        if running != chunk.id_:
            observations, _ = env.reset(seed=seed)
            running, seed = chunk.id_, None
        assert set(chunk.agent_episodes) == set(env.agents)
        for t in range(len(chunk)):
            driving = {agent: chunk.agent_episodes[agent] for agent in env.agents}
            for agent, episode in driving.items():
                np.testing.assert_array_equal(episode.get_observations(t), observations[agent])
            actions = {agent: int(episode.get_actions(t)) for agent, episode in driving.items()}
            observations, rewards, terminateds, truncateds, infos = env.step(actions)
            for agent, episode in driving.items():
                np.testing.assert_array_equal(episode.get_observations(t + 1), observations[agent])
                vector = episode.get_infos(t + 1)["vector_reward"]
                np.testing.assert_array_equal(vector, infos[agent]["vector_reward"])
                assert episode.get_rewards(t) == pytest.approx(rewards[agent], rel=1e-6)
                if agent not in env.agents:
                    assert len(episode) == t + 1
                    assert episode.is_terminated is terminateds[agent]
                    assert episode.is_truncated is not terminateds[agent]
                    counts[infos[agent]["end"]] += 1
            counts["one on the road"] += len(env.agents) == 1
        assert (chunk.is_terminated, chunk.is_truncated) == (terminateds["__all__"], truncateds["__all__"])
        counts["cut"] += not chunk.is_done
    assert counts["time_limit"] > 0
    assert counts["harmful_g_force"] > 0
    assert counts["one on the road"] > 0
    assert counts["cut"] > 0


@pytest.mark.usefixtures("cluster")
def test_a_short_run_learns_and_writes_curve_and_scores(agents: Any, tmp_path: Path) -> None:
    scores = agents.main(tmp_path, total_timesteps=16_384, episodes=20, evaluations=2)
    with (tmp_path / "curve.csv").open() as file:
        curve = list(csv.DictReader(file))
    assert [(row["joint_steps"], row["actions"]) for row in curve] == [
        ("8192", "sampled"),
        ("8192", "greedy"),
        ("16384", "sampled"),
        ("16384", "greedy"),
    ]
    assert [row["actions"] for row in scores] == ["sampled", "greedy"]
    for row in scores:
        assert 0.0 <= row["both_arrive"] <= min(row["vehicle_0_arrives"], row["vehicle_1_arrives"])
        assert np.isfinite([row["vehicle_0_utility"], row["vehicle_1_utility"]]).all()
    importlib.import_module("rllib_curve").main(tmp_path / "curve.csv", tmp_path / "curve.png")
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")
    # The curve that the page shows has the columns that the example writes.
    with (REPOSITORY / "docs" / "results" / "rllib.csv").open() as file:
        assert csv.DictReader(file).fieldnames == list(curve[0])


@pytest.mark.parametrize("algorithm", ["vector", "own"], indirect=True)
def test_an_update_changes_both_policies_with_either_runner(agents: Any, algorithm: Any) -> None:
    before = {
        vehicle: [p.detach().clone() for p in algorithm.get_module(vehicle).actor.parameters()]
        for vehicle in agents.VEHICLES
    }
    result = algorithm.train()
    assert result["env_runners"]["num_env_steps_sampled_lifetime"] == WORLDS * DECISIONS
    assert set(result["env_runners"]["num_module_steps_sampled"]) == set(agents.VEHICLES)
    assert result["env_runners"]["num_episodes"] > 0
    assert np.isfinite(result["env_runners"]["episode_return_mean"])
    for vehicle in agents.VEHICLES:
        assert np.isfinite(result["learners"][vehicle]["total_loss"])
        after = algorithm.get_module(vehicle).actor.parameters()
        assert any((old != new).any() for old, new in zip(before[vehicle], after, strict=True))


@pytest.mark.usefixtures("cluster")
def test_the_vehicles_of_the_roundabout_learn_and_drive_by_one_policy(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    example = importlib.import_module("rllib_roundabout")
    algorithm = example.make_config(worlds=2, decisions=32).build_algo()
    before = [each.detach().clone() for each in algorithm.get_module("shared").actor.parameters()]
    sampled = algorithm.train()["env_runners"]["num_module_steps_sampled"]
    after = list(algorithm.get_module("shared").actor.parameters())
    algorithm.stop()
    assert sampled.keys() == {"shared"}
    assert sampled["shared"] > 4 * 2 * 32  # of up to eight vehicles
    assert any((old != new).any() for old, new in zip(before, after, strict=True))
    evaluation = example.main(updates=2, episodes=4, worlds=2, decisions=32)
    assert evaluation.returns.shape == (4, 8, 10)
    assert "worst_off_utility_esr" in capsys.readouterr().out
