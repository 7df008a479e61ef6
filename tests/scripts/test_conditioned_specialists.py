"""``scripts/conditioned_specialists.py``: one network for all preferences beside one learner per preference."""

from __future__ import annotations

import csv
import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from rich.console import Console

from algorithms.experiments.build import build
from algorithms.experiments.config import load_experiment

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from types import ModuleType


@pytest.fixture
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """The script as a module."""
    return load_script("conditioned_specialists")


def test_a_specialist_has_the_settings_of_the_network_and_the_utility_of_its_preference(script: ModuleType) -> None:
    network = load_experiment("left_turn/conditioned")
    weights = np.arange(1.0, 9.0)[: len(build(network, num_envs=1).env.objectives)]
    specialist = script.specialist_experiment(network, weights)
    assert specialist.algorithm["name"] == "mo_ppo"
    for key in ("learning_rate", "gamma", "gae_lambda", "steps", "hidden", "cost_growth", "objective_scales"):
        assert specialist.algorithm[key] == network.algorithm[key]
    assert (specialist.environment, specialist.training) == (network.environment, network.training)
    utility = build(specialist, num_envs=1).utilities[0]
    assert utility(np.eye(len(weights))) == pytest.approx(weights)


def test_both_drive_the_same_episodes_under_the_same_preferences(script: ModuleType, tmp_path: Path) -> None:
    first, second = script.compare(script.CONFIGS[0], [0, 1], 2, 8, 16384)
    found = [*first, *second]
    assert [(each.seed, each.steps) for each in found] == [(0, 16384), (0, 16384), (1, 16384), (1, 16384)]
    assert [each.specialist for each in first] == [each.specialist for each in second]
    assert [each.weights for each in first] == [each.weights for each in second]
    for each in found:
        assert sum(map(float, each.weights.split())) == pytest.approx(1.0, abs=0.002)
        assert -1.0 < each.conditioned < 1.0
        assert -1.0 < each.specialist < 1.0
        assert each.seconds > 0.0
    assert found[0].weights != found[1].weights
    script.write_results(tmp_path / "found.csv", found)
    with (tmp_path / "found.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["specialist"]) for row in rows] == pytest.approx([each.specialist for each in found], abs=1e-4)


def test_the_table_has_the_share_of_every_network(script: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    results = [
        script.Result("c", 0, 100, "1 0", 0.2, 0.5, 0.9, 1.0, 2.0),
        script.Result("c", 0, 100, "0 1", 0.4, 0.3, 1, 1, 2),
        script.Result("c", 3, 100, "1 0", 0.5, 0.5, 0.9, 1.0, 2.0),
        script.Result("c", 3, 100, "0 1", 0.1, 0.3, 1, 1, 2),
        script.Result("d", 4, 100, "0 1", 0.1, -0.3, 1, 1, 2),
    ]
    assert math.isnan(script.shares(results)[4])
    results.pop()
    Console(width=100).print(script.table(results))
    shown = capsys.readouterr().out
    assert "0.3500" in shown
    assert "0.2500" in shown
    assert "shares of the specialists' mean: 75.0% (seed 0), 75.0% (seed 3)" in shown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--steps", "0"], "--steps 0 must be at least 1"),
        (["--preferences", "0"], "--preferences 0 must be between 1 and 1000"),
        (["--episodes", "2001"], "--episodes 2001 must be between 1 and 2000"),
        (["--output", "nowhere/found.csv"], "there is no folder nowhere"),
        (["--config", "one_waypoint/ppo_linear"], "must be of conditioned_mo_ppo, with one vehicle and linear"),
        (["--config", "one_waypoint/conditioned"], "must be of conditioned_mo_ppo, with one vehicle and linear"),
    ],
)
def test_invalid_arguments_are_refused(
    script: ModuleType, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        script.main(arguments)
    assert end.value.code == 2
    assert message in " ".join(capsys.readouterr().err.split())
