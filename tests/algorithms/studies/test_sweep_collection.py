"""The results of a sweep as Parquet files: correct, updated incrementally, never half written."""

from __future__ import annotations

import errno
import gc
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from algorithms.reporting.training_log import read_metrics
from algorithms.studies import metrics_parquet
from algorithms.studies.sweep_collection import collect
from algorithms.studies.sweep_manifest import ManifestRow, write_manifest
from tests.helpers.made_up_sweeps import end, log, make_row, make_sweep, parts, record, scores_of

# -------------------------------------------------------------------------------------------------------------- content


@pytest.mark.slow
def test_the_files_have_the_metrics_and_scores_of_all_runs(tmp_path: Path, grid: list[ManifestRow]) -> None:
    rows = make_sweep(tmp_path, grid)
    collection = collect(tmp_path)
    assert collection.remarks == []
    for row in rows:
        mine = collection.metrics.filter(pl.col("run") == row.id).drop("run").collect()
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
    runs = collection.runs.collect()
    assert runs["run"].to_list() == [row.id for row in rows]
    assert runs["rows"].unique().to_list() == [24]


@pytest.mark.slow
def test_polars_and_pandas_read_the_parts_as_one_table(
    tmp_path: Path, grid: list[ManifestRow], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metrics_parquet, "PART_RUNS", 5)
    rows = make_sweep(tmp_path, grid)
    log(tmp_path, rows[0], [(0, {"of/this/run": 1.0}), (7, {"loss/policy": 2.0})])
    collect(tmp_path)
    assert len(parts(tmp_path)) == 4
    by_polars = pl.scan_parquet(tmp_path / "collected/metrics/*.parquet").collect()
    pytest.importorskip("pyarrow")
    by_pandas = pytest.importorskip("pandas").read_parquet(tmp_path / "collected/metrics")
    assert list(by_pandas.columns) == by_polars.columns
    assert len(by_pandas) == len(by_polars) == 17 * 24 + 2
    assert by_polars.filter(pl.col("of/this/run").is_not_null()).rows()[0][:2] == (rows[0].id, 0)
    mine = by_polars.filter(run=rows[0].id)
    assert mine["loss/policy"].to_list() == [None, 2.0]


def test_columns_of_keys_keep_their_types(tmp_path: Path, base: dict[str, Any]) -> None:
    cells: list[dict[str, Any]] = [
        {"algorithm.hidden": [8], "algorithm.observe_discount": True, "algorithm.gamma": 1, "config": "a"},
        {"algorithm.hidden": None, "algorithm.observe_discount": False, "algorithm.gamma": 0.5, "config": "b"},
    ]
    make_sweep(tmp_path, [make_row(base, cell, 0) for cell in cells])
    runs = collect(tmp_path).runs.select(*cells[0]).collect()
    assert runs.dtypes == [pl.String, pl.Boolean, pl.Float64, pl.String]
    assert runs.rows() == [("[8]", True, 1.0, "a"), ("null", False, 0.5, "b")]


# --------------------------------------------------------------------------------------------------- incremental update


def test_unchanged_files_are_neither_read_nor_written_again(
    tmp_path: Path, grid: list[ManifestRow], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metrics_parquet, "PART_RUNS", 5)
    rows = make_sweep(tmp_path, grid)
    read: list[str] = []
    whole = metrics_parquet._read_rows
    monkeypatch.setattr(metrics_parquet, "_read_rows", lambda path: read.append(path.parent.name) or whole(path))
    collect(tmp_path)
    assert sorted(read) == sorted(Path(row.directory).name for row in rows)
    written = parts(tmp_path)
    read.clear()
    collect(tmp_path)
    assert (read, parts(tmp_path)) == ([], written)
    path = tmp_path / rows[7].directory / "metrics.csv"
    with path.open("a") as file:
        file.write("500,1.0,,,\n")
    collection = collect(tmp_path)
    assert read == [path.parent.name]
    assert [name for name, when in parts(tmp_path).items() if when != written[name]] == ["part-001.parquet"]
    assert collection.metrics.filter(pl.col("run") == rows[7].id).select("step").collect().height == 25
    assert collection.metrics.collect().height == 18 * 24 + 1


def test_a_changed_file_of_the_same_size_is_read_again(tmp_path: Path, grid: list[ManifestRow]) -> None:
    row = make_sweep(tmp_path, grid[:2])[1]
    mine = collect(tmp_path).metrics.filter(pl.col("run") == row.id)
    assert mine.select("loss/policy").collect()["loss/policy"].max() == 0.5
    path = tmp_path / row.directory / "metrics.csv"
    before = path.stat()
    path.write_text(path.read_text().replace("0.5", "0.7"))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns + 1))
    assert path.stat().st_size == before.st_size
    mine = collect(tmp_path).metrics.filter(pl.col("run") == row.id)
    assert mine.select("loss/policy").collect()["loss/policy"].max() == 0.7


def test_added_and_removed_runs(tmp_path: Path, grid: list[ManifestRow], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics_parquet, "PART_RUNS", 4)
    rows = make_sweep(tmp_path, grid)
    write_manifest(tmp_path, rows[:6])
    assert set(collect(tmp_path).metrics.collect()["run"]) == {row.id for row in rows[:6]}
    write_manifest(tmp_path, rows[5:])
    assert set(collect(tmp_path).metrics.collect()["run"]) == {row.id for row in rows[5:]}
    assert collect(tmp_path).metrics.collect().height == 13 * 24
    shutil.rmtree(tmp_path / rows[5].directory)
    assert collect(tmp_path).metrics.collect().height == 12 * 24
    write_manifest(tmp_path, rows[6:7])
    collect(tmp_path)
    assert len(parts(tmp_path)) == 1


def test_parts_are_limited_in_bytes(tmp_path: Path, grid: list[ManifestRow], monkeypatch: pytest.MonkeyPatch) -> None:
    rows = make_sweep(tmp_path, grid)
    size = (tmp_path / rows[0].directory / "metrics.csv").stat().st_size
    monkeypatch.setattr(metrics_parquet, "PART_BYTES", 6 * size - size // 2)
    assert collect(tmp_path).metrics.collect().height == 18 * 24
    assert len(parts(tmp_path)) == 3


def test_broken_parts_are_written_again(tmp_path: Path, grid: list[ManifestRow]) -> None:
    make_sweep(tmp_path, grid)
    before = collect(tmp_path).metrics.collect()
    part = next((tmp_path / "collected/metrics").glob("*.parquet"))
    part.write_bytes(part.read_bytes()[:1000])
    assert collect(tmp_path).metrics.collect().equals(before)
    pl.DataFrame({"foreign": [1]}).write_parquet(part)
    assert collect(tmp_path).metrics.collect().equals(before)


def test_a_full_disk_leaves_no_half_written_files(
    tmp_path: Path, grid: list[ManifestRow], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metrics_parquet, "PART_RUNS", 5)
    make_sweep(tmp_path, grid)
    whole, left = os.fsync, [2]

    def fsync(descriptor: int) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise OSError(28, "No space left on device")
        whole(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(OSError, match="No space left"):
        collect(tmp_path)
    assert len(parts(tmp_path)) == 2
    names = [path.name for path in (tmp_path / "collected").rglob("*") if path.is_file()]
    assert sorted(names) == [".lock", "part-000.parquet", "part-001.parquet"]
    assert pl.scan_parquet(tmp_path / "collected/metrics/*.parquet").collect().height == 10 * 24
    written = parts(tmp_path)
    monkeypatch.setattr(os, "fsync", whole)
    (tmp_path / "collected/metrics/.part-002.parquet.x.tmp").write_bytes(b"of a process that was killed")
    assert collect(tmp_path).metrics.collect().height == 18 * 24
    assert written.items() <= parts(tmp_path).items()
    assert not list((tmp_path / "collected").rglob("*.tmp"))


def test_a_sweep_that_cannot_be_written_is_collected_elsewhere(
    tmp_path: Path, grid: list[ManifestRow], monkeypatch: pytest.MonkeyPatch
) -> None:
    make_sweep(tmp_path / "sweep", grid)
    whole = collect(tmp_path / "sweep").latest_scores()
    shutil.rmtree(tmp_path / "sweep" / "collected")
    make = Path.mkdir

    def read_only(path: Path, *arguments: Any, **options: Any) -> None:
        if path.is_relative_to(tmp_path / "sweep"):
            raise OSError(errno.EROFS, "Read-only file system", str(path))
        make(path, *arguments, **options)

    monkeypatch.setattr(Path, "mkdir", read_only)
    collection = collect(tmp_path / "sweep")
    said: list[str] = []
    collection.report_problems(said.append)
    (warning,) = said
    assert warning.startswith("the collected results are not stored: [Errno 30] Read-only file system: ")
    assert collection.latest_scores()[1].equals(whole[1])
    assert not (tmp_path / "sweep" / "collected").exists()
    temporary = collection.folder
    del collection
    gc.collect()
    assert not temporary.exists()


def test_nothing_is_collected_through_a_link(tmp_path: Path, grid: list[ManifestRow]) -> None:
    make_sweep(tmp_path / "sweep", grid[:1])
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "part-000.parquet").write_text("mine")
    link = tmp_path / "sweep" / "collected" / "metrics"
    link.parent.mkdir()
    link.symlink_to(mine)
    with pytest.raises(ValueError, match=rf"leads to '{mine}.*; nothing is written or deleted through a link inside a"):
        collect(tmp_path / "sweep")
    assert [path.read_text() for path in mine.iterdir()] == ["mine"]
    link.unlink()
    (tmp_path / "link").symlink_to(tmp_path / "sweep")
    assert len(collect(tmp_path / "link").scored) == 1


# --------------------------------------------------------------------------------------------- broken and missing files


def test_incomplete_lines_are_dropped_and_broken_files_are_named(tmp_path: Path, grid: list[ManifestRow]) -> None:
    rows = make_sweep(tmp_path, grid)
    files = [tmp_path / row.directory / "metrics.csv" for row in rows]
    with files[0].open("a") as file:
        file.write("120,3.5,-1")
    lines = files[1].read_text().splitlines(keepends=True)
    files[1].write_text("".join([*lines[:3], "25,1.0\n", *lines[3:]]))
    files[2].write_text("step,a,b\n")
    files[3].write_text("step,a")
    files[4].unlink()
    files[5].write_text("a,step\n1,2\n")
    files[6].write_text("step,a\n0,nan\n1,word\n")
    files[8].write_bytes(b"step,a\n0,\xff\n")
    files[7].write_text("step,a\n0,nan\n1,inf\n2,\n3,1e-3\n")
    for _ in range(2):  # also when nothing is read again
        collection = collect(tmp_path)
        heights = dict(collection.metrics.group_by("run").len().collect().rows())
        assert [heights.get(row.id, 0) for row in rows[:10]] == [24, 24, 0, 0, 0, 0, 0, 4, 0, 24]
        (remark,) = collection.remarks
        assert remark.startswith("3 files cannot be read: metrics file")
        assert "has no column 'step'" in remark
        assert "'word'" in remark
        assert "can't decode" in remark
    values = collection.metrics.filter(pl.col("run") == rows[7].id).select("a").collect()["a"].to_list()
    assert values == [None, np.inf, None, 1e-3]


def test_runs_without_rows_add_no_rows(tmp_path: Path, grid: list[ManifestRow]) -> None:
    rows = make_sweep(tmp_path / "a [sweep] *", grid)
    for row in rows:
        (tmp_path / "a [sweep] *" / row.directory / "metrics.csv").write_text("broken\n")
    with pytest.raises(ValueError, match="has any metrics yet"):
        collect(tmp_path / "a [sweep] *").metrics.collect()
    log(tmp_path / "a [sweep] *", rows[3], [(0, {"a": 1.0})])
    assert collect(tmp_path / "a [sweep] *").metrics.collect().rows() == [(rows[3].id, 0, 1.0)]


def test_unfinished_and_missing_runs_are_counted_and_the_first_ones_named(
    tmp_path: Path, grid: list[ManifestRow]
) -> None:
    rows = make_sweep(tmp_path, grid)
    end(tmp_path, rows[0], {}, "running")
    (tmp_path / rows[0].directory / "evaluation.json").unlink()
    for row in rows[1:4]:
        shutil.rmtree(tmp_path / row.directory)
    end(tmp_path, rows[4], {}, "failed")
    collection = collect(tmp_path)
    assert collection.remarks == [
        "5 of 18 runs have no final evaluation (3 waiting, 1 running, 1 failed): "
        f"{rows[0].directory}, {rows[1].directory}, {rows[2].directory}, and 2 more"
    ]
    assert rows[4].id not in collection.scored  # the score from before it was trained again does not count
    assert collection.metrics.filter(pl.col("run") == rows[0].id).collect().height == 24
    states = dict(collection.runs.select("run", "state").collect().rows())
    assert [states[row.id] for row in rows[:5]] == ["running", "waiting", "waiting", "waiting", "failed"]
    for broken in ("{", "{}", '{"policies": []}', '{"policies": {"greedy": {"success": 1}}}'):
        (tmp_path / rows[5].directory / "evaluation.json").write_text(broken)
        assert collect(tmp_path).remarks[1].startswith("1 files cannot be read")


# ------------------------------------------------------------------------------------------ files that do not match


def edited(path: Path, old: str, new: str) -> None:
    """Replace text in a file."""
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))


def test_runs_whose_scores_or_metrics_have_changed_are_left_out(tmp_path: Path, grid: list[ManifestRow]) -> None:
    rows = make_sweep(tmp_path, grid[:6])
    for row in rows:
        (tmp_path / row.directory / "checkpoint.safetensors").write_bytes(b"weights")
        record(tmp_path, row)
    for collection in (collect(tmp_path), collect(tmp_path)):
        assert collection.remarks == []
    folders = [tmp_path / row.directory for row in rows]
    edited(folders[0] / "evaluation.json", '"value": 0.1', '"value": 9.9')
    edited(folders[1] / "metrics.csv", "0.5", "0.7")
    cut = (folders[2] / "metrics.csv").read_bytes()
    (folders[2] / "metrics.csv").write_bytes(cut[:100])
    (folders[3] / "checkpoint.safetensors").unlink()
    for _ in range(2):  # also when nothing is read again
        collection = collect(tmp_path)
        advice = "runs differ from the record of their files, mo-deepdrive sweep --remake makes them again: "
        assert collection.remarks == [
            f"3 {advice}{rows[0].directory}: evaluation.json: changed since the run finished, "
            f"{rows[1].directory}: metrics.csv: changed since the run finished, "
            f"{rows[2].directory}: metrics.csv: 100 bytes, recorded {len(cut)}"
        ]
        said: list[str] = []
        collection.report_problems(said.append)
        assert said[1:] == [f"1 {advice}{rows[3].directory}: checkpoint.safetensors: missing"]
        assert collection.scored == {row.id for row in rows[3:]}
        assert set(collection.scores.collect()["run"]) == collection.scored
    for folder in folders[3:]:
        edited(folder / "evaluation.json", "0.5", "0.6")
    collection = collect(tmp_path)
    assert not collection.scored
    assert len(collection.latest_scores()[1]) == 0


# --------------------------------------------------------------------------------------------------------------- curves


def test_curves_are_averaged_over_intervals_of_steps(tmp_path: Path, base: dict[str, Any]) -> None:
    (row,) = make_sweep(tmp_path, [make_row(base, {}, 0)], points=1000)
    names = ["eval/greedy/utility_esr", "train/utility"]
    found = collect(tmp_path).curves([row.id], names, points=50)[row.id]
    plain = read_metrics(tmp_path / row.directory / "metrics.csv")
    width = int(plain["step"].max()) // 50 + 1
    for name in names:
        known = np.isfinite(plain[name])
        steps, values = plain["step"][known], plain[name][known]
        bins = steps // width
        wanted = [(steps[bins == b].mean(), values[bins == b].mean()) for b in np.unique(bins)]
        there = np.isfinite(found[name])
        assert there.sum() == 50
        np.testing.assert_allclose(np.stack([found["step"], found[name]], axis=1)[there], wanted)


def test_short_curves_are_not_averaged(tmp_path: Path, grid: list[ManifestRow]) -> None:
    rows = make_sweep(tmp_path, grid)
    found = collect(tmp_path).curves([row.id for row in rows[:2]], ["eval/greedy/utility_esr"])
    assert set(found) == {row.id for row in rows[:2]}
    np.testing.assert_array_equal(found[rows[1].id]["step"], 10.0 * np.arange(12))
    np.testing.assert_allclose(found[rows[1].id]["eval/greedy/utility_esr"], scores_of(rows[1]) + np.arange(12))
