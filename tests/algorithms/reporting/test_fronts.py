"""fronts.csv: fronts are appended, and a resumed run writes later ones again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from algorithms.reporting.fronts import FrontsFile
from mo_deepdrive.evaluation.front import Front


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
        file.write_front(step, front)
        assert rows_of(path) == expected_rows(*FRONTS[: number + 1])


def test_a_resumed_run_writes_fronts_after_the_checkpoint_again(tmp_path: Path) -> None:
    path = tmp_path / "fronts.csv"
    file = FrontsFile(path)
    for step, front in FRONTS:
        file.write_front(step, front)
    again = FrontsFile(path, after=10)
    assert rows_of(path) == expected_rows(*FRONTS[:2])
    other = make_front(2, 9)
    again.write_front(20, other)
    assert rows_of(path) == expected_rows(*FRONTS[:2], (20, other))


@pytest.mark.parametrize("torn", ["30,0,0.5", "30", "30,0,0.5,0.", "30,0,0.5\n"])
def test_a_torn_row_of_a_front_is_dropped(tmp_path: Path, torn: str) -> None:
    path = tmp_path / "fronts.csv"
    file = FrontsFile(path)
    for step, front in FRONTS[:3]:
        file.write_front(step, front)
    with path.open("a") as rest:
        rest.write(torn)
    FrontsFile(path, after=30).write_front(*FRONTS[3])
    assert rows_of(path) == expected_rows(*FRONTS)


@pytest.mark.parametrize("content", [None, "", "step,pol", "step,policy,discounted_return/a,discounted_return/b\n"])
def test_a_run_resumes_where_no_front_was_written_yet(tmp_path: Path, content: str | None) -> None:
    path = tmp_path / "fronts.csv"
    if content is not None:
        path.write_text(content)
    file = FrontsFile(path, after=10)
    for step, front in FRONTS[1:]:
        file.write_front(step, front)
    assert rows_of(path) == expected_rows(*FRONTS[1:])


@pytest.mark.parametrize("after", [None, -1])
def test_a_run_without_checkpoint_starts_its_fronts_again(tmp_path: Path, after: int | None) -> None:
    path = tmp_path / "fronts.csv"
    FrontsFile(path).write_front(*FRONTS[0])
    FrontsFile(path, after=after).write_front(*FRONTS[3])
    assert rows_of(path) == expected_rows(FRONTS[3])


def test_missing_rows_of_fronts_are_noticed(tmp_path: Path) -> None:
    path = tmp_path / "fronts.csv"
    file = FrontsFile(path)
    nothing = file.sync()
    assert FrontsFile(path, after=0, noted=nothing).gap is None
    for step, front in FRONTS[:3]:
        file.write_front(step, front)
    noted = file.sync()
    whole = path.read_text().splitlines(keepends=True)
    file.write_front(*FRONTS[3])
    assert FrontsFile(path, after=20, noted=noted).gap is None
    path.write_text("".join(whole[:3]))
    gap = "fronts.csv lacks 4 of 6 rows up to step 20 (it has rows of steps 0 to 10)"
    assert FrontsFile(path, after=20, noted=noted).gap == gap
    path.unlink()
    again = FrontsFile(path, after=20, noted=noted)
    assert again.gap == "fronts.csv lacks 6 of 6 rows up to step 20 (it has none)"
    again.write_front(*FRONTS[3])
    assert rows_of(path) == expected_rows(FRONTS[3])
