"""The files of a finished run, with their sizes and hashes, to notice what is deleted, cut or edited afterwards."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any

import numpy as np

from mo_deepdrive.support.atomic_io import read_json_object

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

RECORDED = ("config.yaml", "checkpoint.safetensors", "metrics.csv", "evaluation.json", "front.csv", "fronts.csv")
RESULTS = ("evaluation.json", "front.csv")  # of the final evaluation, which may be done again
STATUS_FILE = "status.json"


def record_files(run: Path) -> dict[str, dict[str, Any]]:
    """The size in bytes and the SHA-256 hash of each of :data:`RECORDED` that exists in a run's directory, by name.

    The record is kept under "files" in the status.json of a finished run.
    """
    return {name: _record(run / name) for name in RECORDED if (run / name).is_file()}


def changed_files(run: Path, names: Sequence[str] | None = None) -> list[str]:
    """What does not match the record of a finished run; nothing for a run that is not finished, or has no record.

    Args:
        run: the run's directory.
        names: check these files alone, such as those that are about to be read; None for all that are recorded.

    Returns:
        One line per file that is missing or differs in size or hash, or about a broken status.json.
    """
    status = read_json_object(run / STATUS_FILE)
    if not status and (run / STATUS_FILE).exists():
        return [f"{STATUS_FILE}: cannot be read"]
    if status.get("state") != "finished":
        return []
    recorded = status.get("files", {})
    problems = {name: _difference(run / name, recorded[name]) for name in recorded if names is None or name in names}
    return [f"{name}: {problem}" for name, problem in problems.items() if problem]


def diverged(run: Path) -> list[str]:
    """A line if a number in the checkpoint of a run is not finite: its scores are then those of no policy."""
    from safetensors import SafetensorError  # an extra, which not every command needs
    from safetensors.numpy import load_file

    try:
        tensors = load_file(run / "checkpoint.safetensors")
    except (OSError, SafetensorError):  # missing or broken, as changed_files says
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


def _difference(path: Path, entry: dict[str, Any]) -> str:
    """How a file differs from its entry in the record; empty if it does not."""
    try:
        now = _record(path)
    except FileNotFoundError:
        return "missing"
    except OSError as error:
        return f"cannot be read: {error}"
    if now["size"] != entry["size"]:
        return f"{now['size']} bytes, recorded {entry['size']}"
    return "" if now == entry else "changed since the run finished"
