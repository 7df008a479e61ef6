"""The tables of a sweep: which cells are compared, and their order."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path
from typing import Any

import pytest

from algorithms.studies.manifest import ManifestRow
from algorithms.studies.sweep_tables import (
    collect,
    rank,
)
from tests.helpers.made_up_sweeps import Script, config_of, end, make_row, make_sweep, scores_of


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_table_shows_the_best_cells_and_the_csv_has_all(
    tmp_path: Path, grid: list[ManifestRow], capsys: pytest.CaptureFixture[str], table: Script
) -> None:
    rows = make_sweep(tmp_path, grid)
    shutil.rmtree(tmp_path / rows[-1].directory)
    output = tmp_path / "scores.csv"
    assert table(tmp_path, "--top", "2", "--output", output) == 0
    shown = capsys.readouterr()
    assert shown.err.count("\n") == 1
    assert "1 of 18 runs have no final evaluation (1 waiting)" in shown.err
    assert "2 of 6 cells, by greedy utility" in shown.out
    utilities = [cell for cell in read(output) if cell["metric"] == "utility_esr"]
    assert [cell["policy"] for cell in utilities] == ["greedy", "stochastic"] * 6
    first = [utilities[0][name] for name in ("algorithm.learning_rate", "algorithm.steps", "seeds", "n")]
    assert first == ["0.01", "16", "0 1 2", "3"]
    assert [float(utilities[0][name]) for name in ("mean", "low", "high")] == pytest.approx([10.1, 10.0, 10.2])
    assert [utilities[-1][name] for name in ("algorithm.learning_rate", "algorithm.steps")] == ["0.0001", "32"]
    assert table(tmp_path, "--sort", "stochastic/utility_esr", "--output", output) == 0
    assert read(output)[0]["algorithm.learning_rate"] == "0.0001"
    assert table(tmp_path, "--sort", "greedy/utlity_esr") == 2
    assert "did you mean 'greedy/utility_esr'" in capsys.readouterr().err


def test_the_table_of_a_search_shows_its_trials(tmp_path: Path, base: dict[str, Any], table: Script) -> None:
    points = [{"algorithm.learning_rate": rate} for rate in (0.0012345678, 0.0078)]
    make_sweep(tmp_path, [make_row(base, point, seed, trial) for trial, point in enumerate(points) for seed in (0, 1)])
    output = tmp_path / "scores.csv"
    assert table(tmp_path, "--output", output) == 0
    shown = [(row["trial"], row["algorithm.learning_rate"]) for row in read(output)]
    assert list(dict.fromkeys(shown)) == [("1", "0.0078"), ("0", "0.0012345678")]


def test_algorithms_are_compared_in_cells_that_differ_in_nothing_else(
    tmp_path: Path, base: dict[str, Any], table: Script
) -> None:
    bases = {"a": base, "b": config_of("one_waypoint/a2c_linear"), "c": config_of("one_waypoint/a2c_nonlinear")}
    cells = [{"config": name, "algorithm.steps": steps} for name in bases for steps in (8, 16)]
    make_sweep(tmp_path, [make_row(bases[cell["config"]], cell, seed) for cell in cells for seed in range(3)])
    output = tmp_path / "scores.csv"
    assert table(tmp_path, "--output", output) == 0
    compared = read(tmp_path / "scores-differences.csv")
    assert [(row["algorithm.steps"], row["policy"], row["difference"], row["metric"]) for row in compared] == [
        (steps, policy, "mo_a2c - a2c", "utility_esr") for steps in ("8", "16") for policy in ("greedy", "stochastic")
    ]


def test_cells_are_ranked_among_comparable_cells(tmp_path: Path, base: dict[str, Any]) -> None:
    other = config_of("one_waypoint/mo_a2c_nonlinear")
    front = config_of("one_waypoint/pcn")
    cells = [{"config": name, "algorithm.learning_rate": rate} for name in "abc" for rate in (1e-4, 1e-2, 1e-3)]
    rows = [
        make_row({"a": base, "b": other, "c": front}[cell["config"]], cell, seed) for cell in cells for seed in (0, 1)
    ]
    make_sweep(tmp_path, rows)
    for row in rows[12:]:
        end(tmp_path, row, {"front": {"hypervolume": 100.0 - scores_of(row), "igd_plus": 1.0 - scores_of(row)}})
    collection = collect(tmp_path, pytest.fail)
    scores = collection.scores
    rankings = rank(collection.cells, scores)
    assert [(ranking.title, ranking.score_name) for ranking in rankings] == [
        ("mo-deepdrive-one-waypoint-v0, one_waypoint_linear", "greedy utility"),
        ("mo-deepdrive-one-waypoint-v0, one_waypoint_nonlinear", "greedy utility"),
        ("mo-deepdrive-one-waypoint-v0 fixed_destination=True", "front hypervolume"),
    ]
    rates = [[cell.keys["algorithm.learning_rate"] for cell in ranking.cells] for ranking in rankings]
    assert rates == [[1e-2, 1e-3, 1e-4], [1e-2, 1e-3, 1e-4], [1e-4, 1e-3, 1e-2]]
    assert rankings[0].ranked[0] == pytest.approx(10.05)
    by_collisions = rank(collection.cells, scores, "end/collision")  # the fewer the better
    assert [len(ranking.ranked) for ranking in by_collisions] == [3, 3, 0]
    assert [cell.keys["algorithm.learning_rate"] for cell in by_collisions[0].cells] == [1e-2, 1e-3, 1e-4]
    assert rank(collection.cells, scores, "front/igd_plus")[2].cells[0].keys["algorithm.learning_rate"] == 1e-2


def test_utilities_are_summed_over_vehicles(tmp_path: Path) -> None:
    base = config_of("intersection/mo_a2c_linear")
    rows = [make_row(base, {"algorithm.steps": steps}, 0) for steps in (8, 16)]
    make_sweep(tmp_path, rows)
    for row, (first, second) in zip(rows, ((1.0, 5.0), (3.0, 2.0)), strict=True):
        numbers = {"success": 0.5, "vehicle_0/utility_esr": first, "vehicle_1/utility_esr": second}
        end(tmp_path, row, {"greedy": numbers})
    collection = collect(tmp_path, pytest.fail)
    (both,) = rank(collection.cells, collection.scores)
    assert both.score_name == "greedy total utility"
    assert both.ranked == (6.0, 5.0)
    (one,) = rank(collection.cells, collection.scores, "greedy/vehicle_0/utility_esr")
    assert one.ranked == (3.0, 1.0)


def test_cells_of_different_splits_are_not_ranked_together(tmp_path: Path, base: dict[str, Any]) -> None:
    make_sweep(tmp_path, [make_row(base, {"evaluation.split": split}, 0) for split in ("validation", "test")])
    collection = collect(tmp_path, pytest.fail)
    assert [len(ranking.cells) for ranking in rank(collection.cells, collection.scores)] == [1, 1]
