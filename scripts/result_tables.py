"""Make the tables of results in the documentation from the CSV files of docs/results.

    python scripts/result_tables.py

A table after ``<!-- table: SELECT ... -->``, a query of SQLite, is made whole: its header has the names of the columns
of the query, its rows are the results. ``docs/results/runs.csv`` is the table ``runs``, a file in a folder has the name
``folder_file``, and what follows an empty line in ``scores.csv`` is ``scores_1``. Of the suite there is the table
``suite_tasks``, with the best learner of each, and of the constraints the table ``pins``; views of
``docs/results/views.sql`` are tables, too. Below a table of results is a line with the commits whose code made them,
from ``docs/results/provenance.csv``. From ``<!-- suite: tasks -->`` to ``<!-- end -->`` is a section per task, in place
of ``tasks`` of ``results`` what they say.
"""

from __future__ import annotations

import csv
import io
import json
import os
import re
import sqlite3
import sys
from typing import TYPE_CHECKING, Any

from benchmark import REPOSITORY

from algorithms.runs.cli import Command
from algorithms.studies.suite_tables import Scoreboard
from algorithms.zoo import ZOO
from mo_deepdrive import suite
from mo_deepdrive.evaluation.statistics import with_decimals
from mo_deepdrive.support.atomic_io import atomic_write

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Sequence
    from pathlib import Path

MADE = re.compile(
    r"(?P<comment><!-- table:(?P<query>.*?)-->\n\n)((\|[^\n]*\n)+\n?)*(Results of commits? `[^\n]*\n\n?)?", re.DOTALL
)
TEXT = re.compile(r"(?P<before><!-- suite: (?P<name>\w+) -->\n\n).*?(?P<after><!-- end -->)", re.DOTALL)
FIGURE = REPOSITORY / "docs" / "results" / "suite_scores.png"  # of mo-deepdrive suite table --figure
PICTURES = REPOSITORY / "docs" / "images" / "suite"
CONSTRAINTS = ("constraints.txt", "constraints-peers.txt", "constraints-integrations.txt")
PIN = re.compile(r"^([\w.-]+)==([\w.]+)$", re.MULTILINE)  # a package of which all versions of Python have the same
PROVENANCE = REPOSITORY / "docs" / "provenance.md"
FROM_SUITE = ("suite_tasks", "suite_texts")  # tables of what docs/results/suite.csv has


def open_results() -> sqlite3.Connection:
    """A database with the CSV files of docs/results and the functions of the queries."""
    database = sqlite3.connect(":memory:")
    database.execute("PRAGMA automatic_index = OFF")  # rows stay in the order of their files
    folder = REPOSITORY / "docs" / "results"
    files: dict[str, str] = {}
    for path in sorted(folder.rglob("*.csv")):
        name = "_".join(path.relative_to(folder).with_suffix("").parts)
        files[name] = str(path.relative_to(folder))
        for k, part in enumerate(path.read_text(encoding="utf-8").split("\n\n")):
            header, *rows = csv.reader(io.StringIO(part))
            fill(database, f"{name}_{k}" if k else name, header, rows)
    results = suite.read_rows(folder / "suite.csv")
    fill_suite(database, results, suite.samples_of(results, suite.read_samples(folder / "suite.csv")))
    fill(database, "result_files", ["name", "file"], [*(files | dict.fromkeys(FROM_SUITE, files["suite"])).items()])
    commits = {path.parent.name: json.loads(path.read_bytes())["commit"] for path in sorted(ZOO.glob("*/about.json"))}
    fill(database, "zoo", ["policy", "commit"], [*commits.items()])
    pins = "".join((REPOSITORY / name).read_text(encoding="utf-8") for name in CONSTRAINTS)
    rows = [[name.lower().replace("_", "-"), version] for name, version in PIN.findall(pins)]
    fill(database, "pins", ["package", "version"], rows)
    database.create_function(
        "decimals", 2, lambda value, places: None if value is None else with_decimals(value, places)
    )
    database.executescript((folder / "views.sql").read_text(encoding="utf-8"))
    return database


def fill_suite(database: sqlite3.Connection, results: list[suite.Row], samples: suite.Samples) -> None:
    """Make the tables of the suite: its tasks with the best learner of each, and the texts on them."""
    board = Scoreboard(results, samples)
    fields = ["title", "tests", "formula", "track", "core", "counted", "steps", "policy"]
    tasks: list[list[Any]] = []
    pages: list[str] = []
    for name, task in suite.load().tasks.items():
        best = board.best(name)
        first, score = (best[0], board.scores(name)[best[0]].mean.estimate.text()) if best else (None, None)
        labels = " = ".join(board.labels.get(learner, learner) for learner in best) or "not run"
        bounds = [task.floor.value, task.ceiling.value]
        tasks.append([name, *(getattr(task, field) for field in fields), *bounds, first, labels, score])
        picture = f"![{name}: two drives that are ranked differently](images/suite/{name}.png)\n\n"
        pages.append(f"{board.page(name)}\n\n{picture if (PICTURES / f'{name}.png').is_file() else ''}")
    fill(database, "suite_tasks", ["task", *fields, "floor", "ceiling", "first", "best", "score"], tasks)
    figure = "![Scores of the learners by task](results/suite_scores.png)\n\n" if FIGURE.is_file() else ""
    says = [f"- **{name}**: {' '.join(board.sentences(name))}\n" for name in suite.load().tasks]
    fill(
        database,
        "suite_texts",
        ["name", "text"],
        [["tasks", "".join(pages)], ["results", figure + "".join(says) + "\n"]],
    )


def fill(database: sqlite3.Connection, table: str, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Make a table of a database, in place of one with this name."""
    database.execute(f'DROP TABLE IF EXISTS "{table}"')
    # Text that is a number becomes one, but for a hash such as 414765e9.
    columns = ", ".join(f'"{name}" {"TEXT" if name == "commit" else "NUMERIC"}' for name in header)
    database.execute(f'CREATE TABLE "{table}" ({columns})')
    database.executemany(f'INSERT INTO "{table}" VALUES ({", ".join("?" * len(header))})', rows)


def made_by(tables: set[str], database: sqlite3.Connection, folder: Path) -> str:
    """The line with the commits that made what is in ``tables``; empty if nothing there is a result."""
    query = 'SELECT name, "commit" FROM result_files AS r JOIN provenance AS p ON r.file GLOB p.file ORDER BY date'
    made = database.execute(query) if tables else ()
    commits = [commit for name, cell in made if name in tables for commit in cell.split()]
    if not commits:
        return ""
    ends = [f"`{commit}`" for commit in dict.fromkeys([commits[0], commits[-1]])]
    page = os.path.relpath(PROVENANCE, folder)
    return f"Results of commit{'s' * (len(ends) - 1)} {' to '.join(ends)} ([what changed since]({page})).\n\n"


def refresh(document: str, database: sqlite3.Connection, folder: Path = REPOSITORY) -> str:
    """A document in ``folder`` with its tables made anew, below each the commits that made its results."""
    read: set[str] = set()

    def note(action: int, name: str | None, *_: str | None) -> int:
        read.update([name] if action == sqlite3.SQLITE_READ and name else [])
        return sqlite3.SQLITE_OK

    def table(match: re.Match[str]) -> str:
        read.clear()
        try:
            cursor = database.execute(match["query"])
            rows = cursor.fetchall()
        except sqlite3.Error as error:
            raise ValueError(f"{folder}: {type(error).__name__}: {error}, by {match['query']}") from None
        header = [name for name, *_ in cursor.description]
        lines = [header, ["---"] * len(header), *rows]
        made = ["| " + " | ".join("" if cell is None else str(cell) for cell in line) + " |\n" for line in lines]
        return match["comment"] + "".join(made) + "\n" + made_by(read, database, folder)

    def text(match: re.Match[str]) -> str:
        ((made,),) = database.execute("SELECT text FROM suite_texts WHERE name = ?", [match["name"]])
        return f"{match['before']}{made}{made_by({'suite_texts'}, database, folder)}{match['after']}"

    database.set_authorizer(note)
    return TEXT.sub(text, MADE.sub(table, document))


def documents() -> list[Path]:
    """The documents that may have such tables; the lab's are records, and the site's build writes the copy."""
    docs = REPOSITORY / "docs"
    pages = [path for path in docs.rglob("*.md") if docs / "lab" not in path.parents and path.name != "_readme.md"]
    return [REPOSITORY / "README.md", *sorted(pages)]


def refresh_all(_options: Namespace) -> int:
    """Make the tables of all documents anew, and print which have changed."""
    database = open_results()
    for path in documents():
        before = path.read_text(encoding="utf-8")
        after = refresh(before, database, path.parent)
        if after != before:
            atomic_write(path, after.encode())
            print(path.relative_to(REPOSITORY))
    return 0


main = Command("", __doc__, (), refresh_all)

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
