"""What the commands print to."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from rich.console import Console, RenderHook
from rich.live import Live
from rich.segment import Segment

from algorithms.experiments.accessories import Accessory
from mo_deepdrive.names import printable

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import IO

    from rich.console import ConsoleOptions, ConsoleRenderable, RenderableType, RenderResult

WIDTH = 120  # columns, of files and where there is no terminal
LINE_INTERVAL = 15.0  # s between lines about the progress, where there is no terminal


class _Printable:
    """A renderable without control characters in its text, which may come from the files of strangers."""

    def __init__(self, renderable: ConsoleRenderable):
        self._renderable = renderable

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for segment in console.render(self._renderable, options):
            yield segment if segment.control else Segment(printable(segment.text), segment.style)


class _PrintableHook(RenderHook):
    def process_renderables(self, renderables: list[ConsoleRenderable]) -> list[ConsoleRenderable]:
        return [_Printable(renderable) for renderable in renderables]


def make_console(file: IO[str] | None = None) -> Console:
    """A console on standard output or a file; if that is not a terminal, it is wide enough for tables."""
    console = Console(file=file)
    if file is not None or not console.is_terminal:
        console = Console(file=file, width=WIDTH)
    console.push_render_hook(_PrintableHook())
    return console


def print_line(console: Console, text: str) -> None:
    """Print a line as it is: neither interpreted as markup, nor coloured, nor wrapped; plainly if rich fails."""
    try:
        console.print(text, markup=False, highlight=False, soft_wrap=True)
    except Exception:
        console.file.write(printable(text) + "\n")


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
