"""The table of a sweep, through the command line."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from algorithms.studies.sweep_manifest import ManifestRow
from algorithms.studies.sweep_tables import print_sweep
from tests.helpers.made_up_sweeps import Script, config_of, make_row, make_sweep


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
    lines = [" ".join(line.split()) for line in shown.out.splitlines() if line.startswith(("  16", "  32"))]
    assert [line.split(" 10.")[0].split(" -10.")[0] for line in lines] == [
        f"{steps} {policy} {seeds}"
        for steps, seeds in ((16, "3"), (32, "2 of 3"))
        for policy in ("greedy", "stochastic")
    ]
    cells = read(output)
    assert list(cells[0])[:5] == ["algorithm.learning_rate", "algorithm.steps", "seeds", "policy", "vehicle"]
    utilities = [cell for cell in cells if cell["metric"] == "utility_esr"]
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
    found = [(row["trial"], row["algorithm.learning_rate"]) for row in read(output)]
    assert list(dict.fromkeys(found)) == [("1", "0.0078"), ("0", "0.0012345678")]


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


@pytest.mark.parametrize("width", [80, 100])
def test_many_keys_and_metrics_fit_the_terminal(
    tmp_path: Path, base: dict[str, Any], capsys: pytest.CaptureFixture[str], width: int
) -> None:
    keys = ["learning_rate", "learning_rate_end", "gae_lambda", "steps", "entropy_start", "value_coefficient", "hidden"]
    cells = [
        {f"algorithm.{key}": [i, 64] if key == "hidden" else 0.001 * i for i, key in enumerate(keys, first)}
        for first in range(1, 25)
    ]
    make_sweep(tmp_path, [make_row(base, cell, seed) for cell in cells for seed in range(2)])
    print_sweep(tmp_path, Console(width=width), pytest.fail)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= width
    text = " ".join(" ".join(lines).split())
    assert "20 of 24 cells, by greedy utility" in text
    assert "…" not in text
    assert all(f"{key}=" in "".join(text.split()) for key in keys)
    assert "--output FILE.csv writes every metric Means over seeds" in text
