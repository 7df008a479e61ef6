"""The tables of results in the documentation are those that their files give."""

from __future__ import annotations

import csv
import hashlib
import os
import subprocess
from collections.abc import Callable
from fnmatch import fnmatchcase
from types import ModuleType

import pytest

from mo_deepdrive import suite
from tests.helpers.paths import REPOSITORY

RESULTS = REPOSITORY / "docs" / "results"
NO_RESULTS = {"provenance.csv", "changes.csv", "views.sql"}


@pytest.fixture
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("result_tables")


@pytest.mark.slow
def test_the_documentation_has_the_numbers_of_its_files(script: ModuleType) -> None:
    database = script.open_results()
    made = 0
    for path in script.documents():
        text = path.read_text(encoding="utf-8")
        assert script.refresh(text, database, path.parent) == text, f"python scripts/result_tables.py changes {path}"
        made += len(script.MADE.findall(text))
    assert made


def read(name: str) -> list[dict[str, str]]:
    with (RESULTS / name).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_every_file_of_results_has_a_commit_a_command_and_its_digest() -> None:
    files = {str(path.relative_to(RESULTS)): path for path in sorted(RESULTS.rglob("*")) if path.is_file()}
    files = {name: path for name, path in files.items() if name not in NO_RESULTS}
    rows = read("provenance.csv")
    assert not [name for name in files if not any(fnmatchcase(name, row["file"]) for row in rows)], "no row"
    for row in rows:
        found = [path.read_bytes() for name, path in files.items() if fnmatchcase(name, row["file"])]
        assert found, f"{row['file']}: no such file"
        assert row["commit"], row["file"]
        assert row["command"], row["file"]
        digest = hashlib.sha256(b"".join(found)).hexdigest()[:8]
        message = f"{row['file']} has changed: its row needs the commit that made it, and the digest {digest}"
        assert row["digest"] == digest, message


@pytest.mark.slow
def test_the_code_of_a_result_has_the_changes_that_its_row_says() -> None:
    def git(*arguments: str) -> str:
        command, environment = ["git", "-C", str(REPOSITORY), *arguments], {**os.environ, "TZ": "UTC"}
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout

    if not (REPOSITORY / ".git").exists() or git("rev-parse", "--is-shallow-repository").strip() != "false":
        pytest.skip("the history is not here")
    changes, results = read("changes.csv"), read("provenance.csv")
    for row in [*changes, *results]:
        first, *others = row["commit"].split()
        date = git("log", "-1", "--format=%ad", "--date=format-local:%Y-%m-%d %H:%M", first, "--")
        assert date.strip() == row["date"], row
        for commit in others:
            git("cat-file", "-e", f"{commit}^{{commit}}")
    for row in results:
        before = "\n" + git("rev-list", row["commit"].split()[0], "--")
        within = [f"\n{change['commit']}" in before for change in changes]
        assert int(row["changes"]) == [*within, False].index(False), row


@pytest.mark.slow
def test_the_scoreboard_has_a_section_and_a_sentence_per_task_whether_it_has_been_run_or_not(
    script: ModuleType,
) -> None:
    task = suite.load().tasks["K4"]
    run = {"task": "K4", "policy": "stochastic", "column": "score", "version": suite.load().version}
    results = [suite.Row(**run, learner="ppo", seed=seed, value=task.ceiling.value) for seed in range(3)]
    results += [suite.Row(**run, learner="lintune", seed=seed, value=task.floor.value) for seed in range(3)]
    database = script.open_results()
    script.fill_suite(database, results, {})
    document = (
        "<!-- suite: results -->\n\nold\n<!-- end -->\n<!-- table: SELECT task, score FROM suite_list -->\n\n| a |\n"
    )
    page = script.refresh(document, database)
    assert "- **K3**: Not run.\n" in page
    assert "- **K4**: PPO (1) is the best, ahead of the ablation, LinTune, by 1 with p = 0.001" in page
    assert "| `K4` | 1 |" in page
    assert "old" not in page
    ((text,),) = database.execute("SELECT text FROM suite_texts WHERE name = 'tasks'").fetchall()
    assert text.count("### ") == len(suite.load().tasks)
    assert f"`{task.formula}`" in text
    assert text.count("Not run.") == len(suite.load().tasks) - 1
