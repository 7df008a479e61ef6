"""Files of users: whole or as they were, on any file system.

A link to a file that a user names is followed (:func:`atomic_write`); one in a directory of ours is refused
(:func:`own_path`), since whoever made the directory would choose what is overwritten.
"""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import json
import os
import secrets
import shutil
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from filelock import BaseFileLock

TEMPORARY = ".*.tmp"
# Errors by which a file system says that it lacks an operation, besides those of permission.
UNSUPPORTED = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL, errno.ENOLCK, errno.ENOTTY)
FORMULA = tuple("=+-@\t\r\n")  # how a cell begins that a spreadsheet evaluates


@contextlib.contextmanager
def optional() -> Iterator[None]:
    """Continue where a file system refuses what it need not have: permissions, locks, flushing to the disk."""
    try:
        yield
    except OSError as error:
        if not isinstance(error, PermissionError) and error.errno not in UNSUPPORTED:
            raise


def expand_home(path: str | Path) -> Path:
    """A path that a user has written, with ``~`` at its beginning replaced by the home directory."""
    expanded = Path(os.path.expanduser(path))  # noqa: PTH111 (keeps ~name where there is no such user, as shells do)
    if expanded.parts[:1] == ("~",):
        raise ValueError(f"path {str(path)!r}: this user has no home directory, and HOME is not set")
    return expanded


def own_path(directory: Path, name: str) -> Path:
    """The path of what is in the directory of a run or sweep, to be written or deleted; it need not exist.

    The directory itself may be reached through a link; a link in it that leads elsewhere is a ValueError.
    """
    path = directory / name
    if (place := path.resolve()) != directory.resolve() / name:
        raise ValueError(
            f"{str(path)!r} leads to {str(place)!r}; nothing is written or deleted through a link inside a run or sweep"
        )
    return path


def without_links(path: str | Path) -> Path:
    """The file, existing or not, that a path leads to."""
    return Path(os.path.realpath(path))  # Path.resolve() refuses a link to itself with a RuntimeError


def atomic_write(path: str | Path, data: bytes | Iterable[bytes]) -> None:
    """Replace the contents of ``path`` by ``data``, whole or in pieces, or leave it exactly as it was.

    The bytes go to a temporary file in the same folder, reach the disk, and are then renamed over ``path``: a reader
    sees the old content or the new one, never a part. Of a link it is the target that is replaced.

    Raises:
        OSError: if anything went wrong (disk full, no permission); the temporary file is gone and ``path`` untouched.
    """
    path = without_links(path)
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    file = part.open("xb")  # with the permissions that the umask leaves
    try:
        with file:
            file.writelines([data] if isinstance(data, bytes) else data)
            file.flush()
            flush_to_disk(file)
        if path.is_file():
            with optional():
                part.chmod(path.stat().st_mode & 0o777)
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def flush_to_disk(file: IO[Any]) -> None:
    """Make what was written to an open file reach the disk."""
    with optional():
        os.fsync(file.fileno())


def is_temporary(path: Path) -> bool:
    """Whether a file has the name of a temporary file of :func:`atomic_write`."""
    return path.match(TEMPORARY)


def leftovers(folder: Path) -> Iterator[Path]:
    """Temporary files in a folder, left by processes that were killed in :func:`atomic_write`."""
    return folder.glob(TEMPORARY)


def lock(path: Path, *, wait: bool) -> BaseFileLock:
    """Lock a file, made if it does not exist, until it is released or the process ends; if the file system has locks.

    A BlockingIOError if another process holds it, and ``wait`` is False.
    """
    from filelock import FileLock, Timeout  # of the training, which environments need not install

    held = FileLock(path, thread_local=False)
    try:
        held.acquire(timeout=-1 if wait else 0)
    except Timeout:
        raise BlockingIOError(f"{str(path)!r} is locked by another process") from None
    except OSError as error:
        if error.errno not in UNSUPPORTED:
            raise
    return held


@contextlib.contextmanager
def atomic_folder(target: Path) -> Iterator[Path]:
    """A new folder to write to, which takes the place of ``target`` at the end; with an error nothing changes."""
    staged = target.parent / f".{target.name}.{secrets.token_hex(4)}.tmp"
    staged.mkdir()
    aside = staged.with_suffix(".old")  # a non-empty folder cannot be replaced atomically
    try:
        yield staged
        if target.exists():
            target.replace(aside)
        staged.replace(target)
    except BaseException:
        if aside.exists():
            aside.replace(target)
        shutil.rmtree(staged, ignore_errors=True)
        raise
    shutil.rmtree(aside, ignore_errors=True)


def write_json(path: str | Path, value: Any) -> None:
    """Write ``value`` as indented JSON, atomically."""
    atomic_write(path, (json.dumps(value, indent=2) + "\n").encode())


def read_json_object(path: str | Path) -> dict[str, Any]:
    """The JSON object in a file that describes work; empty if the file is missing, broken or holds something else."""
    try:
        value = json.loads(Path(path).read_bytes())
    except (OSError, ValueError, RecursionError):  # RecursionError: nested too deeply
        return {}
    return value if isinstance(value, dict) else {}


def csv_bytes(rows: Iterable[Sequence[Any]]) -> bytes:
    """``rows`` as the text of a CSV file, with plain newlines; what a spreadsheet would evaluate begins with an '."""
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows([_plain(cell) for cell in row] for row in rows)
    return buffer.getvalue().encode()


def _plain(cell: Any) -> Any:
    return f"'{cell}" if isinstance(cell, str) and cell.startswith(FORMULA) and not _is_number(cell) else cell


def _is_number(text: str) -> bool:
    """Whether ``text`` is a number as Python writes it, which includes "nan" and "-inf"."""
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text
