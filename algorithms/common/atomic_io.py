"""Writing files so that a crash or a full disk never costs the file that was there before."""

from __future__ import annotations

import csv
import io
import json
import os
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any


def atomic_write(path: str | Path, data: bytes) -> None:
    """Replace ``path`` by ``data``, or leave it exactly as it was.

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
        os.chmod(name, path.stat().st_mode & 0o777 if path.exists() else 0o644)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def leftovers(folder: Path) -> Iterator[Path]:
    """What processes that were killed in :func:`atomic_write` have left in a folder."""
    return folder.glob(".*.tmp")


def write_json(path: str | Path, value: Any) -> None:
    """Write ``value`` as indented JSON, atomically.

    Raises:
        OSError: as :func:`atomic_write`.
    """
    atomic_write(path, (json.dumps(value, indent=2) + "\n").encode())


def csv_bytes(rows: Iterable[Sequence[Any]]) -> bytes:
    """``rows`` as the text of a CSV file, with plain newlines."""
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(rows)
    return buffer.getvalue().encode()
