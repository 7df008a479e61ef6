"""Drawing learning curves through the command line."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.script_runs import Call, refused

pytestmark = pytest.mark.slow


def test_plot_draws_runs(finished: Path, tmp_path: Path, call: Call) -> None:
    code, out, error = call("plot", finished, "--output", "curves.pdf")
    assert code == 0, out + error
    assert "mo_a2c: 1 seed" in out
    assert (tmp_path / "curves.pdf").read_bytes().startswith(b"%PDF")
    refused(call("plot", "nowhere"), "'nowhere' holds no run")
    refused(call("plot", "nowhere", "--output", "curves.xyz"), "--output 'curves.xyz' must end in", ".pdf or", ".png")
    refused(call("plot", finished, "--output", "nowhere/x.png"), "--output 'nowhere/x.png'", "nowhere' is not a direc")


def test_plot_fails_in_one_line_where_matplotlib_does(
    finished: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("no\nfonts")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", broken)
    assert call("plot", finished) == (1, "", "error: the curves could not be drawn: RuntimeError: no fonts\n")
