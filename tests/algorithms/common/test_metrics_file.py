"""The CSV files of metrics and fronts: nothing is lost or duplicated by a crash and a resumed run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from algorithms.common.metrics_file import FrontsFile, MetricsFile, read_metrics
from algorithms.evaluation.front import Front

if TYPE_CHECKING:
    from pathlib import Path


def test_metrics_are_read_back_to_the_last_bit(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    file = MetricsFile(path)
    file.write(0, {"a": 1 / 3})
    file.write(10, {"a": 2, "b/c": np.float32(0.1)})
    file.write(10, {"b/c": float("nan")})
    columns = read_metrics(path)
    np.testing.assert_array_equal(columns["step"], [0, 10, 10])
    np.testing.assert_array_equal(columns["a"], [1 / 3, 2, np.nan])
    np.testing.assert_array_equal(columns["b/c"], [np.nan, np.float32(0.1), np.nan])


def test_metrics_are_continued_after_a_step(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    file = MetricsFile(path)
    for step in (0, 10, 20):
        file.write(step, {"a": step})
    MetricsFile(path, after=10).write(20, {"a": -20, "b": 1})
    np.testing.assert_array_equal(read_metrics(path)["a"], [0, 10, -20])
    MetricsFile(path)
    assert path.read_text() == "step\n"


def test_a_torn_last_row_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_text("step,a,b\n0,1.0,2.0\n10,1.0,2.")
    np.testing.assert_array_equal(read_metrics(path)["step"], [0])


@pytest.mark.parametrize(("text", "message"), [("a,b\n1,2\n", "no column 'step'"), ("step,a\n0,x\n", "is broken")])
def test_files_that_hold_no_metrics_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "metrics.csv"
    with pytest.raises(ValueError, match="does not exist"):
        read_metrics(path)
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_metrics(path)


def make_front(k: int, seed: int) -> Front:
    returns = np.random.default_rng(seed).normal(size=(k, 1, 2))
    return Front.of_episodes(("a", "b"), 2.0 * returns, returns / 3.0, np.ones((k, 1)), None, gamma=0.9, seed=0)


def rows_of(path: Path) -> list[tuple[int, int, float, float]]:
    header, *lines = path.read_text().splitlines()
    assert header == "step,policy,discounted_return/a,discounted_return/b"
    cells = [line.split(",") for line in lines]
    return [(int(step), int(policy), float(first), float(second)) for step, policy, first, second in cells]


def expected_rows(*fronts: tuple[int, Front]) -> list[tuple[int, int, float, float]]:
    return [(step, k, *row) for step, front in fronts for k, row in enumerate(front.discounted.tolist())]


FRONTS = [(0, make_front(1, 0)), (10, make_front(3, 1)), (20, make_front(2, 2)), (30, make_front(4, 3))]


def test_every_front_is_stored_to_the_last_bit_with_a_row_per_policy(tmp_path: Path) -> None:
    path = tmp_path / "fronts.csv"
    file = FrontsFile(path)
    for number, (step, front) in enumerate(FRONTS):
        file.write(step, front)
        assert rows_of(path) == expected_rows(*FRONTS[: number + 1])


def test_a_resumed_run_writes_fronts_after_the_checkpoint_again(tmp_path: Path) -> None:
    path = tmp_path / "fronts.csv"
    file = FrontsFile(path)
    for step, front in FRONTS:
        file.write(step, front)
    again = FrontsFile(path, after=10)
    assert rows_of(path) == expected_rows(*FRONTS[:2])
    other = make_front(2, 9)
    again.write(20, other)
    assert rows_of(path) == expected_rows(*FRONTS[:2], (20, other))


@pytest.mark.parametrize("torn", ["30,0,0.5", "30", "30,0,0.5,0.", "30,0,0.5\n"])
def test_a_torn_row_of_a_front_is_dropped(tmp_path: Path, torn: str) -> None:
    path = tmp_path / "fronts.csv"
    file = FrontsFile(path)
    for step, front in FRONTS[:3]:
        file.write(step, front)
    with path.open("a") as rest:
        rest.write(torn)
    FrontsFile(path, after=30).write(*FRONTS[3])
    assert rows_of(path) == expected_rows(*FRONTS)


@pytest.mark.parametrize("content", [None, "", "step,pol", "step,policy,discounted_return/a,discounted_return/b\n"])
def test_a_run_resumes_where_no_front_was_written_yet(tmp_path: Path, content: str | None) -> None:
    path = tmp_path / "fronts.csv"
    if content is not None:
        path.write_text(content)
    file = FrontsFile(path, after=10)
    for step, front in FRONTS[1:]:
        file.write(step, front)
    assert rows_of(path) == expected_rows(*FRONTS[1:])


@pytest.mark.parametrize("after", [None, -1])
def test_a_run_without_checkpoint_starts_its_fronts_again(tmp_path: Path, after: int | None) -> None:
    path = tmp_path / "fronts.csv"
    FrontsFile(path).write(*FRONTS[0])
    FrontsFile(path, after=after).write(*FRONTS[3])
    assert rows_of(path) == expected_rows(FRONTS[3])
