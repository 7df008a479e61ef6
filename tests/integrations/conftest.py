"""Tests of a library are skipped where it is not installed, and run in a temporary folder."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(autouse=True)
def _library(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip without the library; some libraries write into the working directory, and some need a display."""
    library = getattr(request.module, "LIBRARY", None)
    if library is not None and library.module is not None:
        pytest.importorskip(library.module, reason=f"{library.name} is not installed: make test-integrations")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
