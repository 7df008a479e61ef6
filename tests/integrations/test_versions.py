"""The versions on the page are those that the tests run with."""

from __future__ import annotations

from importlib import metadata

import pytest

from tests.integrations.matrix import Library, matrix

LIBRARIES = [library for library, _ in matrix() if library.module and library.name != "RLlib"]


def installed(library: Library) -> str | None:
    try:
        return metadata.version(library.package)
    except metadata.PackageNotFoundError:
        return None


def test_the_installed_versions_are_those_of_the_page() -> None:
    found = {library.name: installed(library) for library in LIBRARIES}
    if None in found.values():
        pytest.skip("not all libraries are installed: make test-integrations")
    assert found == {library.name: library.version() for library in LIBRARIES}
