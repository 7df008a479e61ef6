"""The results of a sweep as data frames and Parquet files."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from algorithms.reporting.training_log import read_metrics
from algorithms.studies.manifest import ManifestRow
from algorithms.studies.sweep_tables import Collection, collect
from tests.helpers.made_up_sweeps import end, make_sweep, record, scores_of


@pytest.mark.slow
def test_the_files_have_the_metrics_and_scores_of_all_runs(tmp_path: Path, grid: list[ManifestRow]) -> None:
    rows = make_sweep(tmp_path, grid)
    collection = collect(tmp_path, pytest.fail)
    for row in rows:
        mine = collection.metrics.filter(pl.col("run") == row.id).drop("run")
        plain = read_metrics(tmp_path / row.directory / "metrics.csv")
        assert set(mine.columns) == set(plain)
        for name, column in plain.items():
            np.testing.assert_array_equal(mine[name].cast(pl.Float64).fill_null(np.nan).to_numpy(), column)
    scores = pl.read_parquet(tmp_path / "collected/scores.parquet")
    assert len(scores) == len(rows) * 6
    score = -scores_of(rows[4])
    expected = {"value": score, "low": score - 1.0, "seed": 1, "state": "finished", "algorithm.steps": 32}
    one = scores.filter(run=rows[4].id, policy="stochastic", metric="utility_esr").row(0, named=True)
    assert {name: one[name] for name in expected} == expected
    assert collection.runs["run"].to_list() == [row.id for row in rows]


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
    collection, said = collected(tmp_path)
    assert said == ["the collected results are not stored: [Errno 28] No space left on device"]
    assert len(collection.metrics) == 18 * 24
    assert list((tmp_path / "collected").iterdir()) == []


def test_unfinished_and_missing_runs_are_counted_and_the_first_ones_named(
    tmp_path: Path, grid: list[ManifestRow]
) -> None:
    rows = make_sweep(tmp_path, grid)
    end(tmp_path, rows[0], {}, "running")
    (tmp_path / rows[0].directory / "evaluation.json").unlink()
    for row in rows[1:4]:
        shutil.rmtree(tmp_path / row.directory)
    end(tmp_path, rows[4], {}, "failed")
    collection, said = collected(tmp_path)
    assert said == [
        "left out: 5 of 18 runs have no final evaluation (3 waiting, 1 running, 1 failed): "
        f"{rows[0].directory}, {rows[1].directory}, {rows[2].directory}, and 2 more"
    ]
    assert rows[4].id not in collection.scores["run"]  # the score from before it was trained again does not count
    assert collection.metrics.filter(pl.col("run") == rows[0].id).height == 24
    states = dict(collection.runs.select("run", "state").rows())
    assert [states[row.id] for row in rows[:5]] == ["running", "waiting", "waiting", "waiting", "failed"]


def test_runs_whose_scores_have_changed_are_left_out(tmp_path: Path, grid: list[ManifestRow]) -> None:
    rows = make_sweep(tmp_path, grid[:3])
    for row in rows:
        record(tmp_path, row)
    collect(tmp_path, pytest.fail)
    path = tmp_path / rows[0].directory / "evaluation.json"
    path.write_text(path.read_text().replace('"value": 0.1', '"value": 9.9'))
    collection, said = collected(tmp_path)
    assert said == [
        f"left out: 1 files cannot be read: {rows[0].directory}: evaluation.json: changed since the run finished; "
        "mo-deepdrive sweep --remake makes it again"
    ]
    assert {*collection.scores["run"]} == {row.id for row in rows[1:]}
