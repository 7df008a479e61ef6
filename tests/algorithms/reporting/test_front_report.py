"""The report of a front on a terminal."""

from __future__ import annotations

from dataclasses import replace

import pytest
from rich.console import Console

from algorithms.reporting.fronts import front_table
from mo_deepdrive.evaluation.statistics import Estimate
from tests.helpers.fronts import front_of


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
    assert title(91).startswith(f"{shown}; undiscounted")
