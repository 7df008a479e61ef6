"""Tables on a terminal: columns that do not fit continue in a further table, so that nothing is cut off."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from rich.console import Console

Rows = list[list[str]]  # of a table, header first

PADDING, MARGIN = 3, 1  # of a column, and of a table, in SIMPLE_HEAD
LABEL_SHARE = 0.6  # of the width, the most that labels may take


def split_columns(rows: Rows, labels: int, width: int) -> tuple[list[Rows], int]:
    """Split a table that is too wide into parts, each of which begins with the labels.

    Labels that take too much of the width are joined in one column ("name=value, name=value"), which may be wrapped.
    Rows without any value in a part are left out of it.

    Args:
        rows: of equal length.
        labels: number of the first columns, which say what a row is.
        width: of the terminal.

    Returns:
        The parts in the order of the columns, and the number of labels in each.
    """
    widths = _widths(rows)
    if sum(widths) + MARGIN <= width:
        return [rows], labels
    values, most = widths[labels:], int(LABEL_SHARE * width)
    if labels > 1 and sum(widths[:labels]) > most:
        rows, labels = _join(rows, labels), 1
        widths = _widths(rows)
    room = width - MARGIN - min(sum(widths[:labels]), most)
    parts: list[list[int]] = [[]]
    used = 0
    for i, each in enumerate(values, labels):
        if parts[-1] and used + each > room:
            parts.append([])
            used = 0
        parts[-1].append(i)
        used += each
    tables = [[[*row[:labels], *(row[i] for i in part)] for row in rows] for part in parts]
    return [[row for row in table if any(row[labels:])] for table in tables], labels


def _widths(rows: Rows) -> list[int]:
    return [max(cell_len(row[i]) for row in rows) + PADDING for i in range(len(rows[0]))]


def lift_labels(rows: Rows, labels: int) -> tuple[str, Rows, int]:
    """The labels that all rows share, as text; the rows without these, and how many labels are left."""
    header, *body = rows
    shared = [i for i in range(labels) if all(row[i] == body[0][i] for row in body)]
    text = ", ".join(f"{header[i]} {body[0][i]}" for i in shared if body[0][i])
    kept = [i for i in range(len(header)) if i not in shared]
    return text, [[row[i] for i in kept] for row in rows], labels - len(shared)


def _join(rows: Rows, labels: int) -> Rows:
    """The rows with their labels in one column."""
    header, *body = rows
    texts = [
        ", ".join(f"{name}={cell}" for name, cell in zip(header[:labels], row[:labels], strict=True) if cell)
        for row in body
    ]
    return [["", *header[labels:]], *([text, *row[labels:]] for text, row in zip(texts, body, strict=True))]


def fitted_tables(rows: Rows, labels: int, width: int) -> list[Table]:
    """The parts of :func:`split_columns` as tables: labels are wrapped where they are too long, values are not."""
    parts, labels = split_columns(rows, labels, width)
    tables = []
    for header, *body in parts:
        table = Table(box=SIMPLE_HEAD)
        for i, name in enumerate(header):
            table.add_column(
                Text(name), justify="left" if i < labels else "right", overflow="fold", no_wrap=i >= labels
            )
        for row in body:
            table.add_row(*map(Text, row))
        tables.append(table)
    return tables


def print_rows(console: Console, rows: Rows, title: str, labels: int, *, rest: str | None = None) -> None:
    """Print a table below its title, in parts that fit the console.

    If it does not fit, first the labels that all rows share move to the title; then columns follow in further parts.

    Args:
        console: where to print.
        rows: header first.
        title: printed above the table.
        labels: number of the first columns, which say what a row is.
        rest: how to see all columns; if it is given, the first part alone is printed, then the names of the columns
            that are not in it, and this.
    """
    if sum(_widths(rows)) + MARGIN > console.width and len(rows) > 1:
        shared, rows, labels = lift_labels(rows, labels)
        title = ", ".join(filter(None, [title, shared]))
    console.print(Text(title, style="bold"))
    tables = fitted_tables(rows, labels, console.width)
    for table in tables[: None if rest is None else 1]:
        console.print(table)
    if rest is not None and len(tables) > 1:
        shown = [str(column.header) for column in tables[0].columns]
        hidden = [name for name in rows[0][labels:] if name not in shown]
        console.print(Text(f"not shown: {', '.join(hidden)}; {rest}"))
