"""The ceiling of StaticObstacle: solutions arrive in the public environment, and the CSV says what was found."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

SEED = 1_000_000
FAR = ((19.5, 46.0), (20.5, 46.0))  # a bicycle at the edge of the map
STRAIGHT_ON = (30.0, 25.5)
AT_THE_NOSE = ((9.8, 25.6), (12.0, 25.6))  # a bicycle that points at the nose, 5 cm before it


@pytest.fixture(scope="module")
def ceiling(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """The script as a module."""
    return load_script("ceiling")


def test_command_line(
    ceiling: ModuleType, make_single: Callable[..., Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every solution in the CSV arrives when it is driven from the same seed, and two runs agree."""
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


def test_far_bicycle_is_solved(ceiling: ModuleType, make_single: Callable[..., Any]) -> None:
    env = make_single("static_obstacle")
    env.reset(seed=0, options={"obstacle": FAR, "destination": STRAIGHT_ON})
    outcome = ceiling.solve(env.batch.state[0].copy(), 512)
    assert 0 < len(outcome.actions) <= 100


def test_bicycle_at_the_nose_is_not_solved(ceiling: ModuleType, make_single: Callable[..., Any]) -> None:
    """Whoever cannot reverse cannot leave; the search says that it has tried everything."""
    env = make_single("static_obstacle")
    env.reset(seed=0, options={"obstacle": AT_THE_NOSE, "destination": STRAIGHT_ON})
    start = env.batch.state[0].copy()
    outcome = ceiling.solve(start, 512)
    assert outcome.actions == ""
    assert outcome.exhausted
    gap, nearer_end, *_ = ceiling.geometry(start[0])
    assert (gap, nearer_end) == ("0.05", "0.05, 0.04")


def test_estimate_leads_around_the_bicycle(ceiling: ModuleType, make_single: Callable[..., Any]) -> None:
    """A bicycle across the way makes it longer; one beside it or behind the destination does not."""
    env = make_single("static_obstacle")
    found = []
    for obstacle in (FAR, ((20.0, 24.0), (20.0, 27.0)), ((32.0, 24.0), (32.0, 27.0))):
        env.reset(seed=0, options={"obstacle": obstacle, "destination": STRAIGHT_ON})
        found.append(float(ceiling.estimates(env.batch.state[0])[0]))
    assert found[1] > found[0] + 0.1
    assert found[2] == pytest.approx(found[0])


def test_false_solution_is_refused(ceiling: ModuleType, make_single: Callable[..., Any]) -> None:
    with pytest.raises(RuntimeError, match="seed 7 ends with None"):
        ceiling.replay(make_single("static_obstacle"), 7, "aaa")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scenarios", "0"], "--scenarios 0 must be at least 1"),
        (["--seed", "-1"], "--seed -1 must be at least 0"),
        (["--beam", "21"], "--beam 21 must be at least 22"),
        (["--output", "/no/such/folder/file.csv"], "there is no folder /no/such/folder"),
    ],
)
def test_bad_arguments(
    ceiling: ModuleType, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        ceiling.main(arguments)
    assert message in capsys.readouterr().err
