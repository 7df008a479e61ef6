"""Fill the tables of results in the documentation with the numbers of the CSV files next to them.

    python scripts/result_tables.py

A table whose numbers come from files follows a query of SQLite in a comment:

    <!-- numbers: SELECT avg(utility) AS "utility (ESR)" FROM runs, row WHERE runs.algorithm = slug(row.algorithm) -->

    | algorithm | seeds | utility (ESR) |

It is made for every row of the table. ``row`` has the row's own cells, an empty one at the beginning being that of the
row above; ``docs/results/runs.csv`` is the table ``runs``, ``cross_play/cross_play.csv`` is ``cross_play_cross_play``,
and what follows an empty line in ``scores.csv`` is ``scores_1``. The numbers that the query returns for a column
replace those of its cell, with as many decimals as are there; the words of the cell remain. A result without numbers
replaces the whole cell; an empty cell stays empty.

A table after ``<!-- table: SELECT ... -->`` is made whole: its header has the names of the columns of the query, its
rows are the results. The tasks of the suite are the table ``suite_tasks``, what ``suite table`` prints of them
``suite_board``; the views of ``docs/results/views.sql`` are tables, too.
"""

from __future__ import annotations

import csv
import io
import re
import sqlite3
import sys
from itertools import takewhile
from typing import TYPE_CHECKING, Any

import numpy as np
from paired_benchmark import REPOSITORY

import mo_deepdrive
from algorithms.experiments.cli import make_parser
from algorithms.studies.suite_tables import Scoreboard
from mo_deepdrive import suite
from mo_deepdrive.atomic_io import atomic_write
from mo_deepdrive.evaluation.pareto import hypervolume
from mo_deepdrive.evaluation.statistics import interquartile_mean, mean
from mo_deepdrive.scenarios import SCENARIOS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

# No result are the layers of a network, 64-32, and the second number of "9 of 10".
NUMBER = re.compile(r"(?<![\w.,])(?<!\d-)(?<! of )-?\d+(?:,\d{3})*(?:\.\d+)?(?:e-\d+)?(?!\w|-\d)")
MARKED = re.compile(r"<!-- numbers:(?P<query>.*?)-->\n\n(?P<table>(?:\|[^\n]*\n)+)", re.DOTALL)
MADE = re.compile(r"(?P<comment><!-- table:(?P<query>.*?)-->\n\n)(?:\|[^\n]*\n)*\n?", re.DOTALL)
TITLES = {scenario.title: scenario for scenario in SCENARIOS.values()}


class Column:
    """An aggregate of a column of numbers; of several columns, row by row."""

    def __init__(self) -> None:
        self.values: list[float] = []

    def step(self, *values: float | None) -> None:
        """Add the values of a row; those that are missing do not count."""
        self.values += [value for value in values if value is not None]


class ListOf(Column):
    """All numbers."""

    def finalize(self) -> str:
        """The numbers as text."""
        return joined(*self.values)


class Interval(Column):
    """The mean with its interval, rounded as in all tables of the package."""

    def finalize(self) -> str:
        """The numbers as text."""
        return mean(np.array(self.values)).text()


class MeanAndRange(Column):
    """The mean, the least and the greatest."""

    def finalize(self) -> str:
        """The numbers as text."""
        return joined(float(np.mean(self.values)), min(self.values), max(self.values))


class InterquartileMean(Column):
    """The mean of the middle half."""

    def finalize(self) -> float | None:
        """The number."""
        return float(interquartile_mean(np.array(self.values))) if self.values else None


class Hypervolume:
    """The hypervolume of undiscounted returns above the reference point of a scenario: its name, then the returns."""

    def __init__(self) -> None:
        self.rows: list[Sequence[float]] = []

    def step(self, scenario: str, *returns: float) -> None:
        """Add a policy."""
        self.scenario = scenario
        self.rows.append(returns)

    def finalize(self) -> float:
        """The hypervolume."""
        corner = mo_deepdrive.reference_point(self.scenario, gamma=1.0).values
        return float(hypervolume(np.array(self.rows), corner))


def joined(*values: Any) -> str:
    """Numbers as text, all of their digits."""
    return " ".join(map(repr, values))


def numbers(text: str) -> list[float]:
    """The numbers in ``text``."""
    return [float(number.replace(",", "")) for number in NUMBER.findall(text)]


def typed(text: Any) -> Any:
    """A cell as a number, if it is one."""
    if not isinstance(text, str):
        return text
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def open_results() -> sqlite3.Connection:
    """A database with the CSV files of docs/results and the functions of the queries."""
    database = sqlite3.connect(":memory:")
    database.execute("PRAGMA automatic_index = OFF")  # rows stay in the order of their files
    folder = REPOSITORY / "docs" / "results"
    for path in sorted(folder.rglob("*.csv")):
        name = "_".join(path.relative_to(folder).with_suffix("").parts)
        for k, part in enumerate(path.read_text(encoding="utf-8").split("\n\n")):
            header, *rows = csv.reader(io.StringIO(part))
            fill(database, f"{name}_{k}" if k else name, header, rows)
    fill(database, "suite_tasks", *suite_tasks())
    header, *rows = Scoreboard(suite.read_rows(folder / "suite.csv"), suite.load()).task_table()
    fill(database, "suite_board", header, rows)
    functions: dict[str, Callable[..., Any]] = {
        "id": lambda title: TITLES[title].id,
        "scenario": lambda title: TITLES[title].name,
        "slug": lambda title: title.lower().replace("-", "_"),
        "code": lambda text: str(text).replace("`", ""),
        "number": lambda text: numbers(str(text))[0],
        "times": lambda factor, text: joined(*(factor * number for number in numbers(str(text)))),
        "significant": lambda value, digits: float(f"{value:.{digits}g}"),
        "decimals": lambda value, places: None if value is None else f"{value:.{places}f}",
        "joined": joined,
    }
    for name, function in functions.items():
        database.create_function(name, -1, function, deterministic=True)
    aggregates: dict[str, Any] = {"list": ListOf, "interval": Interval, "mean_and_range": MeanAndRange}
    aggregates |= {"hypervolume": Hypervolume}
    aggregates |= {"interquartile_mean": InterquartileMean}
    for name, aggregate in aggregates.items():
        database.create_aggregate(name, -1, aggregate)
    database.executescript((folder / "views.sql").read_text(encoding="utf-8"))
    return database


def suite_tasks() -> tuple[list[str], list[list[Any]]]:
    """Columns and rows of the table of the suite's tasks, in order."""
    fields = ["title", "tests", "track", "core", "counted", "steps", "score", "policy"]
    rows = []
    for name, task in suite.load().tasks.items():
        bounds = [task.floor.value, task.floor.by, task.ceiling.value, task.ceiling.by, task.ceiling.kind]
        rows.append([name, *(getattr(task, field) for field in fields), *bounds])
    return ["task", *fields, "floor", "floor_by", "ceiling", "ceiling_by", "kind"], rows


def fill(database: sqlite3.Connection, table: str, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Make a table of a database, in place of one with this name."""
    database.execute(f'DROP TABLE IF EXISTS "{table}"')
    columns = ", ".join(f'"{name}"' for name in header)
    database.execute(f'CREATE TABLE "{table}" ({columns})')
    marks = ", ".join("?" * len(header))
    database.executemany(f'INSERT INTO "{table}" VALUES ({marks})', [[*map(typed, row)] for row in rows])


def cells_of(line: str) -> list[str]:
    """The cells of a row of Markdown."""
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def refreshed(cell: str, result: Any) -> str:
    """A cell with the numbers of a result.

    Raises:
        ValueError: if it has another number of them.
    """
    new = numbers(str(result))
    if not new:
        return str(result)
    old = NUMBER.findall(cell)
    if len(old) != len(new):
        raise ValueError(f"{cell!r} has {len(old)} numbers, the result has {len(new)}: {result}")
    values = iter(new)

    def text(match: re.Match[str]) -> str:
        value, before = next(values), match.group()
        digits = len(before.partition("e")[0].partition(".")[2])
        if abs(value - float(before.replace(",", ""))) <= 0.5 * 10.0**-digits + 1e-9:
            return before  # however it was rounded
        return f"{value:{',' if ',' in cell else ''}.{digits}f}"

    return NUMBER.sub(text, cell)


def refresh(document: str, database: sqlite3.Connection) -> str:
    """A document with the numbers of its marked tables.

    Raises:
        ValueError: if a query is invalid, or does not fit to a row of its table.
    """

    def table(match: re.Match[str]) -> str:
        lines = match["table"].splitlines()
        header = cells_of(lines[0].replace("`", ""))
        above, found = [""] * len(header), lines[:2]
        for line in lines[2:]:
            shown = cells_of(line)
            empty = len(list(takewhile(lambda cell: not cell, shown)))
            above = [*above[:empty], *shown[empty:]]
            fill(database, "row", header, [above])
            try:
                cursor = database.execute(match["query"])
                (results,) = cursor.fetchall()
                for (name, *_), result in zip(cursor.description, results, strict=True):
                    place = header.index(name)
                    if shown[place] and result is not None:
                        shown[place] = refreshed(shown[place], result)
            except (ValueError, sqlite3.Error) as error:
                raise ValueError(f"{type(error).__name__}: {error}\n  in {line}\n  by {match['query']}") from None
            found.append(line if shown == cells_of(line) else f"| {' | '.join(shown)} |")
        return match.group()[: match.start("table") - match.start()] + "\n".join(found) + "\n"

    def whole_table(match: re.Match[str]) -> str:
        try:
            cursor = database.execute(match["query"])
            rows = cursor.fetchall()
        except sqlite3.Error as error:
            raise ValueError(f"{type(error).__name__}: {error}\n  by {match['query']}") from None
        header = [name for name, *_ in cursor.description]
        lines = [header, ["---"] * len(header), *rows]
        made = ["| " + " | ".join("" if cell is None else str(cell) for cell in line) + " |\n" for line in lines]
        return match["comment"] + "".join(made) + "\n"

    return MADE.sub(whole_table, MARKED.sub(table, document))


def documents() -> list[Path]:
    """The documents that may have marked tables; the lab's are records, and the site's build writes the copy."""
    docs = REPOSITORY / "docs"
    pages = [path for path in docs.rglob("*.md") if docs / "lab" not in path.parents and path.name != "_readme.md"]
    return [REPOSITORY / "README.md", *sorted(pages)]


def main(arguments: list[str] | None = None) -> int:
    """Run the command line ``arguments``, those of the process if None, and return the exit code."""
    make_parser(__doc__).parse_args(arguments)
    database = open_results()
    for path in documents():
        before = path.read_text(encoding="utf-8")
        try:
            after = refresh(before, database)
        except ValueError as error:
            print(f"error: {path}: {error}", file=sys.stderr)
            return 2
        if after != before:
            atomic_write(path, after.encode())
            print(path.relative_to(REPOSITORY))
    return 0


if __name__ == "__main__":
    sys.exit(main())
