"""The Ray Tune backend, where it can be tested without Ray's processes; tests/cluster has the other tests."""

from __future__ import annotations

import queue
import threading
from typing import TYPE_CHECKING, Any

import pytest

from algorithms.sweeps.manifest import write_manifest

if TYPE_CHECKING:
    from pathlib import Path

pytest.importorskip("ray.tune", reason="Ray is not installed: pip install 'mo-deepdrive[sweep]'")


def test_a_run_that_is_no_longer_in_the_manifest_fails_with_the_reason(tmp_path: Path) -> None:
    from algorithms.sweeps.ray_tune import RunTrainable

    write_manifest(tmp_path, [])
    reports: queue.SimpleQueue[Any] = queue.SimpleQueue()
    RunTrainable._run_job({"sweep": str(tmp_path), "run": {"id": "gone"}}, reports, threading.Event())
    reason = f"the manifest of sweep {str(tmp_path)!r} has changed: it no longer has this run"
    assert reports.get() == {"done": True, "error": reason}
