"""The examples of docs/evaluation.md, with little training: agents of other libraries scored on the test split."""

from __future__ import annotations

import runpy
from typing import Any

import numpy as np
import pytest

from tests.helpers.paths import REPOSITORY

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]


def run_main(name: str, **arguments: Any) -> Any:
    return runpy.run_path(str(REPOSITORY / "docs" / "examples" / name))["main"](**arguments)


def test_a_function_written_by_hand_arrives() -> None:
    assert run_main("plain_policy.py", episodes=100).metrics()["success"] == 1.0


@pytest.mark.parametrize(
    ("name", "library", "total_timesteps", "objectives"),
    [("sb3_agent.py", "stable_baselines3", 16_384, 6), ("torchrl_agent.py", "torchrl", 2048, 5)],
)
def test_an_agent_of_another_library_is_trained_and_scored(
    name: str, library: str, total_timesteps: int, objectives: int, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip(library, reason=f"needs {library}: make test-integrations")
    evaluation = run_main(name, total_timesteps=total_timesteps, episodes=20)
    assert evaluation.returns.shape == (20, 1, objectives)
    assert np.isfinite(evaluation.episode_utilities()).all()
    assert "utility_esr" in capsys.readouterr().out
