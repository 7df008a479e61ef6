"""Tests of a library are skipped where it is not installed, and run in a temporary folder."""

from __future__ import annotations

from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Importing a library alone takes longer than a second."""
    for item in items:
        if item.path.parent == HERE:
            item.add_marker(pytest.mark.slow)


@pytest.fixture(autouse=True)
def _library(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip without the library; some libraries write into the working directory, and some need a display."""
    library = request.module.__name__.rpartition("test_")[2]
    if library not in ("cleanrl", "examples"):  # which are named after no package
        pytest.importorskip(library, reason=f"{library} is not installed: make test-integrations")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
