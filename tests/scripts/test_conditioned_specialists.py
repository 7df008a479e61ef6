"""``scripts/conditioned_specialists.py``: one network for all preferences beside one learner per preference."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from rich.console import Console

from algorithms.experiments.build import build
from algorithms.experiments.config import load_experiment
from tests.helpers.script_runs import refused

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from types import ModuleType

    from tests.helpers.script_runs import Call

SHORT = ("training.total_timesteps=16384",)


@pytest.fixture
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """The script as a module."""
    return load_script("conditioned_specialists")


def result(script: ModuleType, learner: str, seed: int, preference: int, utility: float, **others: Any) -> Any:
    values = {"config": "c", "changed": "", "steps": 100, "weights": f"w{preference}", "arrivals": 0.9, "seconds": 2.0}
    keys = {"learner": learner, "seed": seed, "preference": preference, "utility": utility}
    return script.Result(**values | others | keys)


@pytest.mark.parametrize("config", ["left_turn/conditioned", "one_waypoint/conditioned_continuous"])
def test_a_specialist_has_the_settings_of_the_network_and_the_utility_of_its_preference(
    script: ModuleType, config: str
) -> None:
    network = load_experiment(config)
    agent = build(network, num_envs=1)
    weights = np.arange(1.0, 9.0)[: len(agent.env.objectives)]
    specialist = script.specialist_experiment(network, weights)
    assert specialist.algorithm.name == "mo_ppo"
    assert (specialist.environment, specialist.training) == (network.environment, network.training)
    learner = build(specialist, num_envs=1)
    for key in ("learning_rate", "gamma", "gae_lambda", "steps", "hidden", "cost_growth", "objective_scales"):
        assert getattr(learner.config, key) == getattr(agent.config, key)
    assert learner.config.state_dependent_std is agent.config.state_dependent_std is True
    assert learner.utilities[0](np.eye(len(weights))) == pytest.approx(weights)


def test_late_decisions_of_a_specialist_count_as_much_as_early_ones(script: ModuleType) -> None:
    """With g = 1 advantages are those of scalar rewards (tests/algorithms/test_mo_a2c.py), with less g^t of them."""
    for config in script.CONFIGS:
        network = load_experiment(config)
        weights = np.ones(len(build(network, num_envs=1).env.objectives))
        assert build(script.specialist_experiment(network, weights), num_envs=1).accrued_discount == 1.0


def test_both_drive_the_same_episodes_under_the_same_preferences(script: ModuleType) -> None:
    comparison = script.Comparison(script.CONFIGS[0], SHORT, 2, 8)
    found = [each for make_run in comparison.missing([], [0, 1]) for each in make_run()]
    assert [(each.learner, each.seed, each.preference) for each in found] == [
        ("specialist", 0, 0),
        ("specialist", 0, 1),
        *(("network", seed, preference) for seed in (0, 1) for preference in (0, 1)),
    ]
    assert len({each.weights for each in found}) == 2
    for each in found:
        assert each.steps == 16384
        assert each.weights == found[each.preference].weights
        assert sum(map(float, each.weights.split())) == pytest.approx(1.0, abs=0.002)
        assert -1.0 < each.utility < 1.0
        assert each.seconds > 0.0


def test_only_what_is_missing_is_trained(script: ModuleType) -> None:
    comparison = script.Comparison(script.CONFIGS[0], SHORT, 2, 8)
    known = {"config": comparison.config, "changed": SHORT[0]}
    done = [result(script, "specialist", 0, 1, 0.1, **known)]
    done += [result(script, "network", 3, preference, 0.1, **known) for preference in (0, 1)]
    runs = [(each.func.__name__, each.args) for each in comparison.missing(done, [2, 3])]
    assert runs == [("specialist", (0,)), ("network", (2,))]
    assert len(list(comparison.missing([result(script, "network", 2, 0, 0.1, **known)], [2]))) == 3


def test_the_table_has_the_share_of_every_network(
    script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = [
        *(result(script, "specialist", 0, preference, utility) for preference, utility in enumerate((0.5, 0.3))),
        *(result(script, "network", 0, preference, utility) for preference, utility in enumerate((0.2, 0.4))),
        *(result(script, "network", 3, preference, utility) for preference, utility in enumerate((0.5, 0.1))),
    ]
    Console(width=120).print(script.table(results))
    shown = capsys.readouterr().out
    assert "0.3500" in shown
    assert "0.2500" in shown
    assert "shares of the specialists' mean: 75.0% (seed 0), 75.0% (seed 3)" in shown
    script.write_results(tmp_path / "found.csv", results)
    assert script.read_results(tmp_path / "found.csv", script.Result) == results
    poor = [result(script, "specialist", 0, 0, -0.3), result(script, "network", 4, 0, 0.1)]
    assert math.isnan(script.shares(poor)[4])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--preferences", "0"], "--preferences 0 must be between 1 and 1000"),
        (["--episodes", "2001"], "--episodes 2001 must be between 1 and 2000"),
        (["--output", "nowhere/found.csv"], "there is no folder nowhere"),
        (["--change", "training.total_timesteps=0"], "'training.total_timesteps' = 0"),
        (["--config", "one_waypoint/ppo_linear"], "must be of conditioned_mo_ppo, with one vehicle and linear"),
        (["--config", "one_waypoint/conditioned"], "must be of conditioned_mo_ppo, with one vehicle and linear"),
    ],
)
@pytest.mark.usefixtures("script")
def test_invalid_arguments_are_refused(call: Call, arguments: list[str], message: str) -> None:
    refused(call("conditioned_specialists", *arguments), message)
