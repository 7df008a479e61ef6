"""scripts/left_turn_rules.py and scripts/conflicts.py write their tables and pictures."""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING

import pytest

from algorithms.experiments.build import build, load_policy
from algorithms.experiments.config import make_experiment
from algorithms.experiments.run_directory import Run
from algorithms.experiments.training import train_and_finish
from mo_deepdrive.evaluation.episodes import evaluate
from tests.helpers.short_runs import VALUES, quiet

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from types import ModuleType


@pytest.mark.slow
def test_the_rules_are_written_from_risky_to_safe(load_script: Callable[[str], ModuleType], tmp_path: Path) -> None:
    script = load_script("left_turn_rules")
    arguments = ["--gaps", "0", "6", "--episodes", "60", "--split", "validation", "--output", str(tmp_path)]
    assert script.main([*arguments, "--gif", str(tmp_path / "rules.gif")]) == 0
    assert (tmp_path / "rules.gif").read_bytes().startswith(b"GIF89a")
    with (tmp_path / "left_turn_rules.csv").open(encoding="utf-8") as stream:
        risky, safe = csv.DictReader(stream)
    assert (float(risky["gap"]), float(safe["gap"])) == (0.0, 6.0)
    assert float(risky["collision"]) > 0.2
    assert float(safe["collision"]) == 0.0
    assert float(risky["time"]) < float(safe["time_low"])
    # The risk averse count the spread of the outcomes.
    name = "left_turn_risk_averse"
    assert float(risky[name]) < float(risky[f"{name}/utility_ser_low"])
    assert (tmp_path / "left_turn_rules.png").stat().st_size > 1000


@pytest.mark.slow
def test_learnt_policies_are_compared_with_the_best_rule(
    load_script: Callable[[str], ModuleType], tmp_path: Path
) -> None:
    values = {**VALUES, "environment": {"id": "mo-deepdrive-left-turn-v0"}, "utility": {"name": "left_turn_linear"}}
    run = Run.create(make_experiment(values), tmp_path / "run")
    train_and_finish(run, build(run.experiment), quiet())
    arguments = ["--gaps", "0", "6", "--episodes", "60", "--split", "validation", "--output", str(tmp_path)]
    assert load_script("left_turn_rules").main([str(tmp_path / "run"), *arguments]) == 0
    with (tmp_path / "left_turn_rules.csv").open(encoding="utf-8") as stream:
        rows = {row["driver"]: row for row in csv.DictReader(stream)}
    assert list(rows) == ["goes at once", "waits for 6 s", "mo_a2c, seed 0, stochastic", "mo_a2c, seed 0, greedy"]
    best = rows["waits for 6 s"]
    for row in rows.values():
        gain = float(row["left_turn_linear"]) - float(best["left_turn_linear"])
        assert float(row["minus_best_rule"]) == pytest.approx(gain, abs=2e-5)
    # The scores are those of the evaluation that does not measure near misses.
    scores = evaluate(load_policy(run), "mo-deepdrive-left-turn-v0", episodes=60).estimates()
    assert float(rows["mo_a2c, seed 0, greedy"]["left_turn_linear"]) == pytest.approx(
        scores["utility_esr"].value, abs=1e-5
    )


def test_runs_of_other_environments_are_refused(
    load_script: Callable[[str], ModuleType], capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["one_waypoint_linear-mo_ppo", "--gaps", "6", "--episodes", "3"]
    assert load_script("left_turn_rules").main(arguments) == 2
    assert "is of mo-deepdrive-one-waypoint-v0 with the objectives distance, destination" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--gaps", "-1"], "gap = -1.0 of a rule must be a finite number of at least 0"),
        (["--episodes", "2001"], "episodes = 2001 exceeds the 2,000 scenarios of the test split"),
    ],
)
def test_invalid_arguments_are_refused(
    load_script: Callable[[str], ModuleType], capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert load_script("left_turn_rules").main(arguments) == 2
    assert message in capsys.readouterr().err


def test_the_conflicts_of_one_scenario_are_written(load_script: Callable[[str], ModuleType], tmp_path: Path) -> None:
    arguments = ["--scenarios", "one_waypoint", "--drivers", "30", "--episodes", "2", "--output", str(tmp_path)]
    assert load_script("conflicts").main(arguments) == 0
    with (tmp_path / "conflicts.csv").open(encoding="utf-8") as stream:
        assert len(list(csv.DictReader(stream))) == 6
    assert (tmp_path / "conflicts.png").stat().st_size > 1000
