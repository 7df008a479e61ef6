"""The results of a sweep as data frames and Parquet files."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from algorithms.reporting.training_log import read_metrics
from algorithms.studies.collection import Collection, collect
from algorithms.studies.manifest import ManifestRow
from tests.helpers.made_up_sweeps import end, make_row, make_sweep, record, scores_of

# -------------------------------------------------------------------------------------------------------------- content


@pytest.mark.slow
def test_the_files_have_the_metrics_and_scores_of_all_runs(tmp_path: Path, grid: list[ManifestRow]) -> None:
    rows = make_sweep(tmp_path, grid)
    found = collect(tmp_path, pytest.fail)
    for row in rows:
        mine = found.metrics.filter(pl.col("run") == row.id).drop("run")
        plain = read_metrics(tmp_path / row.directory / "metrics.csv")
        assert set(mine.columns) == set(plain)
        for name, column in plain.items():
            np.testing.assert_array_equal(mine[name].cast(pl.Float64).fill_null(np.nan).to_numpy(), column)
    scores = pl.read_parquet(tmp_path / "collected/scores.parquet")
    assert len(scores) == len(rows) * 6
    one = scores.filter(run=rows[4].id, policy="stochastic", metric="utility_esr").row(0, named=True)
    assert one == {
        "run": rows[4].id,
        "policy": "stochastic",
        "vehicle": "",
        "metric": "utility_esr",
        "value": -scores_of(rows[4]),
        "low": -scores_of(rows[4]) - 1.0,
        "high": None,
        "cell": "algorithm.learning_rate=0.0001 algorithm.steps=32",
        "trial": None,
        "seed": 1,
        "state": "finished",
        "algorithm.learning_rate": 1e-4,
        "algorithm.steps": 32,
    }
    runs = found.runs
    assert runs["run"].to_list() == [row.id for row in rows]
    assert runs["rows"].unique().to_list() == [24]


def test_columns_of_keys_keep_their_types(tmp_path: Path, base: dict[str, Any]) -> None:
    cells: list[dict[str, Any]] = [
        {"algorithm.hidden": [8], "algorithm.observe_discount": True, "algorithm.gamma": 1, "config": "a"},
        {"algorithm.hidden": None, "algorithm.observe_discount": False, "algorithm.gamma": 0.5, "config": "b"},
    ]
    make_sweep(tmp_path, [make_row(base, cell, 0) for cell in cells])
    runs = collect(tmp_path, pytest.fail).runs.select(*cells[0])
    assert runs.dtypes == [pl.String, pl.Boolean, pl.Float64, pl.String]
    assert runs.rows() == [("[8]", True, 1.0, "a"), ("null", False, 0.5, "b")]


# ------------------------------------------------------------------------------------------------------------ written


def collected(sweep: Path) -> tuple[Collection, list[str]]:
    """The results of a sweep, and what is left out."""
    said: list[str] = []
    return collect(sweep, said.append), said


def test_a_sweep_that_cannot_be_written_is_still_shown(
    tmp_path: Path, grid: list[ManifestRow], monkeypatch: pytest.MonkeyPatch
) -> None:
    make_sweep(tmp_path, grid)

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    found, said = collected(tmp_path)
    assert said == ["the collected results are not stored: [Errno 28] No space left on device"]
    assert len(found.metrics) == 18 * 24
    assert list((tmp_path / "collected").iterdir()) == []


# --------------------------------------------------------------------------------------------- broken and missing files


def test_unfinished_and_missing_runs_are_counted_and_the_first_ones_named(
    tmp_path: Path, grid: list[ManifestRow]
) -> None:
    rows = make_sweep(tmp_path, grid)
    end(tmp_path, rows[0], {}, "running")
    (tmp_path / rows[0].directory / "evaluation.json").unlink()
    for row in rows[1:4]:
        shutil.rmtree(tmp_path / row.directory)
    end(tmp_path, rows[4], {}, "failed")
    found, said = collected(tmp_path)
    assert said == [
        "left out: 5 of 18 runs have no final evaluation (3 waiting, 1 running, 1 failed): "
        f"{rows[0].directory}, {rows[1].directory}, {rows[2].directory}, and 2 more"
    ]
    assert rows[4].id not in found.scores["run"]  # the score from before it was trained again does not count
    assert found.metrics.filter(pl.col("run") == rows[0].id).height == 24
    states = dict(found.runs.select("run", "state").rows())
    assert [states[row.id] for row in rows[:5]] == ["running", "waiting", "waiting", "waiting", "failed"]
    for broken in ("{", "{}", '{"policies": []}', '{"policies": {"greedy": {"success": 1}}}'):
        (tmp_path / rows[5].directory / "evaluation.json").write_text(broken)
        assert collected(tmp_path)[1][1].startswith("left out: 1 files cannot be read")


def test_runs_whose_scores_have_changed_are_left_out(tmp_path: Path, grid: list[ManifestRow]) -> None:
    rows = make_sweep(tmp_path, grid[:3])
    for row in rows:
        record(tmp_path, row)
    collect(tmp_path, pytest.fail)
    path = tmp_path / rows[0].directory / "evaluation.json"
    path.write_text(path.read_text().replace('"value": 0.1', '"value": 9.9'))
    found, said = collected(tmp_path)
    assert said == [
        f"left out: 1 files cannot be read: {rows[0].directory}: evaluation.json: changed since the run finished; "
        "mo-deepdrive sweep --remake makes it again"
    ]
    assert {*found.scores["run"]} == {row.id for row in rows[1:]}
