"""What the commands print to; output that cannot be written is dropped, and never stops what prints it."""

from __future__ import annotations

import io
import os
import select
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path
    from typing import IO

    from rich.console import Console

WIDTH = 120  # columns, of files and where there is no terminal


def make_console(file: IO[str] | None = None) -> Console:
    """A console on standard output or a file; if that is not a terminal, it is wide enough for tables."""
    from rich.console import Console  # not earlier: --help needs none

    console = Console(file=file)
    return console if file is None and console.is_terminal else Console(file=file, width=WIDTH)


def print_line(console: Console, text: str) -> None:
    """Print a line as it is: neither interpreted as markup, nor coloured, nor wrapped."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)


class LenientFile(io.FileIO):
    """A file for writing that drops what it cannot write: a closed pipe or terminal, a full disk."""

    error: OSError | None = None  # the first one

    def write(self, data: Any) -> int:
        """Write all of ``data``, bytes, or drop it; returns its length."""
        rest = whole = memoryview(data).cast("B")
        try:
            while rest:
                written: int | None = super().write(rest)
                if written is None:  # the descriptor does not block, and cannot take anything now
                    select.select((), (self,), ())
                rest = rest[written or 0 :]
        except OSError as error:
            self.error = self.error or error
        return len(whole)


def open_log(path: Path) -> io.TextIOWrapper:
    """A text file to append to; where it cannot be opened or written, its lines are dropped."""
    try:
        file = LenientFile(path, "a")
    except OSError:
        file = LenientFile(os.devnull, "a")
    return io.TextIOWrapper(io.BufferedWriter(file), encoding="utf-8", line_buffering=True)


def make_standard_streams_lenient() -> None:
    """Replace standard output and error, unless somebody has replaced them already, by lenient ones."""
    for descriptor in range(3):  # if one is closed, the next file that is opened would get what is printed
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest that is free
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None or stream is not getattr(sys, f"__{name}__"):
            continue
        file = LenientFile(stream.fileno(), "w", closefd=False)
        buffer: Any = file if isinstance(stream.buffer, io.RawIOBase) else io.BufferedWriter(file)
        options = {"line_buffering": stream.line_buffering, "write_through": stream.write_through}
        lenient = io.TextIOWrapper(buffer, encoding=stream.encoding, errors="backslashreplace", **options)
        setattr(sys, name, lenient)


def lost_output() -> OSError | None:
    """The first error of standard output, all of which is written now; None if nothing was lost."""
    if sys.stdout is None:
        return None
    sys.stdout.flush()
    file = getattr(sys.stdout, "buffer", None)
    return getattr(getattr(file, "raw", file), "error", None)
