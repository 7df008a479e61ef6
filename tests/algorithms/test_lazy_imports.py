"""``import algorithms`` imports nothing but names; a name imports what it stands for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

import algorithms
from mo_deepdrive.support.extras import EXTRAS


def test_importing_the_package_imports_neither_torch_nor_numpy_nor_an_algorithm(
    run_python: Callable[[str], str],
) -> None:
    loaded = run_python(
        "import sys, algorithms\n"
        "assert sorted(algorithms.ALGORITHMS) == "
        "['a2c', 'conditioned_mo_ppo', 'mappo', 'mo_a2c', 'mo_ppo', 'mocac', 'pcn', 'ppo', 'rulebook_ppo']\n"
        "assert 'pcn' in algorithms.ALGORITHMS and 'dqn' not in algorithms.ALGORITHMS and dir(algorithms)\n"
        "print(sorted(name for name in sys.modules if name.split('.')[0] in ('torch', 'numpy', 'mo_deepdrive', "
        "'gymnasium') or name.startswith('algorithms.')))"
    )
    assert loaded == "[]\n"


def test_importing_the_environments_imports_neither_an_extra_nor_a_compiler_nor_pygame(
    run_python: Callable[[str], str],
) -> None:
    printed = run_python(
        "import sys, mo_deepdrive\n"
        f"print([package for package in {(*EXTRAS, 'numba', 'pygame')} if package in sys.modules])"
    )
    assert printed == "[]\n"


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


@pytest.mark.slow
def test_tables_need_no_matplotlib(run_python: Callable[[str], str]) -> None:
    loaded = run_python(
        "import sys\n"
        "import algorithms.reporting.tables, algorithms.studies.sweep_tables\n"
        "import algorithms.commands.zoo\n"
        "print([name for name in ('matplotlib', 'torch') if name in sys.modules])"
    )
    assert loaded == "[]\n"


def test_every_public_name_can_be_imported_and_is_listed() -> None:
    for name in algorithms.__all__:
        assert getattr(algorithms, name) is not None
        assert name in dir(algorithms)
    with pytest.raises(AttributeError, match="module 'algorithms' has no attribute 'DQN'"):
        algorithms.DQN  # noqa: B018  (the access itself raises)
