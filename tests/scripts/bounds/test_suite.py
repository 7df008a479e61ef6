"""scripts/bounds/suite.py: the floors and ceilings of the suite are those of its table, which keeps rows of others."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from mo_deepdrive import suite as package
from scripts.bounds import suite
from tests.helpers.paths import REPOSITORY

TASKS = package.load().tasks


def scores(task_id: str) -> dict[str, float]:
    """The best score of each kind in the table."""
    best: dict[str, float] = {}
    with (REPOSITORY / suite.RESULTS).open(encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(stream):
            if row["task"] == task_id and row["column"] == "score":
                best[row["kind"]] = max(best.get(row["kind"], float("-inf")), float(row["value"]))
    return best


@pytest.mark.parametrize("task_id", TASKS)
def test_floors_and_ceilings_are_those_of_the_table(task_id: str) -> None:
    task, best = TASKS[task_id], scores(task_id)
    assert task.floor.value == best[suite.FLOOR]
    assert task.ceiling.value == best.get(suite.CEILING, best.get(suite.RULE))
    if task.rule is not None:
        assert task.rule.value == best[suite.RULE]


@pytest.mark.slow
@pytest.mark.parametrize("task_id", ["U2", "U4"])
def test_planned_drives_are_worth_what_the_table_says(task_id: str) -> None:
    best = {kind: value for _, kind, column, value, *_ in suite.bounds(task_id) if column == "score"}
    assert best == pytest.approx(scores(task_id), rel=1e-3)


def test_rows_of_other_tasks_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "bounds.csv"
    monkeypatch.setattr(suite, "bounds", lambda task_id: [[task_id, "floor", "score", 1.23456, 1.0, 2.0, "nobody"]])
    for task_id in ("K4", "K1", "K4"):
        assert suite.main(["bounds", task_id, "--output", str(path)]) == 0
    rows = list(csv.DictReader(path.open(encoding="utf-8")))
    assert [(row["task"], row["value"]) for row in rows] == [("K1", "1.235"), ("K4", "1.235")]


def test_known_rules_have_the_numbers_of_their_families() -> None:
    assert all(len(family.ranges) == len(numbers) for family, numbers in suite.KNOWN.values())
