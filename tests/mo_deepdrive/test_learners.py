"""The learners have a name that no folder ``algorithms`` of another project hides."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

import algorithms
import algorithms.learning.actors
from mo_deepdrive import learners

LEARNS = """
import numpy as np
from mo_deepdrive.evaluation.env_adapter import make_env
from mo_deepdrive.learners import Agent
from mo_deepdrive.learners.runs.build import load_policy
from mo_deepdrive.learners.runs.run_directory import Run

policy = load_policy(Run.open("one_waypoint_linear-ppo"))
assert isinstance(policy, Agent)
print(type(policy).__module__)
"""
MINE = "from algorithms import mine\nfrom algorithms.ppo import PPO\nprint(PPO)\n"


@pytest.mark.slow
@pytest.mark.parametrize("script", [LEARNS + MINE, MINE + LEARNS], ids=["ours first", "theirs first"])
def test_a_project_with_a_package_algorithms_uses_both(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_python: Callable[[str], str], script: str
) -> None:
    monkeypatch.chdir(tmp_path)  # where Python looks for packages before all other folders
    (tmp_path / "algorithms").mkdir()
    for name, text in (("__init__", ""), ("mine", ""), ("ppo", "PPO = 'their PPO'")):
        (tmp_path / "algorithms" / f"{name}.py").write_text(text)
    assert sorted(run_python(script).splitlines()) == ["mo_deepdrive.learners.ppo", "their PPO"]


def test_where_no_other_package_has_the_name_both_names_are_the_same_modules() -> None:
    from mo_deepdrive.learners.learning import actors

    assert learners.MOPPO is algorithms.MOPPO
    assert actors is algorithms.learning.actors
    assert actors.__spec__ is not None
    assert actors.__spec__.name == "algorithms.learning.actors"
    with pytest.raises(ImportError, match=r"No module named 'mo_deepdrive\.learners\.dqn'"):
        import mo_deepdrive.learners.dqn  # noqa: F401


def test_importing_the_name_imports_no_algorithm(run_python: Callable[[str], str]) -> None:
    script = "import sys, mo_deepdrive.learners\nprint('torch' in sys.modules, len(mo_deepdrive.learners.ALGORITHMS))"
    assert run_python(script) == "False 9\n"
