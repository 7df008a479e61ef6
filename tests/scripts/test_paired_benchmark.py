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

OLD, NEW = Path("old"), Path("new")
IN_A_REPOSITORY = subprocess.run(["git", "rev-parse", "HEAD"], cwd=REPOSITORY, capture_output=True, check=False)
needs_git = pytest.mark.skipif(IN_A_REPOSITORY.returncode != 0, reason="not a Git repository")


@pytest.fixture
def paired(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """The script as a module."""
    return load_script("paired_benchmark")


def test_a_row_has_medians_and_the_median_of_the_ratios(paired: ModuleType) -> None:
    old, new = [100.0, 200.0, 100.0], [300.0, 300.0, 200.0]
    row = paired.Pairs("make", old, new).row()
    assert (row.old, row.new, row.speedup, row.pairs) == (100.0, 300.0, 2.0, 3)
    assert (row.low, row.high) == (None, None), "three pairs say too little"
    assert row.cells() == ["make", "100.00", "300.00", "steps/s", "2.000"]


def test_the_environment_is_as_before_after_processes_of_one_thread(
    paired: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(paired, "ONE_THREAD", {"MO_DEEPDRIVE_SET": "1", "MO_DEEPDRIVE_NOT_SET": "1"})
    monkeypatch.setenv("MO_DEEPDRIVE_SET", "4")
    with paired.one_thread_each():
        assert os.environ["MO_DEEPDRIVE_SET"] == os.environ["MO_DEEPDRIVE_NOT_SET"] == "1"
    assert os.environ["MO_DEEPDRIVE_SET"] == "4"
    assert "MO_DEEPDRIVE_NOT_SET" not in os.environ


def test_fewer_seconds_are_a_speedup(paired: ModuleType) -> None:
    row = paired.Pairs("import", [1.0, 2.0], [0.5, 1.0]).row()
    assert (row.unit, row.old, row.new, row.speedup) == ("s", 1.5, 0.75, 2.0)


@pytest.mark.parametrize(("count", "low", "high"), [(6, 1, 6), (10, 2, 9), (20, 6, 15)])
def test_the_interval_is_between_order_statistics(paired: ModuleType, count: int, low: int, high: int) -> None:
    ratios = np.random.default_rng(0).permutation(np.arange(1.0, count + 1.0))
    assert paired.median_interval(ratios) == (low, high)
    row = paired.Pairs("make", [1.0] * count, list(ratios)).row()
    assert row.cells()[-1] == f"{(count + 1) / 2:.3f} [{low:.3f}, {high:.3f}]"


def test_five_pairs_have_no_interval(paired: ModuleType) -> None:
    assert paired.median_interval([1.0, 2.0, 3.0, 4.0, 5.0]) == (None, None)


def test_trees_alternate_and_the_first_round_is_not_counted(paired: ModuleType) -> None:
    calls = []

    def measure(tree: Path, name: str) -> float:
        calls.append((tree, name))
        return float(len(calls))

    rows = paired.compare(OLD, NEW, ["make", "import"], 2, measure)
    first, swapped = [OLD, NEW, OLD, NEW], [NEW, OLD, NEW, OLD]
    assert [tree for tree, _ in calls] == swapped + first + swapped
    assert [name for _, name in calls] == ["make", "make", "import", "import"] * 3
    assert [(row.measurement, row.pairs, row.old, row.new) for row in rows] == [
        ("make", 2, (5 + 10) / 2, (6 + 9) / 2),
        ("import", 2, (7 + 12) / 2, (8 + 11) / 2),
    ]


def test_what_a_tree_cannot_run_is_said_once(paired: ModuleType) -> None:
    calls = []

    def measure(tree: Path, name: str) -> float:
        calls.append(name)
        if tree == OLD and name == "import":
            raise paired.CannotMeasureError("No module named 'x'")
        return 1.0

    rows = paired.compare(OLD, NEW, ["make", "import"], 3, measure)
    assert [row.problem for row in rows] == ["", "the old side cannot run it: No module named 'x'"]
    assert [row.pairs for row in rows] == [3, 0]
    assert rows[1].cells() == ["import", "", "", "s", "the old side cannot run it: No module named 'x'"]
    assert calls.count("import") == 2, "not again in later pairs"


def test_the_file_has_a_row_per_measurement(
    paired: ModuleType, load_script: Callable[[str], ModuleType], tmp_path: Path
) -> None:
    rows = [paired.Pairs("make", [1.0] * 6, [1.5] * 6).row(), paired.Pairs("import", problem="no").row()]
    about = {"old_commit": "a", "machine": "b, 2 CPUs", "threads": 1}
    load_script("result_file").write_results(tmp_path / "pairs.csv", rows, about)
    with (tmp_path / "pairs.csv").open(newline="") as file:
        read = list(csv.DictReader(file))
    assert [row["measurement"] for row in read] == ["make", "import"]
    assert {name: read[0][name] for name in ("speedup", "low", "high", "pairs")} == {
        "speedup": "1.5",
        "low": "1.5",
        "high": "1.5",
        "pairs": "6",
    }
    assert (read[1]["speedup"], read[1]["problem"], read[1]["machine"]) == ("", "no", "b, 2 CPUs")


def test_names_are_selected_by_patterns(paired: ModuleType) -> None:
    assert paired.select([]) == list(paired.CASES)
    assert paired.select(["make_vec*", "import"]) == [
        "make_vec-one-waypoint",
        "make_vec-static-obstacle",
        "make_vec-intersection",
        "make_vec-left-turn",
        "make_vec-roundabout-8",
        "import",
    ]
    with pytest.raises(ValueError, match="'imports' matches no measurement"):
        paired.select(["make", "imports"])


def test_every_algorithm_is_measured(paired: ModuleType) -> None:
    for algorithm in ("a2c", "mo_a2c", "ppo", "mo_ppo"):
        for rest in ("64-32-discrete", "64-32-continuous", "128-64-discrete", "128-64-continuous"):
            assert f"{algorithm}-{rest}" in paired.CASES
    assert {"two-a2c-128-64", "two-mo_ppo-128-64", "pcn-collection", "pcn", "make"} <= set(paired.CASES)


@needs_git
@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--against", "no-such-commit"], "'no-such-commit' is not a commit of"),
        (["--against", "HEAD:README.md"], "'HEAD:README.md' is not a commit of"),
        (["--against", "HEAD", "--only", "mak"], "'mak' matches no measurement; known: a2c-64-32-discrete"),
        (["--against", "HEAD", "--pairs", "0"], "--pairs 0 must be at least 1"),
        (["--only", "make"], "--only and --pairs are for --against COMMIT, --threads COUNT and --device D"),
        (["--against", "HEAD", "--threads", "2"], "make one at a time"),
        (["--device", "cuda", "--threads", "2"], "make one at a time"),
        (["--device", "abacus"], "--device = 'abacus' is not a valid device"),
        (["--device", "cuda:99"], "'cuda:99' does not exist"),
        (["--device", "cuda:99", "--only", "make"], "'make' matches no measurement; known: a2c-64-32-discrete"),
        (["--threads", "1"], "--threads 1 must be from 2 to "),
        (["--threads", "2", "--only", "make"], "'make' matches no measurement; known: a2c-64-32-discrete"),
        (["--against", "HEAD", "--output", "no/pairs.csv"], "there is no folder no"),
    ],
)
@pytest.mark.usefixtures("paired")
def test_what_cannot_be_compared_is_refused(call: Call, options: list[str], message: str) -> None:
    refused(call("benchmark", *options), message)


@pytest.mark.processes
@needs_git
@pytest.mark.slow
def test_the_head_is_compared_with_the_working_tree(paired: ModuleType, call: Call, tmp_path: Path) -> None:
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
    assert row["old_commit"] == paired.revision("HEAD")
    assert row["new_commit"].removesuffix("-dirty") == row["old_commit"]


@pytest.mark.processes
@pytest.mark.slow
@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="needs two cores")
def test_training_on_two_threads_is_compared_with_one(paired: ModuleType, call: Call, tmp_path: Path) -> None:
    options = "--pairs", "1", "--only", "a2c-64-32-discrete", "--output", "threads.csv"
    code, out, error = call("benchmark", "--threads", "2", *options)
    assert code in (0, None), error
    assert "2 threads" in out
    with (tmp_path / "threads.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    found = [row[name] for name in ("measurement", "unit", "pairs", "threads", "device")]
    assert found == ["a2c-64-32-discrete", "steps/s", "1", "2", "cpu"]
    assert float(row["speedup"]) == pytest.approx(float(row["new"]) / float(row["old"]), rel=1e-4)
    assert row["commit"] == paired.working_tree()


@needs_git
@pytest.mark.slow
def test_packages_of_the_given_tree_are_measured(paired: ModuleType) -> None:
    with paired.checkout("HEAD") as tree:
        (tree / "mo_deepdrive" / "__init__.py").write_text("raise RuntimeError('this tree')")
        with pytest.raises(paired.CannotMeasureError, match="RuntimeError: this tree"):
            paired.measure(tree, "import")
    assert not tree.exists()


@pytest.mark.slow
def test_modules_of_another_tree_are_an_error(paired: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    case = paired.Case(lambda: 1.0)
    monkeypatch.setitem(paired.CASES, "make", case)
    paired.main("make", REPOSITORY)
    with pytest.raises(ImportError, match=r"elsewhere has no module (algorithms|mo_deepdrive)"):
        paired.main("make", Path("elsewhere"))
