"""``scripts/return_representations.py``: what a critic of the distribution of returns can represent."""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING

import pytest
import torch

from algorithms.common.return_distributions import CategoricalGrid, Particles
from tests.helpers.script_runs import Call, refused

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from types import ModuleType


@pytest.fixture
def script(load_script: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script as a module, with short fits."""
    script = load_script("return_representations")
    monkeypatch.setattr(script, "GRADIENT_STEPS", 400)
    return script


def test_critics_that_can_represent_the_returns_are_fitted_exactly(script: ModuleType) -> None:
    returns = torch.tensor([[0.0, 1.0], [1.0, 0.0]]).repeat(50, 1)
    grid = CategoricalGrid([0.0, 0.0], [1.0, 1.0], 2, returns.device)
    _, masses = grid.support(script.fit_grid(grid, returns))
    torch.testing.assert_close(masses, torch.tensor([[0.0, 0.5, 0.5, 0.0]]))
    particles = Particles(2, torch.tensor([1.0, 1.0]), [-10.0, -10.0], [10.0, 10.0])
    points, _ = particles.support(script.fit_particles(particles, returns, torch.Generator().manual_seed(1)))
    torch.testing.assert_close(points.sum(dim=-1), torch.ones(1, 2), atol=0.05, rtol=0.0)


def test_every_critic_is_compared_for_every_policy_and_utility(
    script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script.main(["--episodes", "20", "--output", str(tmp_path / "critics.csv")])
    with (tmp_path / "critics.csv").open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    assert len(rows) == 3 * 3 * 2
    assert "particles" in capsys.readouterr().out
    for row in rows:
        if row["critic"] == "32 particles" and row["policy"] != "random actions":
            assert float(row["of_critic"]) == pytest.approx(float(row["of_returns"]), abs=1.0)


def test_invalid_arguments_are_refused(call: Call) -> None:
    refused(call("return_representations", "--episodes", "0"), "--episodes 0 must be at least 1")
    refused(call("return_representations", "--output", "nowhere/file.csv"), "there is no folder nowhere")
