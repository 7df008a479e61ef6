"""The figures of a sweep, through the command line."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import pytest

from algorithms.studies.manifest import ManifestRow, write_manifest
from algorithms.studies.sweep_tables import collect
from tests.helpers.made_up_sweeps import Script, config_of, end, make_row, make_sweep, scores_of


@pytest.mark.slow
def test_figures_of_a_sweep(
    tmp_path: Path, base: dict[str, Any], capsys: pytest.CaptureFixture[str], plot: Script
) -> None:
    bases = {"linear": base, "nonlinear": config_of("one_waypoint/mo_a2c_nonlinear")}
    cells: list[dict[str, Any]] = [
        {"config": name, "algorithm.learning_rate": rate, "algorithm.observe_discount": yes}
        for name, rate, yes in product(bases, (1e-4, 1e-3, 1e-2), (True, False))
    ]
    make_sweep(tmp_path, [make_row(bases[cell["config"]], cell, seed) for cell in cells for seed in (0, 1)])
    output = tmp_path / "curves.png"
    assert plot(tmp_path, "--output", output) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "linear, learning_rate 0.01, observe_discount true: 2 seeds"
    assert [line.split(",")[0] for line in said[:8]] == ["linear"] * 4 + ["nonlinear"] * 4
    assert said[8:] == [
        "the best 8 of 12 cells, by final greedy utility; 4 left out",
        str(output),
        str(tmp_path / "curves-cells.png"),
    ]
    for name in ("curves.png", "curves-cells.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_an_unfinished_sweep_is_plotted_by_its_last_evaluations(
    tmp_path: Path, grid: list[ManifestRow], capsys: pytest.CaptureFixture[str], plot: Script, table: Script
) -> None:
    rows = make_sweep(tmp_path, grid)
    for row in rows:
        end(tmp_path, row, {}, "running")
        (tmp_path / row.directory / "evaluation.json").unlink()
    when, scores = collect(tmp_path, print).latest_scores()
    assert when == "last"
    values = scores.filter(run=rows[3].id, policy="greedy", vehicle="", metric="utility_esr")["value"].to_list()
    assert values == [scores_of(rows[3]) + 11.0]
    assert plot(tmp_path, "--output", tmp_path / "a.png") == 0
    assert "learning_rate 0.01, steps 16: 3 seeds" in capsys.readouterr().out
    assert plot(tmp_path, "--output", tmp_path / "a.xyz") == 2
    assert "xyz" in capsys.readouterr().err
    assert table(tmp_path) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("error: no run of sweep")
    assert "has a final evaluation yet" in error


def test_a_directory_without_runs_is_refused(
    tmp_path: Path, grid: list[ManifestRow], capsys: pytest.CaptureFixture[str], plot: Script, table: Script
) -> None:
    def errors(*arguments: Path | str) -> list[str]:
        assert plot(*arguments) == 2
        assert table(*arguments) == 2
        lines = capsys.readouterr().err.splitlines()
        return [line for line in lines if line.startswith("error: ")]

    assert all("nor" in error and "manifest.jsonl" in error for error in errors(tmp_path))
    write_manifest(tmp_path, [])
    assert all("is empty" in error and "mo-deepdrive sweep" in error for error in errors(tmp_path))
    write_manifest(tmp_path, grid)
    curves, scores = errors(tmp_path)
    assert "has any metrics yet: mo-deepdrive sweep" in curves
    assert "has a final evaluation yet" in scores
    assert all("give one sweep, or else runs" in error for error in errors(tmp_path, "runs"))
    assert table(tmp_path, "--top", "0") == 2
    assert "--top 0 must be at least 1" in capsys.readouterr().err
