"""Fronts: fronts.csv is continued by a resumed run, and the report of a front fits the terminal."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from algorithms.reporting.fronts import FrontsFile, front_table
from mo_deepdrive.evaluation.front import Front
from mo_deepdrive.evaluation.statistics import Estimate
from tests.helpers.fronts import front_of


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


@pytest.mark.parametrize("width", [80, 100])
def test_a_front_with_many_objectives_fits_the_terminal(width: int) -> None:
    names = ("distance", "destination", "g_force", "collision", "jerk", "lane_violation")
    front = front_of([[-1234.5 + i, 1.0, -5.25, -0.5, 100.0 * i, 3.0] for i in range(9)], names)
    front = replace(front, low=front.low - 12.5, high=front.high + 12.5, episodes=1000)
    console = Console(width=width, record=True)
    console.print(front_table(front, {"hypervolume": 12.5}, "pcn on an environment", width))
    lines = console.export_text().splitlines()
    assert max(map(len, lines)) <= width
    headers = [line.split() for line in lines if line.strip().startswith("policy")]
    assert [name for header in headers for name in header[1:]] == [*names, "decisions"]
    assert not any("…" in line for line in lines)
    first = Estimate(*(float(array[0, 0]) for array in (front.returns, front.low, front.high)))
    assert sum(first.text() in line for line in lines) == 1


def test_the_title_says_how_many_policies_are_shown_and_where_all_are() -> None:
    def title(policies: int, *whole: str) -> str:
        console = Console(width=200, record=True)
        front = front_of([[float(i), -float(i)] for i in range(policies)], ("distance", "jerk"))
        console.print(front_table(front, {}, "pcn on roads", 200, *whole))
        return console.export_text().splitlines()[0]

    assert title(12, "elsewhere").startswith("pcn on roads: 12 policies; undiscounted returns, 3 episodes each")
    shown = "pcn on roads: 12 of 91 policies, which cover the front"
    assert title(91, "all are in run/front.csv").startswith(f"{shown} (all are in run/front.csv); undiscounted")
