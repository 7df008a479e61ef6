"""scripts/bounds/suite.py: the table of drivers keeps the rows of others, and refuses runs of other environments."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from scripts.bounds import suite
from scripts.bounds.rule_search import SEEING


@pytest.mark.slow
def test_the_table_has_the_bounds_in_place_of_older_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "drivers.csv"
    name, rule = next(iter(SEEING["roundabout"].drawn(1, "discrete").items()))
    monkeypatch.setattr(suite, "bounds", lambda _task: [(name, suite.RULE, None, rule)])
    arguments = ["drivers", "R1", "R2", "--episodes", "4", "--output", str(path)]
    assert suite.main(arguments) == 0
    first = path.read_bytes()
    rows = list(csv.DictReader(path.open(encoding="utf-8")))
    assert [(row["task"], row["driver"], row["kind"]) for row in rows] == [("R1", name, "rule"), ("R2", name, "rule")]
    assert float(rows[0]["worst_off"]) < float(rows[0]["utility"])
    assert float(rows[1]["worst_off"]) == float(rows[1]["utility"])
    assert suite.main(arguments) == 0
    assert path.read_bytes() == first
