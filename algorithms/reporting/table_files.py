"""Tables of scores as files: tidy CSV for programs, LaTeX and Markdown for papers and pages. A file has one table."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from algorithms.reporting.seed_tables import (
    TABLE_COLUMNS,
    UTILITY_IQM,
    ScoreGroup,
    comparison_table,
    interval_note,
    scores_table,
    tidy_comparisons,
    tidy_scores,
)
from algorithms.reporting.style import algorithm_label
from algorithms.reporting.wide_tables import lift_labels
from mo_deepdrive.evaluation.metrics import UTILITY_ESR, title_of
from mo_deepdrive.support.atomic_io import atomic_write, csv_bytes

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from algorithms.reporting.seed_tables import Cells
    from algorithms.reporting.wide_tables import Rows

FORMATS = (".csv", ".md", ".tex")
DIFFERENCES = "-differences"  # after the name of a file
_LATEX = {
    **{each: f"\\{each}" for each in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "|": r"\textbar{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "²": "$^2$",
    "³": "$^3$",
}


def write_tables(
    path: Path, scores: Sequence[ScoreGroup], compared: Sequence[ScoreGroup], columns: Sequence[str] | None = None
) -> list[Path]:
    """Write the scores and, if algorithms can be compared, their differences into ``NAME-differences``.

    A CSV has one number per cell, and the returns of all objectives; LaTeX and Markdown have the table of the terminal,
    with names as people write them.

    Args:
        path: the file, whose ending is one of :data:`FORMATS`.
        scores: the rows of the first table.
        compared: the groups of the second table.
        columns: metrics of the first table; None for all of a CSV, and :data:`TABLE_COLUMNS` of the others.

    Returns:
        The files.

    Raises:
        OSError: if a file cannot be written; it is then unchanged.
    """
    note = interval_note(scores)
    if path.suffix.lower() == ".csv":
        rows = tidy_scores(scores, columns)
        return write_files(path, {"": (rows, 0, note), DIFFERENCES: (tidy_comparisons(compared), 0, "")})
    table, differences = scores_table(scores, columns or TABLE_COLUMNS), comparison_table(compared)
    labels = table[0].index("seeds") + 1
    tables = {"": (_in_words(table, labels), labels, note)}
    if len(differences) > 1:
        labels = differences[0].index("mean")
        tables[DIFFERENCES] = (_in_words(differences, labels), labels, f"Differences of the algorithms. {note}")
    return write_files(path, tables)


def _in_words(rows: Rows, labels: int) -> Rows:
    """A table with the names of algorithms and metrics as people write them."""
    header, *body = rows

    def words(column: str, cell: str) -> str:
        if column in ("algorithm", "difference"):
            return " ".join(map(algorithm_label, cell.split(" ")))
        return _title(cell) if column == "metric" else cell

    titles = [*header[:labels], *map(_title, header[labels:])]
    return [titles, *([words(name, cell) for name, cell in zip(header, row, strict=True)] for row in body)]


def _title(metric: str) -> str:
    return f"{title_of(UTILITY_ESR)} (IQM)" if metric == UTILITY_IQM else title_of(metric)


def write_files(path: Path, tables: Mapping[str, tuple[Cells, int, str]]) -> list[Path]:
    """Write each table into a file of its own, but those without a row.

    Args:
        path: the file, whose ending is one of :data:`FORMATS`.
        tables: each by what follows the name of the file: its cells, which a CSV takes as they are and others as text;
            the number of its labels; and the note below it, which a CSV does not have.

    Returns:
        The files.

    Raises:
        OSError: if a file cannot be written; it is then unchanged.
    """
    suffix, found = path.suffix.lower(), []
    text = _latex if suffix == ".tex" else markdown
    for end, (cells, labels, note) in tables.items():
        if len(cells) > 1:
            found.append(path.with_name(f"{path.stem}{end}{path.suffix}"))
            atomic_write(found[-1], csv_bytes(cells) if suffix == ".csv" else text(cells, labels, note).encode())
    return found


def write_table(path: Path, rows: Rows, labels: int, note: str) -> None:
    """Write one table, whose first columns are ``labels``, in the format that the ending of its path names.

    Raises:
        OSError: if the file cannot be written; it is then unchanged.
    """
    if path.suffix.lower() == ".csv":
        atomic_write(path, csv_bytes(rows))
    else:
        text = _latex if path.suffix.lower() == ".tex" else markdown
        atomic_write(path, text(rows, labels, note).encode())


def _latex(rows: Rows, labels: int, note: str) -> str:
    """A tabular of the package booktabs; what all rows share, and the note, are comments."""
    shared, rows, labels = lift_labels(rows, labels)

    def line(cells: Sequence[str]) -> str:
        texts = ["".join(_LATEX.get(each, each) for each in " ".join(cell.split())) for cell in cells]
        texts[labels:] = [re.sub(r"-(?=\d)", "$-$", text) for text in texts[labels:]]  # a minus, not a hyphen
        return " & ".join(texts) + r" \\"

    header, *body = rows
    columns = "l" * labels + "r" * (len(header) - labels)
    return "\n".join(
        [
            *(f"% {text}" for text in (r"needs \usepackage{booktabs}", *shared.splitlines(), note)),
            rf"\begin{{tabular}}{{{columns}}}",
            r"\toprule",
            line(header),
            r"\midrule",
            *map(line, body),
            r"\bottomrule",
            r"\end{tabular}",
            "",
        ]
    )


def markdown(rows: Rows, labels: int, note: str) -> str:
    """A table of GitHub's Markdown between what all rows share and the note."""
    shared, rows, labels = lift_labels(rows, labels)

    def line(cells: Sequence[str]) -> str:
        texts = (re.sub(r"([\\|])", r"\\\1", " ".join(cell.split())) for cell in cells)
        return f"| {' | '.join(texts)} |"

    header, *body = rows
    rule = ["---"] * labels + ["---:"] * (len(header) - labels)
    return "\n".join([*([shared, ""] if shared else []), line(header), line(rule), *map(line, body), "", note, ""])
