"""scripts/left_turn_rules.py and scripts/conflicts.py write their tables and pictures."""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING

import pytest

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
