"""fronts.csv is continued by a resumed run."""

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


def test_fronts_are_stored_to_the_last_bit_and_a_resumed_run_writes_later_ones_again(tmp_path: Path) -> None:
    path = tmp_path / "fronts.csv"
    file = FrontsFile(path)
    for number, (step, front) in enumerate(FRONTS):
        file.write_front(step, front)
        assert rows_of(path) == expected_rows(*FRONTS[: number + 1])
    with path.open("a") as rest:
        rest.write("30,0,0.5")  # torn
    again = FrontsFile(path, after=10)
    assert rows_of(path) == expected_rows(*FRONTS[:2])
    again.write_front(20, make_front(2, 9))
    assert rows_of(path) == expected_rows(*FRONTS[:2], (20, make_front(2, 9)))


@pytest.mark.parametrize("content", [None, "", "step,pol", "step,policy,discounted_return/a,discounted_return/b\n"])
def test_a_run_resumes_where_no_front_was_written_yet(tmp_path: Path, content: str | None) -> None:
    path = tmp_path / "fronts.csv"
    if content is not None:
        path.write_text(content)
    file = FrontsFile(path, after=10)
    for step, front in FRONTS[1:]:
        file.write_front(step, front)
    assert rows_of(path) == expected_rows(*FRONTS[1:])
