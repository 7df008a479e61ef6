"""The files of a finished run, with their sizes and hashes, to notice what is deleted, cut or edited afterwards."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file

from mo_deepdrive.atomic_io import read_json_object

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

RECORDED = ("config.yaml", "checkpoint.safetensors", "metrics.csv", "evaluation.json", "front.csv", "fronts.csv")
RESULTS = ("evaluation.json", "front.csv")  # of the final evaluation, which may be done again
STATUS_FILE = "status.json"
NOT_RECORDED = "its files are not recorded: it was made by an earlier version"


def record_files(run: Path) -> dict[str, dict[str, Any]]:
    """The size in bytes and the SHA-256 hash of each of :data:`RECORDED` that exists, by name.

    The record is kept under "files" in the status.json of a finished run.

    Args:
        run: the run's directory.

    Raises:
        OSError: if a file cannot be read.
    """
    return {name: _record(run / name) for name in RECORDED if (run / name).is_file()}


def broken_files(run: Path, names: Sequence[str] | None = None) -> list[str]:
    """What does not match the record of a finished run; nothing for a run that is not finished.

    Args:
        run: the run's directory.
        names: check these files alone, such as those that are about to be read; None for all that are recorded.

    Returns:
        One line per file that is missing or differs in size or hash, or about a broken status.json;
        :data:`NOT_RECORDED` if there is no record.
    """
    status = read_json_object(run / STATUS_FILE)
    if not status and (run / STATUS_FILE).exists():
        return [f"{STATUS_FILE}: cannot be read"]
    if status.get("state") != "finished":
        return []
    recorded = status.get("files")
    if not isinstance(recorded, dict) or not all(isinstance(entry, dict) for entry in recorded.values()):
        return [NOT_RECORDED]
    found = []
    for name, entry in recorded.items():
        if name in RECORDED and (names is None or name in names):
            problem = _difference(run / name, entry)
            if problem is not None:
                found.append(f"{name}: {problem}")
    return found


def changed_files(run: Path, names: Sequence[str] | None = None) -> list[str]:
    """As :func:`broken_files`, but nothing for a run without a record."""
    return [problem for problem in broken_files(run, names) if problem != NOT_RECORDED]


def diverged(run: Path) -> list[str]:
    """A line if a number in the checkpoint of a run is not finite: its scores are then those of no policy."""
    try:
        tensors = load_file(run / "checkpoint.safetensors")
    except (OSError, SafetensorError):  # missing or broken, as broken_files says
        return []
    wrong = [name for name, array in tensors.items() if array.dtype.kind == "f" and not np.isfinite(array).all()]
    return [f"checkpoint.safetensors: {wrong[0]!r} is not finite"] if wrong else []


def _record(path: Path) -> dict[str, Any]:
    digest, size = hashlib.sha256(), 0
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
            size += len(block)
    return {"size": size, "sha256": digest.hexdigest()}


def _difference(path: Path, entry: dict[str, Any]) -> str | None:
    """How a file differs from its entry in the record; None if it does not."""
    if not path.is_file():
        return "missing"
    try:
        size = path.stat().st_size
        if size != entry.get("size"):
            return f"{size} bytes, recorded {entry.get('size')}"
        return None if _record(path) == entry else "changed since the run finished"
    except OSError as error:
        return f"cannot be read: {error}"
