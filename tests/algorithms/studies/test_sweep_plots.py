"""The figures of a sweep, through the command line."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from algorithms.studies.collection import collect
from algorithms.studies.manifest import ManifestRow, write_manifest
from algorithms.studies.sweep_plots import best_curves, varied_scores
from algorithms.studies.sweep_tables import rank
from tests.helpers.made_up_sweeps import Script, config_of, end, log, make_row, make_sweep, scores_of


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


def test_curves_of_several_cells_have_greedy_and_sampled_evaluations(tmp_path: Path, base: dict[str, Any]) -> None:
    names = ("eval/greedy/utility_esr", "eval/stochastic/utility_esr", "train/utility")
    rows = make_sweep(tmp_path, [make_row(base, {"algorithm.learning_rate": rate}, 0) for rate in (1e-3, 1e-2)])
    for row in rows:
        log(tmp_path, row, [(step, dict.fromkeys(names, 1.0)) for step in (0, 10)])
    collection = collect(tmp_path, print)
    groups = best_curves(collection, rank(collection.cells, collection.scores))
    assert [{*columns} - {"step"} for group in groups for columns in group.runs] == [{*names[:2]}] * 2


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
    found = scores.filter(run=rows[3].id, policy="greedy", vehicle="", metric="utility_esr")["value"].to_list()
    assert found == [scores_of(rows[3]) + 11.0]
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
    log(tmp_path, grid[0], [(0, {"train/utility": 1.0})])
    assert "to draw" in errors(tmp_path)[0]
    assert all("give one sweep, or else runs" in error for error in errors(tmp_path, "runs"))
    assert table(tmp_path, "--top", "0") == 2
    assert "--top 0 must be at least 1" in capsys.readouterr().err


def test_only_numbers_are_compared_as_numbers(tmp_path: Path, base: dict[str, Any]) -> None:
    points = [(1e-3, True, "b"), (1e-2, False, "b"), (1e-3, False, "a")]
    keys = ("algorithm.learning_rate", "algorithm.observe_discount", "config")
    make_sweep(tmp_path, [make_row(base, dict(zip(keys, point, strict=True)), 0) for point in points])
    collection = collect(tmp_path, print)
    (ranking,) = rank(collection.cells, collection.scores)
    found = varied_scores(collection, ranking)
    assert found.values.tolist() == pytest.approx([1.0, 10.0, 1.0])
    assert np.array_equal(found.keys["learning_rate"], [1e-3, 1e-2, 1e-3])
    assert found.keys["observe_discount"] == ["true", "false", "false"]
    assert found.keys["config"] == ["b", "b", "a"]
