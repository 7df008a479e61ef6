"""The script that draws two drives that a task ranks differently."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from mo_deepdrive import suite


@pytest.fixture
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("task_pictures")


def test_the_two_drives_are_those_that_two_judges_rank_in_opposite_orders_most_clearly(script: ModuleType) -> None:
    # Three rules, two scenarios, two objectives; the last rule does not arrive in the second scenario.
    returns = np.array([[[9.0, 1.0], [5.0, 0.0]], [[1.0, 2.0], [6.0, 1.0]], [[2.0, 9.0], [0.0, 99.0]]])
    arrived = np.array([[True, True], [True, True], [True, False]])
    by, (first, second, scenario) = script.contrariness(returns, arrived, [lambda r: r[..., 0], lambda r: r[..., 1]])
    assert (first, second, scenario) == (0, 2, 0)
    assert by > 0.0
    alike, _ = script.contrariness(returns, arrived, [lambda r: r[..., 0]] * 2)
    assert alike <= 0.0


def test_every_task_that_counts_has_a_pair_of_judges(script: ModuleType) -> None:
    for task in suite.load().tasks.values():
        if task.counted:
            returns = np.zeros((3, 2, len(task.objectives())))
            for pair in script.judges(task):
                assert len(pair) == 2
                assert all(judge(returns).shape == (3, 2) for judge in pair.values())


@pytest.mark.slow
def test_a_picture_is_drawn(script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script, "RULES", 16)
    assert script.main(["K4", "--output", str(tmp_path)]) == 0
    assert (tmp_path / "K4.png").read_bytes().startswith(b"\x89PNG")
