"""scripts/left_turn_front.py: the front of rules and learnt policies."""

from __future__ import annotations

import csv
import re
from typing import TYPE_CHECKING

import numpy as np
import pytest

from algorithms.driving.left_turn_rules import SCENARIO

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from types import ModuleType


@pytest.mark.slow
def test_the_front_has_whom_no_other_driver_dominates(
    load_script: Callable[[str], ModuleType], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "front.csv"
    arguments = ["left_turn_linear-mo_ppo", "--gaps", "0", "6", "8", "20", "--episodes", "40", "--split", "validation"]
    assert load_script("left_turn_front").main([*arguments, "--output", str(file)]) == 0
    with file.open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    names = [f"{row['source']}, {row['policy']}" for row in rows]
    assert names[:4] == ["rules, gap 0 s", "rules, gap 6 s", "rules, gap 8 s", "rules, gap 20 s"]
    assert names[4:] == ["left_turn_linear-mo_ppo, greedy", "left_turn_linear-mo_ppo, stochastic"]
    means, low, high = (
        np.array([[float(row[name + end]) for name in SCENARIO.objectives] for row in rows])
        for end in ("", "_low", "_high")
    )
    assert (low <= means).all()
    assert (means <= high).all()
    dominated = [any((other >= own).all() and (other > own).any() for other in means) for own in means]
    assert [row["non_dominated"] for row in rows] == ["0" if each else "1" for each in dominated]
    destination = SCENARIO.objectives.index("destination")
    assert [float(row["arrived"]) for row in rows] == pytest.approx(means[:, destination], abs=1e-4)
    printed = capsys.readouterr().out
    assert "40 episodes of the validation split" in printed
    assert "left_turn_linear-mo_ppo" in printed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["one_waypoint_linear-ppo", "--gaps", "6", "--episodes", "20"], "expected mo-deepdrive-left-turn-v0"),
        (["--gaps", "-1", "--episodes", "20"], r"gap = -1\.0 of a rule"),
        (["--episodes", "3000"], "exceeds the 2,000 scenarios of the test split"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    load_script: Callable[[str], ModuleType], capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert load_script("left_turn_front").main([*arguments, "--split", "test"]) == 2
    assert re.search(message, capsys.readouterr().err)
