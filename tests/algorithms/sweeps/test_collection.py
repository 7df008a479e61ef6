"""The results of a sweep as Parquet files: correct, updated incrementally, never half written."""

from __future__ import annotations

import copy
import csv
import json
import os
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from tests.helpers.paths import REPOSITORY

ROOT = REPOSITORY
sys.path.insert(0, str(ROOT / "scripts"))

import plot as plot_script  # noqa: E402  (a script)
import table as table_script  # noqa: E402  (a script)

from algorithms.common.metrics_file import MetricsFile, read_metrics  # noqa: E402
from algorithms.experiments.config import load_experiment  # noqa: E402
from algorithms.sweeps import metrics_parquet  # noqa: E402
from algorithms.sweeps.collection import collect  # noqa: E402
from algorithms.sweeps.manifest import ManifestRow, run_id, write_manifest  # noqa: E402
from algorithms.sweeps.ranking import cell_labels, rank, value_labels, varying_keys  # noqa: E402

Scores = Callable[[ManifestRow], dict[str, dict[str, float]]]


def make_row(base: Mapping[str, Any], cell: dict[str, Any], seed: int, trial: int | None = None) -> ManifestRow:
    """A line of a manifest: ``base`` with the values of the cell, whose key "config" is only a name."""
    config = copy.deepcopy(dict(base))
    for key, value in {**cell, "training.seed": seed}.items():
        if key != "config":
            *sections, last = key.split(".")
            place = config
            for section in sections:
                place = place[section]
            place[last] = value
    name = run_id(config)
    return ManifestRow(name, f"runs/{config['algorithm']['name']}-seed{seed}-{name}", cell, seed, trial, config)


def config_of(name: str) -> dict[str, Any]:
    return load_experiment(ROOT / f"configs/{name}.yaml").to_dict()


def log(sweep: Path, row: ManifestRow, rows: Sequence[tuple[int, dict[str, float]]]) -> Path:
    """Write the metrics of a run, as training does."""
    path = sweep / row.directory / "metrics.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    file = MetricsFile(path)
    for step, metrics in rows:
        file.write(step, metrics)
    return path


def end(sweep: Path, row: ManifestRow, policies: Mapping[str, Mapping[str, float]], state: str = "finished") -> None:
    """Write the status of a run; if it has finished, its final evaluation too."""
    directory = sweep / row.directory
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "status.json").write_text(json.dumps({"state": state, "step": 100}))
    if state == "finished":
        summary = {
            policy: {name: {"value": value, "low": value - 1.0, "high": None} for name, value in metrics.items()}
            for policy, metrics in policies.items()
        }
        (directory / "evaluation.json").write_text(json.dumps({"policies": summary}))


def scores_of(row: ManifestRow) -> float:
    """A score that is unique to each run: it increases with the learning rate and slightly with the seed."""
    return 1000.0 * row.config["algorithm"]["learning_rate"] + 0.1 * row.seed


def make_sweep(sweep: Path, rows: Sequence[ManifestRow], points: int = 12) -> list[ManifestRow]:
    """A finished sweep."""
    for row in rows:
        score = scores_of(row)
        logged: list[tuple[int, dict[str, float]]] = []
        for i in range(points):
            logged.append((10 * i, {"eval/greedy/utility_esr": score + i, "eval/greedy/return/jerk": -float(i)}))
            logged.append((10 * i + 5, {"train/utility": score * i, "loss/policy": 0.5}))
        log(sweep, row, logged)
        numbers = {"utility_esr": score, "success": 0.5, "end/collision": -score}
        end(sweep, row, {"greedy": numbers, "stochastic": {**numbers, "utility_esr": -score}})
    write_manifest(sweep, rows)
    return list(rows)


@pytest.fixture(scope="module")
def base() -> dict[str, Any]:
    return config_of("one_waypoint/mo_a2c_linear")


@pytest.fixture
def grid(base: dict[str, Any]) -> list[ManifestRow]:
    """Six cells of three seeds."""
    rates, steps = (1e-4, 1e-3, 1e-2), (16, 32)
    cells = [{"algorithm.learning_rate": rate, "algorithm.steps": step} for rate, step in product(rates, steps)]
    return [make_row(base, cell, seed) for cell in cells for seed in range(3)]


def parts(sweep: Path) -> dict[str, int]:
    """The parts of the metrics and when they were written."""
    return {path.name: path.stat().st_mtime_ns for path in sorted((sweep / "collected/metrics").glob("*.parquet"))}


def table(*arguments: Path | str) -> int:
    return table_script.main([str(argument) for argument in arguments])


# -------------------------------------------------------------------------------------------------------------- content


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
    files[4].write_text("")
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
    collection = collect(tmp_path / "a [sweep] *")
    with pytest.raises(ValueError, match="has any metrics yet"):
        collection.metrics.collect()
    assert collection.runs.select(pl.col("rows").sum()).collect().item() == 0
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


# -------------------------------------------------------------------------------------------------------------- ranking


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
    collection = collect(tmp_path)
    scores = collection.scores.collect()
    settings = rank(collection.cells, scores)
    names = [
        "mo-deepdrive-one-waypoint-v0, one_waypoint_linear",
        "mo-deepdrive-one-waypoint-v0, one_waypoint_nonlinear",
        "mo-deepdrive-one-waypoint-v0 fixed_destination=True",
    ]
    assert [(each.title, each.score_name) for each in settings] == list(
        zip(names, ["greedy utility", "greedy utility", "front hypervolume"], strict=True)
    )
    rates = [[cell.keys["algorithm.learning_rate"] for cell in each.ranked] for each in settings]
    assert rates == [[1e-2, 1e-3, 1e-4], [1e-2, 1e-3, 1e-4], [1e-4, 1e-3, 1e-2]]
    assert settings[0].score(settings[0].cells[0]) == pytest.approx(10.05)
    by_collisions = rank(collection.cells, scores, "end/collision")  # the fewer the better
    assert [len(each.ranked) for each in by_collisions] == [3, 3, 0]
    assert [cell.keys["algorithm.learning_rate"] for cell in by_collisions[0].ranked] == [1e-2, 1e-3, 1e-4]
    assert rank(collection.cells, scores, "front/igd_plus")[2].ranked[0].keys["algorithm.learning_rate"] == 1e-2
    with pytest.raises(ValueError, match=r"'greedy/sucess' is not a metric .* did you mean 'greedy/success'"):
        rank(collection.cells, scores, "greedy/sucess")


def test_utilities_are_summed_over_vehicles(tmp_path: Path) -> None:
    base = config_of("intersection/mo_a2c_linear")
    rows = [make_row(base, {"algorithm.steps": steps}, 0) for steps in (8, 16)]
    make_sweep(tmp_path, rows)
    for row, (first, second) in zip(rows, ((1.0, 5.0), (3.0, 2.0)), strict=True):
        numbers = {"success": 0.5, "vehicle_0/utility_esr": first, "vehicle_1/utility_esr": second}
        end(tmp_path, row, {"greedy": numbers})
    collection = collect(tmp_path)
    (both,) = rank(collection.cells, collection.scores.collect())
    assert both.score_name == "greedy total utility"
    assert [both.score(cell) for cell in both.cells] == [6.0, 5.0]
    (one,) = rank(collection.cells, collection.scores.collect(), "greedy/vehicle_0/utility_esr")
    assert [one.score(cell) for cell in one.cells] == [3.0, 1.0]


def test_rankings_with_equal_titles_also_show_their_keys(tmp_path: Path, base: dict[str, Any]) -> None:
    cells = [{"evaluation.gamma": gamma, "algorithm.steps": steps} for gamma in (0.9, 1.0) for steps in (8, 16)]
    make_sweep(tmp_path, [make_row(base, cell, 0) for cell in cells])
    collection = collect(tmp_path)
    titles = [ranking.title for ranking in rank(collection.cells, collection.scores.collect())]
    assert [title.rpartition(" (")[2] for title in titles] == ["evaluation.gamma=0.9)", "evaluation.gamma=1.0)"]


def test_cells_have_short_names(base: dict[str, Any], tmp_path: Path) -> None:
    utilities = [{"name": "a", "arguments": {"x": x}} for x in (1, 2)]
    assert value_labels([utilities[0], utilities[0]]) == ["a", "a"]
    assert value_labels(utilities)[0] == '{"arguments": {"x": 1}, "name": "a"}'
    cells = [{"config": "c", "algorithm.steps": steps, "training.num_envs": 4} for steps in (8, 16)]
    make_sweep(tmp_path, [make_row(base, cell, 0) for cell in cells])
    found = collect(tmp_path).cells
    assert varying_keys(cells) == ["algorithm.steps"]
    assert cell_labels(found, ["config", "algorithm.steps"]) == ["c, steps 8", "c, steps 16"]
    assert cell_labels(found[:1], []) == ["mo_a2c"]


# -------------------------------------------------------------------------------------------------------------- scripts


def test_the_table_shows_the_best_cells_and_the_csv_has_all(
    tmp_path: Path, grid: list[ManifestRow], capsys: pytest.CaptureFixture[str]
) -> None:
    rows = make_sweep(tmp_path, grid)
    shutil.rmtree(tmp_path / rows[-1].directory)
    output = tmp_path / "scores.csv"
    assert table(tmp_path, "--top", "2", "--output", output) == 0
    shown = capsys.readouterr()
    assert shown.err.count("\n") == 1
    assert "1 of 18 runs have no final evaluation (1 waiting)" in shown.err
    assert "2 of 6 cells, by greedy utility" in shown.out
    lines = [line.split("│")[1:4] for line in shown.out.splitlines() if line.startswith("│")]
    assert [[cell.strip() for cell in line] for line in lines] == [["0.01", "16", "3"], ["0.01", "32", "2 of 3"]]
    table_rows = list(csv.reader(output.read_text().splitlines()))
    header, *cells = table_rows[: table_rows.index([])]
    assert header[:4] == ["algorithm.learning_rate", "algorithm.steps", "policy", "seeds"]
    assert len(cells) == 12
    assert cells[0][:4] == ["0.01", "16", "greedy", "3"]
    utility = cells[0][header.index("utility_esr")]
    assert float(utility.split()[0]) == pytest.approx(10.1)
    assert utility == f"10.10 [{10.0:.2f}, {10.2:.2f}]"
    assert cells[-1][:4] == ["0.0001", "32", "stochastic", "3"]
    assert table(tmp_path, "--sort", "stochastic/utility_esr", "--output", output) == 0
    assert next(csv.reader(output.read_text().splitlines()[1:]))[0] == "0.0001"
    assert table(tmp_path, "--sort", "greedy/utlity_esr") == 2
    assert "did you mean 'greedy/utility_esr'" in capsys.readouterr().err


def test_the_table_of_a_search_shows_its_trials(tmp_path: Path, base: dict[str, Any]) -> None:
    points = [{"algorithm.learning_rate": rate} for rate in (0.0012345678, 0.0078)]
    make_sweep(tmp_path, [make_row(base, point, seed, trial) for trial, point in enumerate(points) for seed in (0, 1)])
    output = tmp_path / "scores.csv"
    assert table(tmp_path, "--output", output) == 0
    found = list(csv.reader(output.read_text().splitlines()))
    assert found[0][:3] == ["trial", "algorithm.learning_rate", "policy"]
    assert [row[:2] for row in found[1:4:2]] == [["1", "0.0078"], ["0", "0.0012345678"]]


def test_algorithms_are_compared_in_cells_that_differ_in_nothing_else(tmp_path: Path, base: dict[str, Any]) -> None:
    bases = {"a": base, "b": config_of("one_waypoint/a2c_linear"), "c": config_of("one_waypoint/a2c_nonlinear")}
    cells = [{"config": name, "algorithm.steps": steps} for name in bases for steps in (8, 16)]
    make_sweep(tmp_path, [make_row(bases[cell["config"]], cell, seed) for cell in cells for seed in range(3)])
    output = tmp_path / "scores.csv"
    assert table(tmp_path, "--output", output) == 0
    found = list(csv.reader(output.read_text().splitlines()))
    compared = found[found.index([]) + 1 :]
    assert compared[0][:4] == ["algorithm.steps", "policy", "difference", "of"]
    assert [row[:3] for row in compared[1:]] == [[steps, "greedy", "mo_a2c - a2c"] for steps in ("8", "16")]


def test_figures_of_a_sweep(tmp_path: Path, base: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    bases = {"linear": base, "nonlinear": config_of("one_waypoint/mo_a2c_nonlinear")}
    cells: list[dict[str, Any]] = [
        {"config": name, "algorithm.learning_rate": rate, "algorithm.observe_discount": yes}
        for name, rate, yes in product(bases, (1e-4, 1e-3, 1e-2), (True, False))
    ]
    make_sweep(tmp_path, [make_row(bases[cell["config"]], cell, seed) for cell in cells for seed in (0, 1)])
    output = tmp_path / "curves.png"
    assert plot_script.main([str(tmp_path), "--output", str(output)]) == 0
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


def test_an_unfinished_sweep_is_plotted_by_its_last_evaluations(
    tmp_path: Path, grid: list[ManifestRow], capsys: pytest.CaptureFixture[str]
) -> None:
    rows = make_sweep(tmp_path, grid)
    for row in rows:
        end(tmp_path, row, {}, "running")
        (tmp_path / row.directory / "evaluation.json").unlink()
    when, scores = collect(tmp_path).latest_scores()
    assert when == "last"
    found = scores.filter(run=rows[3].id, policy="greedy", vehicle="", metric="utility_esr")["value"].to_list()
    assert found == [scores_of(rows[3]) + 11.0]
    assert plot_script.main([str(tmp_path), "--output", str(tmp_path / "a.png")]) == 0
    assert "learning_rate 0.01, steps 16: 3 seeds" in capsys.readouterr().out
    assert plot_script.main([str(tmp_path), "--output", str(tmp_path / "a.xyz")]) == 2
    assert "xyz" in capsys.readouterr().err
    assert table(tmp_path) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("error: no run of sweep")
    assert "has a final evaluation yet" in error


def test_a_directory_without_runs_is_refused(
    tmp_path: Path, grid: list[ManifestRow], capsys: pytest.CaptureFixture[str]
) -> None:
    def errors(*arguments: Path | str) -> list[str]:
        assert plot_script.main([str(argument) for argument in arguments]) == 2
        assert table(*arguments) == 2
        lines = capsys.readouterr().err.splitlines()
        return [line for line in lines if line.startswith("error: ")]

    assert all("nor" in error and "manifest.jsonl" in error for error in errors(tmp_path))
    write_manifest(tmp_path, [])
    assert all("is empty" in error and "scripts/sweep.py" in error for error in errors(tmp_path))
    write_manifest(tmp_path, grid)
    curves, scores = errors(tmp_path)
    assert "has any metrics yet: scripts/sweep.py" in curves
    assert "has a final evaluation yet" in scores
    log(tmp_path, grid[0], [(0, {"train/utility": 1.0})])
    assert "to draw" in errors(tmp_path)[0]
    assert all("give one sweep, or else runs" in error for error in errors(tmp_path, "runs"))
    assert table(tmp_path, "--top", "0") == 2
    assert "--top 0 must be at least 1" in capsys.readouterr().err
