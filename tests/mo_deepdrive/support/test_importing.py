"""What a user's own module may be called, and what is said if it cannot be imported."""

from __future__ import annotations

import sys
import sysconfig
from pathlib import Path

import pytest

from mo_deepdrive.support.importing import import_module, import_named


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that is on ``sys.path``, before the installed packages."""
    monkeypatch.setattr(sys, "path", [str(tmp_path), sysconfig.get_path("stdlib"), sysconfig.get_path("purelib")])
    return tmp_path


@pytest.mark.parametrize("name", ["nowhere", "nowhere.inside"])
def test_a_module_that_is_not_found_is_refused_with_the_places_looked_at(folder: Path, name: str) -> None:
    with pytest.raises(ValueError, match="cannot be imported") as refusal:
        import_module(f"environment.id = '{name}:x-v0'", name)
    assert str(refusal.value) == (
        f"environment.id = '{name}:x-v0': {name!r} cannot be imported: ModuleNotFoundError: No module named 'nowhere'; "
        f"looked for in {str(folder)!r}, the installed packages"
    )


def test_a_mistake_in_a_module_is_one_line_without_places(folder: Path) -> None:
    (folder / "needs_more.py").write_text("import not_installed\n")
    (folder / "two_lines.py").write_text("raise KeyError('one\\ntwo')\n")
    with pytest.raises(
        ValueError, match=r"'needs_more' cannot be imported: .* No module named 'not_installed' at needs_more.py:1$"
    ):
        import_named("utility", "needs_more:u")
    with pytest.raises(
        ValueError, match=r"^utility = 'two_lines:u': 'two_lines' cannot be imported: KeyError: .* at two_lines.py:1$"
    ):
        import_named("utility", "two_lines:u")
