"""The tables of results in the documentation are those that their files give."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import pytest

from mo_deepdrive import suite


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
    ceiling = suite.load().tasks["K1"].ceiling.value
    run = {"task": "K1", "learner": "a", "state": "finished", "cpu_seconds": 60.0}
    results = [suite.Row(**run, seed=seed, policy="stochastic", column="score", value=ceiling) for seed in range(2)]
    results += [suite.Row(**run, seed=0, policy="greedy", column="score", value=100.0)]
    results += [suite.Row(**{**run, "state": "failed", "cpu_seconds": None}, seed=2, policy="", column="", value=None)]
    database = script.open_results()
    for table in ("tasks", "normalised", "learners", "board"):
        database.execute(f"DROP TABLE suite_{table}")
    script.fill_suite(database, results)
    assert database.execute("SELECT learner, score FROM suite_normalised").fetchall() == [
        ("a", 1.0),
        ("a", 1.0),
        ("a", -1.0),
    ]
    assert database.execute("SELECT * FROM suite_tracks").fetchall() == [("a", "0.33 (1)", None, None)]
