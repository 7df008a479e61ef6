"""Evaluations with the settings of an experiment: how many episodes are driven."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from algorithms.runs import report
from algorithms.runs.build import build
from algorithms.runs.config import EnvironmentSettings, make_experiment
from algorithms.runs.report import distinct_episodes, evaluate_front, evaluate_front_policies

OURS = "mo-deepdrive-{}-v0"


@pytest.mark.parametrize(
    ("scenario", "arguments", "same"),
    [
        ("one-waypoint", {"fixed_destination": True}, True),
        ("one-waypoint", {}, False),
        ("static-obstacle", {"fixed_destination": True, "fixed_obstacle": True}, True),
        ("static-obstacle", {"fixed_destination": True}, False),
        ("static-obstacle", {"fixed_obstacle": True}, False),
        ("intersection", {}, False),
    ],
)
def test_one_episode_is_driven_where_all_are_the_same(scenario: str, arguments: dict[str, Any], same: bool) -> None:
    settings = EnvironmentSettings(id=OURS.format(scenario), arguments=arguments)
    assert distinct_episodes(settings, 1000) == (1 if same else 1000)


def test_of_other_environments_all_episodes_are_driven() -> None:
    assert distinct_episodes(EnvironmentSettings(id="deep-sea-treasure-v0"), 7) == 7


def test_one_episode_of_a_front_gives_the_numbers_of_many(monkeypatch: pytest.MonkeyPatch) -> None:
    experiment = make_experiment(
        {
            "environment": {
                "id": OURS.format("one-waypoint"),
                "arguments": {"time_limit": 2, "fixed_destination": True},
            },
            "algorithm": {"name": "pcn", "hidden": [16, 16], "gradient_steps": 2, "warmup_episodes": 8},
            "training": {"total_timesteps": 300, "num_envs": 8},
        }
    )
    agent = build(experiment)
    agent.train(experiment.training.total_timesteps)
    driven = evaluate_front(agent, experiment, episodes=20, seed=5)
    evaluations = evaluate_front_policies(agent, driven, experiment, episodes=20, seed=5)
    assert driven.episodes == len(evaluations[0].returns) == 1
    monkeypatch.setattr(report, "distinct_episodes", lambda _, episodes: episodes)
    every = evaluate_front(agent, experiment, episodes=20, seed=5)
    assert every.episodes == 20
    for name in ("returns", "low", "high", "discounted", "success", "length", "conditions"):
        np.testing.assert_allclose(getattr(driven, name), getattr(every, name), rtol=1e-12, err_msg=name)
