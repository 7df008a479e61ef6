"""Atomic writes: after a crash or on a full disk, the previous file is still whole."""

from __future__ import annotations

import csv
import io
import json
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence


def atomic_write(path: str | Path, data: bytes) -> None:
    """Replace the contents of ``path`` by ``data``, or leave it exactly as it was.

    The bytes go to a temporary file in the same folder, reach the disk, and are then renamed over ``path``: a reader
    sees the old content or the new one, never a part.

    Raises:
        OSError: if anything went wrong (disk full, no permission); the temporary file is gone and ``path`` untouched.
    """
    path = Path(path)
    descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        Path(name).chmod(path.stat().st_mode & 0o777 if path.exists() else 0o644)
        Path(name).replace(path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def leftovers(folder: Path) -> Iterator[Path]:
    """Temporary files in a folder, left by processes that were killed in :func:`atomic_write`."""
    return folder.glob(".*.tmp")


def write_json(path: str | Path, value: Any) -> None:
    """Write ``value`` as indented JSON, atomically.

    Raises:
        OSError: as :func:`atomic_write`.
    """
    atomic_write(path, (json.dumps(value, indent=2) + "\n").encode())


def read_json_object(path: str | Path) -> dict[str, Any]:
    """The JSON object in a file that describes work; empty if the file is missing, broken or holds something else."""
    try:
        value = json.loads(Path(path).read_bytes())
    except (OSError, ValueError, RecursionError):  # RecursionError: nested too deeply
        return {}
    return value if isinstance(value, dict) else {}


def csv_bytes(rows: Iterable[Sequence[Any]]) -> bytes:
    """``rows`` as the text of a CSV file, with plain newlines."""
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(rows)
    return buffer.getvalue().encode()
