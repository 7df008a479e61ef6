"""Drawing learning curves through the command line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.helpers.script_runs import (
    Call,
    refused,
)

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.slow


def test_plot_draws_runs(finished: Path, tmp_path: Path, call: Call) -> None:
    code, out, error = call("plot", finished, "--output", "curves.pdf")
    assert code == 0, out + error
    assert "mo_a2c: 1 seed" in out
    assert (tmp_path / "curves.pdf").read_bytes().startswith(b"%PDF")
    refused(call("plot", "nowhere"), "'nowhere' is not a run directory")
    refused(call("plot", finished, finished), "the same seed")
    refused(call("plot", finished, "--output", "curves.xyz"), "xyz")


def test_plot_draws_runs_of_fronts(finished_front: Path, tmp_path: Path, call: Call) -> None:
    code, out, error = call("plot", finished_front, "--output", "curves.pdf")
    assert code == 0, out + error
    assert "pcn: 1 seed" in out
    assert (tmp_path / "curves.pdf").read_bytes().startswith(b"%PDF")
