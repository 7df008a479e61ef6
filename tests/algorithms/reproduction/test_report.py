"""The report and its tables."""

from __future__ import annotations

from pathlib import Path

import pytest

from algorithms.reproduction.plan import Plan, load_plan
from algorithms.reproduction.report import (
    BEGIN,
    END,
    insert_verdicts,
    is_ablation,
    verdict_table,
    write_report,
)
from algorithms.reproduction.results import ReproductionResults
from tests.helpers.paths import REPOSITORY
from tests.helpers.reproduction import PLAN, PUBLISHED, SOLVED, evenly_spread, make_results


def test_the_verdict_table_is_replaced_and_nothing_else_changes(tmp_path: Path) -> None:
    plan, path = load_plan(PLAN), tmp_path / "README.md"
    results = make_results("one_waypoint_linear", {"a2c": SOLVED, "mo_a2c": SOLVED})
    path.write_text(f"before\n\n{BEGIN}\nold\n{END}\n\nafter \\1\n")
    insert_verdicts(path, plan, results)
    once = path.read_text()
    assert once.startswith("before\n\n")
    assert once.endswith("after \\1\n")
    assert "**reproduced**" in once
    assert "old" not in once
    insert_verdicts(path, plan, results)
    assert path.read_text() == once
    path.write_text("no markers")
    with pytest.raises(ValueError, match="does not have exactly one line"):
        insert_verdicts(path, plan, results)


def test_ablations_are_distinguished_from_comparisons() -> None:
    plan = Plan.model_validate(load_plan(PLAN).model_dump())
    protocols = plan.tasks["one_waypoint_nonlinear"].protocols
    assert [key for key, protocol in protocols.items() if is_ablation(protocol)] == ["without"]


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


published = pytest.mark.skipif(
    not (PUBLISHED / "reproduction_scores.csv").exists(), reason="there are no published results"
)


@published
def test_the_readme_and_the_report_agree_with_the_published_scores(tmp_path: Path) -> None:
    plan, results = load_plan(PLAN), ReproductionResults.read(PUBLISHED)
    table = verdict_table(plan, results)
    readme = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    assert readme.split(BEGIN)[1].split(END)[0].strip() == table
    assert table in (PUBLISHED / "reproduction.md").read_text(encoding="utf-8")
