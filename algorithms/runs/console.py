"""What the commands print to."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from rich.console import Console
from rich.live import Live

from algorithms.runs.accessories import Accessory

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import IO

    from rich.console import RenderableType

WIDTH = 120  # columns, of files and where there is no terminal
LINE_INTERVAL = 15.0  # s between lines about the progress, where there is no terminal


def make_console(file: IO[str] | None = None) -> Console:
    """A console on standard output or a file; if that is not a terminal, it is wide enough for tables."""
    console = Console(file=file)
    return console if file is None and console.is_terminal else Console(file=file, width=WIDTH)


def print_line(console: Console, text: str) -> None:
    """Print a line as it is: neither interpreted as markup, nor coloured, nor wrapped."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)


class LiveDisplay:
    """What is kept up to date at the end of a terminal; nothing elsewhere, or after an error, which is one line.

    Args:
        console: where to print.
        name: of what is shown, for the line.
        render: what is shown.
    """

    def __init__(self, console: Console, name: str, render: Callable[[], RenderableType]):
        self._accessory = Accessory(f"{name} is not shown", lambda text: print_line(console, text))
        self._console, self._render = console, render
        self._live: Live | None = None

    @property
    def shown(self) -> bool:
        """Whether there is something on a terminal."""
        return self._live is not None

    def start(self) -> None:
        """Show it from the next :meth:`refresh` or printed line on."""
        if self._console.is_terminal:
            with self._accessory:  # no thread refreshes it, whose errors nobody would catch
                self._live = Live(console=self._console, get_renderable=self._render, auto_refresh=False)
            self._attempt(lambda live: live.start())

    def refresh(self) -> None:
        """Show it as it is now."""
        self._attempt(lambda live: live.refresh())

    def stop(self) -> None:
        """Show it a last time, and leave it there."""
        self._attempt(lambda live: live.stop())

    def _attempt(self, action: Callable[[Live], None]) -> None:
        if self._live is None:
            return
        with self._accessory:
            action(self._live)
            return
        live, self._live = self._live, None
        with contextlib.suppress(Exception):  # it has failed and been reported; this restores the cursor
            live.stop()
