"""What the commands print to."""

from __future__ import annotations

from rich.console import Console

WIDTH = 120  # columns, of files and where there is no terminal


def make_console() -> Console:
    """A console on standard output; if that is not a terminal, it is wide enough for tables."""
    console = Console()
    return console if console.is_terminal else Console(width=WIDTH)


def print_line(console: Console, text: str) -> None:
    """Print a line as it is: neither interpreted as markup, nor coloured, nor wrapped."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)
