"""The report and its tables."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from algorithms.studies.paper_plan import load_plan
from algorithms.studies.paper_report import print_verdicts, verdict_table, write_report
from algorithms.studies.paper_results import ReproductionResults
from tests.helpers.reproduction import PLAN, PUBLISHED, SOLVED, evenly_spread, make_results


def test_a_report_of_some_tasks_omits_the_others(tmp_path: Path) -> None:
    plan = load_plan(PLAN)
    results = make_results(
        "one_waypoint_linear",
        {
            "a2c": {**SOLVED, "end/collision": evenly_spread(0.0), "return/distance": evenly_spread(18.0)},
            "mo_a2c": {**SOLVED, "end/collision": evenly_spread(0.0), "return/distance": evenly_spread(18.0)},
        },
    )
    greedy = [{**row, "policy": "greedy"} for row in results.scores]
    paths = write_report(
        plan, ReproductionResults([*results.scores, *greedy], results.curves), tmp_path, [4, 5], how="a test"
    )
    text = (tmp_path / "reproduction.md").read_text()
    assert "## Claim 1" in text
    assert "## Claim 2" not in text
    assert paths == [tmp_path / "reproduction.md", tmp_path / "figure_04.png"]


def test_utilities_have_the_digits_that_the_wider_interval_supports() -> None:
    plan = load_plan(PLAN)
    scores = {each: {**SOLVED, "utility_esr_width": evenly_spread(2.0)} for each in ("a2c", "mo_a2c")}
    assert "| 10.0 [10.0, 10.0] |" in verdict_table(plan, make_results("one_waypoint_linear", scores))
    scores = dict.fromkeys(("a2c", "mo_a2c"), SOLVED)
    assert "| 10.000 [9.993, 10.008] |" in verdict_table(plan, make_results("one_waypoint_linear", scores))


def test_the_verdicts_fit_the_terminal() -> None:
    plan = load_plan(PLAN)
    scores = {each: {**SOLVED, "utility_esr_width": evenly_spread(2.0)} for each in ("a2c", "mo_a2c")}
    console = Console(width=100, record=True)
    print_verdicts(plan, make_results("one_waypoint_linear", scores), console)
    lines = console.export_text().splitlines()
    assert max(map(len, lines)) <= 100
    text = " ".join(" ".join(lines).split())
    assert text.startswith("1. OneWaypoint, linear utility: A2C and MO-A2C both solve it")
    assert "best effort 10.0 10.0 0.0 0.50 reproduced [10.0, 10.0] [10.0, 10.0]" in text


def test_collapsed_runs_of_pcn_are_counted(tmp_path: Path) -> None:
    plan = load_plan(PLAN)
    front = {
        "hypervolume": [3000.0, 20000.0, 25000.0, 26000.0, 27000.0],
        "cardinality": evenly_spread(60.0),
        "lowest_distance": evenly_spread(0.0),
        "highest_distance": evenly_spread(14.0),
    }
    write_report(plan, make_results("one_waypoint_front", {"pcn": front}, policy="front"), tmp_path, [], how="a test")
    assert "| 1 of 5 |" in (tmp_path / "reproduction.md").read_text()


def test_the_report_agrees_with_the_published_scores() -> None:
    plan, results = load_plan(PLAN), ReproductionResults.read(PUBLISHED)
    table = verdict_table(plan, results)
    assert table in (PUBLISHED / "reproduction.md").read_text(encoding="utf-8")
