"""Atomic writes: after a crash or on a full disk, the previous file is still whole. Also lock files."""

from __future__ import annotations

import csv
import errno
import io
import json
import os
import stat
import tempfile
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

TEMPORARY = ".*.tmp"
DEEPEST = 50  # objects and lists in each other, in a file

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence


def atomic_write(path: str | Path, data: bytes | Iterable[bytes]) -> None:
    """Replace the contents of ``path`` by ``data``, whole or in pieces, or leave it exactly as it was.

    The bytes go to a temporary file in the same folder, reach the disk, and are then renamed over ``path``: a reader
    sees the old content or the new one, never a part.

    Raises:
        OSError: if anything went wrong (disk full, no permission); the temporary file is gone and ``path`` untouched.
    """
    path = Path(path)
    descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.writelines([data] if isinstance(data, bytes) else data)
            file.flush()
            os.fsync(file.fileno())
        Path(name).chmod(path.stat().st_mode & 0o777 if path.exists() else 0o644)
        Path(name).replace(path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def is_temporary(path: Path) -> bool:
    """Whether a file has the name of a temporary file of :func:`atomic_write`."""
    return path.match(TEMPORARY)


def leftovers(folder: Path) -> Iterator[Path]:
    """Temporary files in a folder, left by processes that were killed in :func:`atomic_write`."""
    return folder.glob(TEMPORARY)


def open_lock(path: str | Path) -> IO[bytes]:
    """Open a lock file, to be locked and closed by the caller; it is created if it is missing, and never changed.

    Raises:
        ValueError: if it is a link or anything else that is not a file.
        OSError: if it cannot be opened.
    """
    refusal = ValueError(f"lock {str(path)!r} is not a regular file; delete it")
    flags = os.O_RDWR | os.O_CREAT
    for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC"):  # POSIX; without O_NONBLOCK a device may block
        flags |= getattr(os, name, 0)
    try:
        file = os.fdopen(os.open(path, flags, 0o666), "r+b", buffering=0)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO, errno.ESPIPE):
            raise refusal from None
        raise
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise refusal
    return file


def write_json(path: str | Path, value: Any) -> None:
    """Write ``value`` as indented JSON, atomically.

    Raises:
        OSError: as :func:`atomic_write`.
    """
    atomic_write(path, (json.dumps(value, indent=2) + "\n").encode())


def check_depth(value: Any, deepest: int = DEEPEST) -> None:
    """Refuse JSON from elsewhere that is nested so deeply that work on it may end in the middle.

    Args:
        value: as ``json.loads`` gives it.
        deepest: objects and lists in each other.

    Raises:
        RecursionError: if there are more.
    """
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    if inner and not deepest:
        raise RecursionError
    for each in inner:
        check_depth(each, deepest - 1)


def read_json_object(path: str | Path) -> dict[str, Any]:
    """The JSON object in a file that describes work; empty if the file is missing, broken or holds something else."""
    try:
        value = json.loads(Path(path).read_bytes())
        check_depth(value)
    except (OSError, ValueError, RecursionError):  # RecursionError: nested too deeply
        return {}
    return value if isinstance(value, dict) else {}


FORMULA = tuple("=+-@\t\r\n")  # how a cell begins that a spreadsheet evaluates


def csv_bytes(rows: Iterable[Sequence[Any]]) -> bytes:
    """``rows`` as the text of a CSV file, with plain newlines.

    Text that a spreadsheet would take for a formula gets an apostrophe in front; numbers stay as they are.
    """
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows([_plain(cell) for cell in row] for row in rows)
    return buffer.getvalue().encode()


def _plain(cell: Any) -> Any:
    return f"'{cell}" if isinstance(cell, str) and cell.startswith(FORMULA) and not is_number(cell) else cell


def is_number(text: str) -> bool:
    """Whether ``text`` is a number as Python writes it, which includes "nan" and "-inf"."""
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text
