"""``scripts/benchmark.py --against``: pairs of measurements of two trees."""

from __future__ import annotations

import csv
import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tests.helpers.paths import REPOSITORY
from tests.helpers.script_runs import Call, refused

IN_A_REPOSITORY = subprocess.run(["git", "rev-parse", "HEAD"], cwd=REPOSITORY, capture_output=True, check=False)
needs_git = pytest.mark.skipif(IN_A_REPOSITORY.returncode != 0, reason="not a Git repository")


@pytest.fixture
def benchmark(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("benchmark")


def test_a_row_has_medians_and_the_median_of_the_ratios(benchmark: ModuleType) -> None:
    row = benchmark.comparison("make", [100.0, 200.0, 100.0], [300.0, 300.0, 200.0])
    assert (row["old"], row["new"], row["speedup"], row["pairs"]) == (100.0, 300.0, 2.0, 3)
    assert (row["low"], row["high"]) == (None, None), "three pairs say too little"


def test_fewer_seconds_are_a_speedup(benchmark: ModuleType) -> None:
    row = benchmark.comparison("import", [1.0, 2.0], [0.5, 1.0])
    assert (row["unit"], row["old"], row["new"], row["speedup"]) == ("s", 1.5, 0.75, 2.0)


@pytest.mark.parametrize(("count", "low", "high"), [(5, None, None), (6, 1, 6), (10, 2, 9), (20, 6, 15)])
def test_the_interval_is_between_order_statistics(
    benchmark: ModuleType, count: int, low: int | None, high: int | None
) -> None:
    ratios = np.random.default_rng(0).permutation(np.arange(1.0, count + 1.0))
    row = benchmark.comparison("make", [1.0] * count, list(ratios))
    assert (row["low"], row["high"]) == (low, high)


def test_places_alternate_and_the_first_round_is_not_counted(benchmark: ModuleType) -> None:
    calls = []

    def measure(place: object, name: str) -> float:
        calls.append((place, name))
        return float(len(calls))

    old, new = benchmark.Place(tree=Path("old")), benchmark.Place(tree=Path("new"))
    rows = benchmark.compare(old, new, ["make", "import"], 2, measure)
    first, swapped = [old, new, old, new], [new, old, new, old]
    assert [place for place, _ in calls] == swapped + first + swapped
    assert [name for _, name in calls] == ["make", "make", "import", "import"] * 3
    assert [(row["measurement"], row["pairs"], row["old"], row["new"]) for row in rows] == [
        ("make", 2, (5 + 10) / 2, (6 + 9) / 2),
        ("import", 2, (7 + 12) / 2, (8 + 11) / 2),
    ]


@needs_git
@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--against", "no-such-commit"], "'no-such-commit' is not a commit of"),
        (["--against", "HEAD", "--only", "mak"], "'mak' matches no measurement; known: a2c-64-32-discrete"),
        (["--against", "HEAD", "--pairs", "0"], "--pairs 0 must be at least 1"),
        (["--only", "make"], "--only and --pairs are for --against COMMIT, --threads COUNT and --device D"),
        (["--against", "HEAD", "--threads", "2"], "make one at a time"),
        (["--device", "abacus"], "--device = 'abacus' is not a valid device"),
        (["--device", "cuda:99"], "'cuda:99' does not exist"),
        (["--threads", "1"], "--threads 1 must be from 2 to "),
        (["--against", "HEAD", "--output", "no/pairs.csv"], "/no' is not a directory"),
    ],
)
@pytest.mark.usefixtures("benchmark")
def test_what_cannot_be_compared_is_refused(call: Call, options: list[str], message: str) -> None:
    refused(call("benchmark", *options), message)


@pytest.mark.processes
@needs_git
@pytest.mark.slow
def test_the_head_is_compared_with_the_working_tree(benchmark: ModuleType, call: Call, tmp_path: Path) -> None:
    code, out, error = call(
        "benchmark", "--against", "HEAD", "--pairs", "1", "--only", "import", "--output", "pairs.csv"
    )
    assert code in (0, None), error
    assert "import" in out
    with (tmp_path / "pairs.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert (row["measurement"], row["unit"], row["pairs"], row["threads"]) == ("import", "s", "1", "1")
    assert float(row["speedup"]) == pytest.approx(float(row["old"]) / float(row["new"]), rel=1e-4)
    assert 0.01 < float(row["new"]) < 60.0
    assert row["old_commit"] == benchmark.revision("HEAD")
    assert row["new_commit"].removesuffix("-dirty") == row["old_commit"]


@pytest.mark.processes
@pytest.mark.slow
@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="needs two cores")
def test_training_on_two_threads_is_compared_with_one(benchmark: ModuleType, call: Call, tmp_path: Path) -> None:
    options = "--pairs", "1", "--only", "a2c-64-32-discrete", "--output", "threads.csv"
    code, out, error = call("benchmark", "--threads", "2", *options)
    assert code in (0, None), error
    assert "threads 2" in out
    with (tmp_path / "threads.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    found = [row[name] for name in ("measurement", "unit", "pairs", "threads", "device")]
    assert found == ["a2c-64-32-discrete", "steps/s", "1", "2", "cpu"]
    assert float(row["speedup"]) == pytest.approx(float(row["new"]) / float(row["old"]), rel=1e-4)
    assert row["commit"] == benchmark.working_tree()


@pytest.mark.slow
def test_packages_of_the_given_tree_are_measured_and_what_it_cannot_do_is_a_problem(
    benchmark: ModuleType, tmp_path: Path
) -> None:
    (tmp_path / "mo_deepdrive").mkdir()
    (tmp_path / "mo_deepdrive" / "__init__.py").write_text("raise RuntimeError('this tree')")
    old, new = benchmark.Place(tree=tmp_path), benchmark.Place(tree=REPOSITORY)
    (row,) = benchmark.compare(old, new, ["import"], 1)
    assert row["pairs"] == 0
    assert row["problem"].startswith("the old side cannot run it: ")
    assert row["problem"].endswith("RuntimeError: this tree")
