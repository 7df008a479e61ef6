"""Output that never stops what prints it: what cannot be written is dropped."""

from __future__ import annotations

import io
import os
import select
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path


class LenientFile(io.FileIO):
    """A file for writing that drops what it cannot write: a closed pipe or terminal, a full disk.

    Attributes:
        error: the first error; None if everything was written.
    """

    error: OSError | None = None

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
    """Replace standard output and error, unless somebody has replaced them already, by lenient ones.

    Characters that their encoding lacks are written as escapes. Descriptors that are closed lead to the null device:
    otherwise the next file that is opened would take their place, and what is printed would go there.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest that is free
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None or stream is not getattr(sys, f"__{name}__"):
            continue
        file = LenientFile(stream.fileno(), "w", closefd=False)
        unbuffered = isinstance(stream.buffer, io.RawIOBase)
        options = {"line_buffering": stream.line_buffering, "write_through": stream.write_through}
        buffer: Any = file if unbuffered else io.BufferedWriter(file)
        lenient = io.TextIOWrapper(buffer, encoding=stream.encoding, errors="backslashreplace", **options)
        setattr(sys, name, lenient)


def lost_output() -> OSError | None:
    """The first error of standard output, all of which is written now; None if nothing was lost."""
    stream = sys.stdout
    if stream is None:
        return None
    stream.flush()
    file = getattr(stream, "buffer", None)
    return getattr(getattr(file, "raw", file), "error", None)
