"""``import algorithms`` imports nothing but names; a name imports what it stands for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

import algorithms
from mo_deepdrive.support.extras import EXTRAS


def loaded(*names: str) -> str:
    """A line that prints which of these packages have been imported."""
    return f"import sys\nprint([name for name in {names} if name in sys.modules])"


@pytest.mark.parametrize(
    ("imported", "absent"),
    [
        ("algorithms", ("torch", "numpy", "mo_deepdrive", "gymnasium", "algorithms.agent", "algorithms.runs")),
        ("mo_deepdrive", (*EXTRAS, "numba", "pygame")),
        pytest.param(
            "algorithms.reporting.tables, algorithms.studies.sweep_tables, algorithms.commands.zoo",
            ("matplotlib", "torch"),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_an_import_imports_nothing_that_is_not_needed(
    imported: str, absent: tuple[str, ...], run_python: Callable[[str], str]
) -> None:
    assert run_python(f"import {imported}\n{loaded(*absent)}") == "[]\n"


@pytest.mark.slow
def test_a_training_run_starts_without_what_it_ends_with(run_python: Callable[[str], str], tmp_path: Path) -> None:
    printed = run_python(
        "import contextlib, sys\n"
        "from algorithms import MOA2C\n"
        "from algorithms.commands import train\n"
        "def update(*_):\n"
        "    print([name for name in ('matplotlib', 'scipy.stats', 'imageio', 'PIL', 'torch._dynamo')"
        "           if name in sys.modules])\n"
        "    sys.exit()\n"
        "MOA2C.update = update\n"
        "with contextlib.suppress(SystemExit):\n"
        f"    train.main(['--config', 'one_waypoint/mo_a2c_linear', '--output', {str(tmp_path / 'run')!r}])"
    )
    assert "[]" in printed.splitlines()


def test_every_public_name_can_be_imported_and_is_listed() -> None:
    for name in algorithms.__all__:
        assert getattr(algorithms, name) is not None
        assert name in dir(algorithms)
    with pytest.raises(AttributeError, match="module 'algorithms' has no attribute 'DQN'"):
        algorithms.DQN  # noqa: B018  (the access itself raises)
