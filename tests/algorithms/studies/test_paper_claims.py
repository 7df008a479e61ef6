"""The claims: which results reproduce them."""

from __future__ import annotations

import dataclasses
from typing import Any

import polars as pl
import pytest

from algorithms.studies import CLAIM_NUMBERS, FIGURES
from algorithms.studies.paper import CLAIMS, PaperResults, Verdict, is_settled
from algorithms.studies.paper_report import CURVE_FIGURES, FRONT_FIGURES
from tests.helpers.reproduction import SOLVED, evenly_spread, make_results, paper, together

ONE, OTHER, OBSTACLE = "one_waypoint_linear", "one_waypoint_nonlinear", "static_obstacle_nonlinear"
# Arrival and progress of learners on StaticObstacle.
GOOD = {**SOLVED, "success": evenly_spread(0.9), "return/distance": evenly_spread(18.0)}
BAD = {**SOLVED, "success": evenly_spread(0.0, 0.0), "return/distance": evenly_spread(-30.0, 1.0)}
STANDING_STILL = {**BAD, "return/distance": evenly_spread(1.0)}
ONE_SEED = {"utility_esr": [10.0], "success": [0.99]}
FRONT = {
    "hypervolume": evenly_spread(25_000.0),
    "cardinality": evenly_spread(80.0, 5.0),
    "lowest_distance": evenly_spread(0.0),
    "highest_distance": evenly_spread(14.5),
}


def judge(number: int, results: PaperResults, protocol: str = "best") -> Verdict:
    """The verdict of a claim."""
    verdict = CLAIMS[number - 1].judge(results, protocol)
    assert verdict is not None
    return verdict


def solved(
    utility: float, spread: float = 0.01, arrivals: tuple[float, float] = (0.99, 0.001)
) -> dict[str, list[float]]:
    return {"utility_esr": evenly_spread(utility, spread), "success": evenly_spread(*arrivals)}


def both(mo_a2c: dict[str, Any], a2c: dict[str, Any] = SOLVED) -> dict[str, dict[str, Any]]:
    return {"a2c": a2c, "mo_a2c": mo_a2c}


def test_every_claim_and_figure_has_its_tasks_in_the_study() -> None:
    assert [claim.number for claim in CLAIMS] == list(CLAIM_NUMBERS) == [1, 2, 3, 4, 5, 6]
    assert {figure for claim in CLAIMS for figure in claim.figures} == {*CURVE_FIGURES, *FRONT_FIGURES} == set(FIGURES)
    tasks = {task for claim in CLAIMS for task in claim.tasks} | {
        f"{scenario}_{kind}" for _, scenario, _ in CURVE_FIGURES.values() for kind in ("linear", "nonlinear")
    }
    assert {f"{task}/{protocol}" for task in tasks for protocol in ("printed", "best")} <= set(paper().tasks)


@pytest.mark.parametrize(
    ("number", "task", "scores", "conclusion"),
    [
        (1, ONE, both(solved(10.1)), "reproduced"),
        (1, ONE, both(solved(9.0)), "not reproduced"),  # they differ by a tenth
        (1, ONE, both(solved(10.5, 2.0)), "inconclusive"),
        (1, ONE, both(solved(10.1, arrivals=(0.5, 0.001))), "not reproduced"),  # similar, but not solved
        (1, ONE, both(solved(10.1, arrivals=(0.95, 0.04))), "inconclusive"),
        (1, ONE, both(ONE_SEED, ONE_SEED), "inconclusive"),
        (2, OTHER, both(solved(23.0), solved(22.0, 0.1)), "reproduced"),
        (2, OTHER, both(solved(23.0, 0.5), solved(22.0, 0.1)), "not reproduced"),  # higher, but less consistent
        (2, OTHER, both(solved(19.0), solved(22.0, 0.1)), "not reproduced"),  # more consistent, but lower
        (2, OTHER, both(solved(22.0, 0.1), solved(22.0, 0.1)), "inconclusive"),
        (4, OBSTACLE, both(GOOD, BAD), "reproduced"),
        (4, OBSTACLE, both(GOOD, STANDING_STILL), "not reproduced"),
        (4, OBSTACLE, both(GOOD, GOOD), "not reproduced"),
        (4, OBSTACLE, both(BAD, BAD), "not reproduced"),
        (6, "one_waypoint_front", {"pcn": FRONT}, "reproduced"),
        (6, "one_waypoint_front", {"pcn": {**FRONT, "lowest_distance": evenly_spread(12.0)}}, "not reproduced"),
    ],
)
def test_a_claim_is_judged_by_its_criteria(
    number: int, task: str, scores: dict[str, dict[str, list[float]]], conclusion: str
) -> None:
    policy = "front" if number == 6 else "stochastic"
    assert judge(number, make_results(task, scores, policy=policy)).conclusion == conclusion


@pytest.mark.parametrize(
    ("arrivals", "total", "conclusion"),
    [(0.0, -3.0, "reproduced"), (0.0, -9.0, "not reproduced"), (0.9, -3.0, "not reproduced")],
)
def test_claim_5_requires_that_both_fail_and_mo_a2c_less_badly(arrivals: float, total: float, conclusion: str) -> None:
    failing = {"success": evenly_spread(0.0, 0.001, 4), "total_utility_esr": evenly_spread(-5.0, 0.1, 4)}
    other = {"success": evenly_spread(arrivals, 0.001, 4), "total_utility_esr": evenly_spread(total, 0.1, 4)}
    parts = [
        make_results(task, both(other, failing), protocol="printed")
        for task in ("intersection_linear", "intersection_nonlinear")
    ]
    assert judge(5, together(*parts), "printed").conclusion == conclusion
    assert CLAIMS[4].judge(parts[0], "printed") is None  # the other task has no results


@pytest.mark.parametrize(
    ("arrivals", "risen", "text"),
    [
        (0.5, 0.5, "not reproduced"),
        (0.5, 1.0, "inconclusive: stopped at 1,000 steps"),
        (0.99, 1.0, "inconclusive: stopped at 1,000 steps"),  # the utilities may still move apart
        (0.99, 0.5, "reproduced"),
    ],
)
def test_a_run_that_was_still_improving_decides_nothing(arrivals: float, risen: float, text: str) -> None:
    results = make_results(ONE, both(solved(10.0, arrivals=(arrivals, 0.001))), risen=risen)
    assert is_settled(results.tasks[ONE]["best"]) is (risen < 1.0)
    assert judge(1, results).text == text


def test_an_answer_that_longer_training_could_only_confirm_stands() -> None:
    failing = {**GOOD, "success": evenly_spread(0.1)}
    for scores, passed in ((GOOD, [True, False, None]), (failing, [None, None, None])):
        verdict = judge(4, make_results(OBSTACLE, both(scores, scores), risen=1.0))
        assert [check.passed for check in verdict.checks] == passed  # who has learnt to arrive will not unlearn it


def test_results_without_learning_curves_are_not_settled() -> None:
    whole = make_results(ONE, both(SOLVED))
    assert is_settled(whole.tasks[ONE]["best"])
    for steps in (0, 400):
        short = dataclasses.replace(whole, curves=whole.curves.filter(pl.col("step") < steps))
        assert not is_settled(short.tasks[ONE]["best"])
