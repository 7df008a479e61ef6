"""Tables of scores as files: tidy CSV for programs, LaTeX and Markdown for papers and pages. A file has one table."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from algorithms.reporting.seed_tables import (
    TABLE_METRICS,
    ScoreGroup,
    comparison_table,
    interval_note,
    scores_table,
    tidy_comparisons,
    tidy_scores,
)
from algorithms.reporting.wide_tables import lift_labels
from mo_deepdrive.atomic_io import atomic_write, csv_bytes

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from algorithms.reporting.wide_tables import Rows

FORMATS = (".csv", ".md", ".tex")
_LATEX = {
    **{each: f"\\{each}" for each in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "|": r"\textbar{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
}


def write_tables(path: Path, scores: Sequence[ScoreGroup], compared: Sequence[ScoreGroup]) -> list[Path]:
    """Write the scores and, if algorithms can be compared, their differences into ``NAME-differences``.

    A CSV has one number per cell, and the returns of all objectives; LaTeX and Markdown have the table of the terminal.

    Args:
        path: the file, whose ending is one of :data:`FORMATS`.
        scores: the rows of the first table.
        compared: the groups of the second table.

    Returns:
        The files.

    Raises:
        OSError: if a file cannot be written; it is then unchanged.
    """
    differences = path.with_name(f"{path.stem}-differences{path.suffix}")
    note = interval_note(scores)
    if path.suffix.lower() == ".csv":
        found = {path: csv_bytes(tidy_scores(scores))}
        if len(rows := tidy_comparisons(compared)) > 1:
            found[differences] = csv_bytes(rows)
    else:
        text = _latex if path.suffix.lower() == ".tex" else markdown
        table = scores_table(scores, TABLE_METRICS)
        found = {path: text(table, table[0].index("seeds") + 1, note).encode()}
        if len(table := comparison_table(compared)) > 1:
            title = f"Differences of the algorithms. {note}"
            found[differences] = text(table, table[0].index("mean"), title).encode()
    for file, data in found.items():
        atomic_write(file, data)
    return list(found)


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
