"""The claims: which results reproduce them."""

from __future__ import annotations

import re

import pytest

from algorithms.studies.paper_claims import Verdict, compare, is_settled
from algorithms.studies.paper_results import ReproductionResults
from tests.helpers.reproduction import SOLVED, evenly_spread, get_claim, make_results


def judge(number: int, results: ReproductionResults, protocol: str = "best") -> Verdict:
    """The verdict of a claim."""
    verdict = get_claim(number).judge(results, protocol)
    assert verdict is not None
    return verdict


@pytest.mark.parametrize(
    ("utility", "arrivals", "conclusion"),
    [
        (evenly_spread(10.1), evenly_spread(0.99, 0.001), "reproduced"),
        (evenly_spread(9.0), evenly_spread(0.99, 0.001), "not reproduced"),  # they differ by a tenth
        (evenly_spread(10.5, 2.0), evenly_spread(0.99, 0.001), "inconclusive"),
        (evenly_spread(10.1), evenly_spread(0.5, 0.001), "not reproduced"),  # similar, but not solved
        (evenly_spread(10.1), evenly_spread(0.95, 0.04), "inconclusive"),
    ],
)
def test_claim_1_requires_that_both_solve_it_with_similar_utility(
    utility: list[float], arrivals: list[float], conclusion: str
) -> None:
    scores = {"a2c": SOLVED, "mo_a2c": {"utility_esr": utility, "success": arrivals}}
    verdict = judge(1, make_results("one_waypoint_linear", scores))
    assert verdict.conclusion == conclusion


@pytest.mark.parametrize(
    ("utility", "conclusion"),
    [
        (evenly_spread(23.0, 0.01), "reproduced"),
        (evenly_spread(23.0, 0.5), "not reproduced"),  # higher, but less consistent
        (evenly_spread(19.0, 0.01), "not reproduced"),  # more consistent, but lower
        (evenly_spread(22.0, 0.1), "inconclusive"),
    ],
)
def test_claim_2_requires_that_mo_a2c_is_higher_and_more_consistent(utility: list[float], conclusion: str) -> None:
    scores = {"a2c": {"utility_esr": evenly_spread(22.0, 0.1)}, "mo_a2c": {"utility_esr": utility}}
    verdict = judge(2, make_results("one_waypoint_nonlinear", scores))
    assert verdict.conclusion == conclusion


def test_claim_4_requires_that_a2c_does_not_learn_and_moves_away() -> None:
    good = {**SOLVED, "success": evenly_spread(0.9), "return/distance": evenly_spread(18.0)}
    bad = {**SOLVED, "success": evenly_spread(0.0, 0.0), "return/distance": evenly_spread(-30.0, 1.0)}
    standing_still = {**bad, "return/distance": evenly_spread(1.0)}
    for a2c, mo_a2c, passed in (
        (bad, good, [True, True, True]),
        (good, good, [True, False, False]),
        (bad, bad, [False, True, True]),
        (standing_still, good, [True, True, False]),
    ):
        verdict = judge(4, make_results("static_obstacle_nonlinear", {"a2c": a2c, "mo_a2c": mo_a2c}))
        assert [check.passed for check in verdict.checks] == passed


@pytest.mark.parametrize(
    ("arrivals", "total", "conclusion"),
    [(0.0, -3.0, "reproduced"), (0.0, -9.0, "not reproduced"), (0.9, -3.0, "not reproduced")],
)
def test_claim_5_requires_that_both_fail_and_mo_a2c_less_badly(arrivals: float, total: float, conclusion: str) -> None:
    failing = {"success": evenly_spread(0.0, 0.001, 4), "total_utility_esr": evenly_spread(-5.0, 0.1, 4)}
    other = {"success": evenly_spread(arrivals, 0.001, 4), "total_utility_esr": evenly_spread(total, 0.1, 4)}
    parts = [
        make_results(task, {"a2c": failing, "mo_a2c": other}, protocol="printed")
        for task in ("intersection_linear", "intersection_nonlinear")
    ]
    results = ReproductionResults(
        [row for part in parts for row in part.scores], [row for part in parts for row in part.curves]
    )
    verdict = judge(5, results, "printed")
    assert verdict.conclusion == conclusion
    assert get_claim(5).judge(parts[0], "printed") is None  # the other task has no results


def test_claim_6_requires_many_policies_from_standing_still_to_arriving() -> None:
    broad = {
        "hypervolume": evenly_spread(25_000.0),
        "cardinality": evenly_spread(80.0, 5.0),
        "lowest_distance": evenly_spread(0.0),
        "highest_distance": evenly_spread(14.5),
    }
    narrow = {**broad, "lowest_distance": evenly_spread(12.0)}
    for scores, conclusion in ((broad, "reproduced"), (narrow, "not reproduced")):
        verdict = judge(6, make_results("one_waypoint_front", {"pcn": scores}, policy="front"))
        assert verdict.conclusion == conclusion


@pytest.mark.parametrize(
    ("arrivals", "risen", "conclusion", "text"),
    [
        (0.5, 0.5, "not reproduced", "not reproduced"),
        (0.5, 1.0, "inconclusive", "inconclusive: stopped at 1,000 steps"),
        (0.99, 1.0, "inconclusive", "inconclusive: stopped at 1,000 steps"),  # the utilities may still move apart
        (0.99, 0.5, "reproduced", "reproduced"),
    ],
)
def test_a_run_that_was_still_improving_decides_nothing(
    arrivals: float, risen: float, conclusion: str, text: str
) -> None:
    other = {**SOLVED, "success": evenly_spread(arrivals, 0.001)}
    results = make_results("one_waypoint_linear", {"a2c": SOLVED, "mo_a2c": other}, risen=risen)
    assert is_settled(results, "one_waypoint_linear", "best") is (risen < 1.0)
    verdict = judge(1, results)
    assert (verdict.conclusion, verdict.text) == (conclusion, text)


def test_an_answer_that_longer_training_could_only_confirm_stands() -> None:
    arriving = {**SOLVED, "success": evenly_spread(0.9), "return/distance": evenly_spread(18.0)}
    failing = {**arriving, "success": evenly_spread(0.1)}
    scores = {"a2c": arriving, "mo_a2c": arriving}
    verdict = judge(4, make_results("static_obstacle_nonlinear", scores, risen=1.0))
    assert [check.passed for check in verdict.checks] == [True, False, None]  # both learn: A2C will not unlearn it
    assert verdict.text == "not reproduced"
    scores = {"a2c": failing, "mo_a2c": failing}
    verdict = judge(4, make_results("static_obstacle_nonlinear", scores, risen=1.0))
    assert [check.passed for check in verdict.checks] == [None, None, None]


def test_results_without_learning_curves_are_not_settled() -> None:
    scores = {"a2c": SOLVED, "mo_a2c": SOLVED}
    whole = make_results("one_waypoint_linear", scores)
    assert is_settled(whole, "one_waypoint_linear", "best")
    assert not is_settled(ReproductionResults(whole.scores, []), "one_waypoint_linear", "best")
    short = [row for row in whole.curves if row["step"] < 400]
    assert not is_settled(ReproductionResults(whole.scores, short), "one_waypoint_linear", "best")


def test_the_check_of_consistency_states_its_power() -> None:
    scores = {each: {"utility_esr": evenly_spread(22.0, 0.1)} for each in ("a2c", "mo_a2c")}
    verdict = judge(2, make_results("one_waypoint_nonlinear", scores))
    found = re.search(r"power of the test: (\d+)% for a true ratio of 0.5, (\d+)% for", verdict.checks[1].measured)
    assert found is not None
    half, quarter = map(int, found.groups())
    assert 5 < half < 30 < quarter < 70


def test_one_seed_is_inconclusive() -> None:
    scores = {"a2c": {"utility_esr": [10.0], "success": [0.99]}, "mo_a2c": {"utility_esr": [10.0], "success": [0.99]}}
    verdict = judge(1, make_results("one_waypoint_linear", scores))
    assert verdict.conclusion == "inconclusive"


def test_a_claim_without_results_has_no_verdict() -> None:
    assert get_claim(1).judge(ReproductionResults([], []), "best") is None
    with pytest.raises(KeyError, match="one_waypoint_linear/best/a2c"):
        compare(ReproductionResults([], []), "one_waypoint_linear", "best", "utility_esr")
