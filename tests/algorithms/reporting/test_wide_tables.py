"""Tables on a terminal of 100 columns: nothing is cut off, whatever there is to show."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from algorithms.reporting.tables import print_rows, split_columns

LABELS = ("algorithm", "policy", "vehicle", "seeds")
METRICS = tuple(f"return/objective_{i}" for i in range(9))
ROWS = [
    [*LABELS, *METRICS],
    *(
        [algorithm, "greedy", f"vehicle_{v}", "0 1 2 3 4", *(f"-{v}{i}.25 [-{v}{i}.50, -{v}{i}.00]" for i in range(9))]
        for algorithm in ("a2c", "mo_ppo")
        for v in range(2)
    ),
]


def printed(rows: list[list[str]], labels: int, width: int, rest: str | None = None) -> list[str]:
    console = Console(width=width, file=io.StringIO())
    print_rows(console, rows, "a title", labels, rest=rest)
    return console.file.getvalue().splitlines()  # type: ignore[attr-defined]


def test_a_table_that_fits_stays_one_table() -> None:
    assert split_columns(ROWS, 4, 1000) == ([ROWS], 4)
    lines = printed([row[:5] for row in ROWS], 4, 100)
    assert lines[0] == "a title"
    assert lines[2].split() == [*LABELS, METRICS[0]]
    assert len(lines) == 9


def test_columns_that_do_not_fit_follow_in_further_tables_with_the_same_labels() -> None:
    parts, labels = split_columns(ROWS, 4, 100)
    assert labels == 4
    assert len(parts) > 1
    assert [name for part in parts for name in part[0][4:]] == list(METRICS)
    assert all([row[:4] for row in part] == [row[:4] for row in ROWS] for part in parts)
    lines = printed(ROWS, 4, 100)
    for name in METRICS:
        assert sum(name in line for line in lines) == 1
    for row in ROWS[1:]:
        assert all(any(cell in line and row[0] in line and row[2] in line for line in lines) for cell in row[4:])


@pytest.mark.parametrize("width", [60, 80, 100, 120])
def test_nothing_is_cut_off_however_many_keys_a_cell_has(width: int) -> None:
    keys = [f"learning_rate_of_the_{i}th_network" for i in range(8)]
    rows = [[*keys, *METRICS], *([f"0.000{r}{i}" for i in range(8)] + ROWS[1][4:] for r in range(3))]
    parts, labels = split_columns(rows, 8, width)
    assert labels == 1
    assert parts[0][1][0] == ", ".join(f"{name}={value}" for name, value in zip(keys, rows[1], strict=False))
    lines = printed(rows, 8, width)
    assert max(map(len, lines)) <= width
    assert not any("…" in line for line in lines)
    text = "".join(line.split("  ")[1].strip() if line.startswith("  ") else "" for line in lines)
    assert "".join(parts[0][1][0].split()) in "".join(text.split())
    assert all(any(cell in line for line in lines) for cell in ROWS[1][4:])


def test_with_another_place_for_all_columns_the_rest_is_named() -> None:
    lines = printed(ROWS, 4, 100, "--output FILE.csv writes every column")
    shown = [name for name in METRICS if name in lines[2]]
    note = " ".join(" ".join(lines).split())
    assert 0 < len(shown) < len(METRICS)
    assert f"not shown: {', '.join(METRICS[len(shown) :])}; --output FILE.csv writes every column" in note
    assert "not shown" not in "".join(printed(ROWS, 4, 1000, "--output FILE.csv"))


def test_labels_that_all_rows_share_move_to_the_title_and_rows_without_values_are_left_out() -> None:
    rows = [ROWS[0], *ROWS[1:], ["ppo", "greedy", "", "0 1 2 3 4", "", "", *ROWS[1][6:]]]
    lines = printed(rows, 4, 100)
    assert lines[0] == "a title, policy greedy, seeds 0 1 2 3 4"
    assert lines[2].split() == ["algorithm", "vehicle", *METRICS[:2]]
    assert [sum(line.strip().startswith(name) for line in lines) for name in ("ppo", "a2c")] == [4, 10]
    (only,) = [line for line in printed(rows[:2], 4, 60) if METRICS[8] in line]
    assert only.split() == [METRICS[8]]  # one row shares all its labels
