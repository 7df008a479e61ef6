"""scripts/ceiling.py: solutions arrive in the public environment, and the CSV has one row per scenario."""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from rich.console import Console

from algorithms.planning.solvability import ScenarioOutcome

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from types import ModuleType

SEED = 1_000_000


@pytest.fixture(scope="module")
def ceiling(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """The script as a module."""
    return load_script("ceiling")


def test_every_solution_arrives_and_two_runs_agree(
    ceiling: ModuleType, make_single: Callable[..., Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [tmp_path / "first.csv", tmp_path / "second.csv"]
    for file in files:
        ceiling.main(["--scenarios", "3", "--seed", str(SEED), "--beam", "512", "--output", str(file)])
    assert files[0].read_bytes() == files[1].read_bytes()
    assert "3 (100.00%)" in capsys.readouterr().out
    with files[0].open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["scenario"] for row in rows] == ["0", "1", "2"]
    env = make_single("static_obstacle")
    for i, row in enumerate(rows):
        assert row["solved"] == "1"
        assert int(row["decisions"]) == len(row["actions"])
        env.reset(seed=SEED + i)
        for letter in row["actions"]:
            *_, info = env.step(ord(letter) - ord("a"))
        assert info["end"] == "arrived"


def test_scenarios_that_were_not_solved_are_listed(ceiling: ModuleType, make_single: Callable[..., Any]) -> None:
    env = make_single("static_obstacle")
    env.reset(seed=0)
    start = env.batch.state[0].copy()
    outcomes = [ScenarioOutcome(start, "ab", 1, exhausted=False), ScenarioOutcome(start, "", 345, exhausted=True)]
    console = Console(width=120, record=True)
    ceiling.print_tables(outcomes, console)
    text = console.export_text()
    assert "1 (50.00%)" in text
    assert "9.45% to 90.55%" in text  # Wilson's interval of 1 out of 2
    (row,) = [line for line in text.splitlines() if "345" in line]
    assert row.split("│")[1].strip() == "1"
    assert row.split("│")[7].strip() == "yes"
    assert np.isfinite(float(row.split("│")[2]))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scenarios", "0"], "--scenarios 0 must be at least 1"),
        (["--seed", "-1"], "--seed -1 must be at least 0"),
        (["--beam", "21"], "--beam 21 must be at least 22"),
        (["--output", "/no/such/folder/file.csv"], "there is no folder /no/such/folder"),
    ],
)
def test_bad_arguments_are_refused(
    ceiling: ModuleType, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        ceiling.main(arguments)
    assert message in capsys.readouterr().err
