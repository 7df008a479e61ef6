"""What is not installed is reported with the extra that brings it."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mo_deepdrive.support.extras import EXTRAS, MissingExtraError, needed_for


def test_a_missing_package_is_reported_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    message = "^logging needs wandb: pip install --editable '\\.\\[wandb\\]'$"
    with pytest.raises(MissingExtraError, match=message), needed_for("logging"):
        import wandb
    with pytest.raises(MissingExtraError, match=r"\[rllib\]"), needed_for("this", extra="rllib"):
        import wandb.sdk  # noqa: F401


def test_every_extra_is_one_of_the_project(repository: Path) -> None:
    text = (repository / "pyproject.toml").read_text(encoding="utf-8")
    section = text.split("[project.optional-dependencies]")[1].split("\n[")[0]
    found = set(re.findall(r"^(\w+) = ", section, flags=re.MULTILINE))
    assert found == {*EXTRAS.values(), "rllib", "integrations", "docs", "dev"}


def test_an_algorithm_without_torch_names_the_extra(run_python: Callable[[str], Any]) -> None:
    printed = run_python(
        "import sys\n"
        "sys.modules['torch'] = None\n"
        "try:\n"
        "    from algorithms import MOA2C\n"
        "except ImportError as error:\n"
        "    print(error)"
    )
    assert printed == "algorithms.MOA2C needs torch: pip install --editable '.[train]'\n"


@pytest.mark.slow
def test_environments_fronts_and_playing_need_nothing_but_the_core(run_python: Callable[[str], Any]) -> None:
    printed = run_python(
        "import sys\n"
        "from mo_deepdrive.support.extras import EXTRAS\n"
        "sys.modules.update(dict.fromkeys(EXTRAS))\n"
        "import gymnasium, mo_gymnasium, mo_deepdrive, mo_deepdrive.wrappers\n"
        "mo_gymnasium.make('mo-deepdrive-one-waypoint-v0', render_mode='rgb_array').reset(seed=0)\n"
        "gymnasium.make_vec('mo-deepdrive-intersection-v0', num_envs=2).reset(seed=0)\n"
        "mo_deepdrive.parallel_env().reset(seed=0)\n"
        "mo_deepdrive.reference_point('one_waypoint', 'discrete')\n"
        "print(mo_deepdrive.reference_front('one_waypoint').shape[1])\n"
        "import algorithms.commands.play"
    )
    assert printed == "4\n"


def test_every_command_prints_its_help_without_any_extra_or_compiler(run_python: Callable[[str], Any]) -> None:
    printed = run_python(
        "import sys\n"
        "from mo_deepdrive.support.extras import EXTRAS\n"
        "sys.modules.update(dict.fromkeys((*EXTRAS, 'numba')))\n"
        "from algorithms.command_line import run\n"
        "from algorithms.commands import COMMANDS\n"
        "print({name for name in COMMANDS if run(name, ['--help'])})"
    )
    assert printed.endswith("\nset()\n")
