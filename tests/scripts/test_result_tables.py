"""The tables of results in the documentation are those that their files give."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import pytest


@pytest.fixture
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """The script as a module."""
    return load_script("result_tables")


@pytest.mark.slow
def test_the_documentation_has_the_numbers_of_its_files(script: ModuleType) -> None:
    database = script.open_results()
    made = 0
    for path in script.documents():
        text = path.read_text(encoding="utf-8")
        assert script.refresh(text, database) == text, f"python scripts/result_tables.py changes {path}"
        made += len(script.MADE.findall(text))
    assert made


def test_a_table_is_made_whole_from_a_query(script: ModuleType) -> None:
    text = "<!-- table: SELECT 'x' AS a, NULL AS b -->\n\n{}after\n"
    database = script.sqlite3.connect(":memory:")
    made = text.format("| a | b |\n| --- | --- |\n| x |  |\n\n")
    assert script.refresh(text.format("| old |\n|---|\n| 1 |\n"), database) == made
    assert script.refresh(made, database) == made
    with pytest.raises(ValueError, match="no such column: x"):
        script.refresh("<!-- table: SELECT x -->\n\n", database)


@pytest.mark.slow
def test_the_scoreboard_normalises_and_counts_failed_runs(script: ModuleType) -> None:
    database = script.open_results()
    scored = [["K1", "a", seed, "stochastic", "score", 6.7, "finished", 60] for seed in range(2)]
    failed = [["K1", "a", 2, "", "", "", "failed", ""]]
    other = [["K1", "a", 0, "greedy", "score", 100.0, "finished", 60]]
    header = ["task", "learner", "seed", "policy", "column", "value", "state", "cpu_seconds"]
    script.fill(database, "suite", header, [*scored, *failed, *other])
    database.execute("UPDATE suite_tasks SET floor = 0, ceiling = 6.7")
    assert database.execute("SELECT seed, score FROM suite_normalised").fetchall() == [(0, 1.0), (1, 1.0), (2, -1.0)]
    assert database.execute("SELECT * FROM suite_tracks").fetchall() == [("a", "0.33 (1)", None, None)]
