"""What the commands print to."""

from __future__ import annotations

from typing import IO

from rich.console import Console

WIDTH = 120  # columns, without a terminal


def make_console(file: IO[str] | None = None) -> Console:
    """A console on ``file``, or else on standard output; if that is not a terminal, it is wide enough for tables."""
    console = Console(file=file)
    return console if console.is_terminal else Console(file=file, width=WIDTH)


def print_line(console: Console, text: str) -> None:
    """Print a line as it is: neither interpreted as markup, nor coloured, nor wrapped."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)
