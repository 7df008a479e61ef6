"""The paper's claims and the tests that each has to pass, stated before the runs were made.

A test is decided by a 95% bootstrap interval over seeds: it holds, it fails, or the interval leaves it open. A claim
comes out if every test holds, does not if one fails, and is undecided otherwise. Scores are interquartile means of the
final evaluation of the stochastic policy, which is the one that an actor-critic learns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from algorithms.evaluation.statistics import Estimate, iqm, iqm_difference, probability_of_improvement, spread_ratio
from algorithms.reproduction.results import FARTHEST, NEAREST, TOTAL_UTILITY, Results

# The two algorithms of every arm, by the keys of their variants.
BASELINE, MULTI_OBJECTIVE = "a2c", "mo_a2c"
# Limits of the tests.
SOLVED, FAILED, UNLEARNT = 0.95, 0.05, 0.5  # share of episodes that arrive
ALIKE = 0.05  # of the baseline's utility
POLICIES = 10  # of a front that is broad
NEAR, FAR = 1.0, 10.0  # m of progress: from standing still to arriving

Word = Literal["comes out", "does not come out", "undecided"]


@dataclass(frozen=True)
class Check:
    """One test: what it asks, what was measured, and whether it holds (None: the interval leaves it open)."""

    asks: str
    measured: str
    holds: bool | None


@dataclass(frozen=True)
class Comparison:
    """Both algorithms in one cell: interquartile means over seeds, their difference, and how often MO-A2C is higher.

    Attributes:
        baseline, multi_objective: interquartile means.
        difference: of the second over the first.
        improvement: probability that a run of the second is above one of the first.
    """

    baseline: Estimate
    multi_objective: Estimate
    difference: Estimate
    improvement: Estimate


@dataclass(frozen=True)
class Verdict:
    """What became of a claim in one arm."""

    claim: Claim
    arm: str
    word: Word
    checks: tuple[Check, ...]


@dataclass(frozen=True)
class Claim:
    """A claim of the paper.

    Attributes:
        number: as in the documentation.
        figures: of the paper.
        statement: the claim.
        cells: of the plan, which it is about.
        tests: what has to hold, each from the results and the name of an arm.
    """

    number: int
    figures: tuple[int, ...]
    statement: str
    cells: tuple[str, ...]
    tests: Sequence[Callable[[Results, str], Check]]

    def judge(self, results: Results, arm: str) -> Verdict | None:
        """The verdict in an arm; None where it has no results."""
        try:
            checks = tuple(test(results, arm) for test in self.tests)
        except KeyError:
            return None
        answers = [check.holds for check in checks]
        word: Word = "does not come out" if False in answers else "undecided" if None in answers else "comes out"
        return Verdict(self, arm, word, checks)


def compare(results: Results, cell: str, arm: str, metric: str, policy: str = "stochastic") -> Comparison:
    """Both algorithms by a metric.

    Raises:
        KeyError: if a run of either is missing.
    """
    baseline = results.values(cell, arm, BASELINE, metric, policy)
    multi_objective = results.values(cell, arm, MULTI_OBJECTIVE, metric, policy)
    return Comparison(
        iqm(baseline),
        iqm(multi_objective),
        iqm_difference(multi_objective, baseline),
        probability_of_improvement(multi_objective, baseline),
    )


def utility_metric(cell: str) -> str:
    """What an episode's utility is called: with two vehicles it is the sum of theirs."""
    return TOTAL_UTILITY if cell.startswith("intersection") else "utility_esr"


def utility_kind(cell: str) -> str:
    """Linear or not."""
    return "non-linear" if cell.endswith("nonlinear") else "linear"


def above(estimate: Estimate, limit: float) -> bool | None:
    """Whether a value lies above a limit: by its interval, which must not reach it; open without one."""
    low, high = _ends(estimate)
    return True if low > limit else False if high < limit else None


def _below(estimate: Estimate, limit: float) -> bool | None:
    answer = above(estimate, limit)
    return None if answer is None else not answer


def _within(estimate: Estimate, margin: float) -> bool | None:
    low, high = _ends(estimate)
    return True if -margin <= low and high <= margin else False if low > margin or high < -margin else None


def _ends(estimate: Estimate) -> tuple[float, float]:
    """The interval; of one run it is open on both sides."""
    if estimate.low is None or estimate.high is None:
        return -np.inf, np.inf
    return estimate.low, estimate.high


def _name(variant: str) -> str:
    return "A2C" if variant == BASELINE else "MO-A2C"


def _arrivals(cell: str, variant: str, asks: str, holds: Callable[[Estimate], bool | None]) -> Callable[..., Check]:
    def test(results: Results, arm: str) -> Check:
        found = iqm(results.values(cell, arm, variant, "success"))
        return Check(f"{_name(variant)} {asks}", f"arrivals {percent(found)}", holds(found))

    return test


def percent(estimate: Estimate) -> str:
    """A share in percent, with its interval."""
    ends = [None if end is None else 100.0 * end for end in (estimate.low, estimate.high)]
    return f"{Estimate(100.0 * estimate.value, *ends).text()}%"


def solves(cell: str, variant: str) -> Callable[[Results, str], Check]:
    """Arrives in more than SOLVED of the episodes."""
    return _arrivals(cell, variant, f"arrives in over {SOLVED:.0%}", lambda found: above(found, SOLVED))


def fails(cell: str, variant: str) -> Callable[[Results, str], Check]:
    """Arrives in fewer than FAILED of the episodes."""
    asks = f"arrives in under {FAILED:.0%} ({utility_kind(cell)} utility)"
    return _arrivals(cell, variant, asks, lambda found: _below(found, FAILED))


def learns(cell: str, variant: str) -> Callable[[Results, str], Check]:
    """Arrives in more than UNLEARNT of the episodes."""
    return _arrivals(cell, variant, f"arrives in over {UNLEARNT:.0%}", lambda found: above(found, UNLEARNT))


def does_not_learn(cell: str, variant: str) -> Callable[[Results, str], Check]:
    """Arrives in fewer than UNLEARNT of the episodes."""
    return _arrivals(cell, variant, f"arrives in under {UNLEARNT:.0%}", lambda found: _below(found, UNLEARNT))


def drives_away(cell: str, variant: str) -> Callable[[Results, str], Check]:
    """Ends farther from the destination than it began."""

    def test(results: Results, arm: str) -> Check:
        found = iqm(results.values(cell, arm, variant, "return/distance"))
        return Check(f"{_name(variant)} drives away", f"progress {found.text()} m", _below(found, 0.0))

    return test


def alike(cell: str) -> Callable[[Results, str], Check]:
    """The utilities differ by less than ALIKE of the baseline's."""

    def test(results: Results, arm: str) -> Check:
        found = compare(results, cell, arm, utility_metric(cell))
        margin = ALIKE * abs(found.baseline.value)
        return Check(
            f"the utilities differ by less than {ALIKE:.0%}",
            f"difference {found.difference.text()}, {ALIKE:.0%} is {margin:.2g}",
            _within(found.difference, margin),
        )

    return test


def higher(cell: str) -> Callable[[Results, str], Check]:
    """MO-A2C has the higher utility."""

    def test(results: Results, arm: str) -> Check:
        found = compare(results, cell, arm, utility_metric(cell))
        return Check(
            "MO-A2C has the higher utility", f"difference {found.difference.text()}", above(found.difference, 0.0)
        )

    return test


def steadier(cell: str) -> Callable[[Results, str], Check]:
    """The seeds of MO-A2C spread less."""

    def test(results: Results, arm: str) -> Check:
        metric = utility_metric(cell)
        pair = (results.values(cell, arm, variant, metric) for variant in (MULTI_OBJECTIVE, BASELINE))
        found = spread_ratio(*pair)
        return Check("MO-A2C varies less between seeds", f"ratio of deviations {found.text()}", _below(found, 1.0))

    return test


def _front(metric: str, asks: str, holds: Callable[[Estimate], bool | None], unit: str = "") -> Callable[..., Check]:
    def test(results: Results, arm: str) -> Check:
        found = iqm(results.values("one_waypoint_front", arm, "pcn", metric, "front"))
        return Check(asks, f"{found.text()}{unit}", holds(found))

    return test


CLAIMS = (
    Claim(
        1,
        (4,),
        "OneWaypoint, linear utility: A2C and MO-A2C both solve it, alike (fig. 4a)",
        ("one_waypoint_linear",),
        [
            solves("one_waypoint_linear", BASELINE),
            solves("one_waypoint_linear", MULTI_OBJECTIVE),
            alike("one_waypoint_linear"),
        ],
    ),
    Claim(
        2,
        (4,),
        "OneWaypoint, non-linear utility: MO-A2C ends higher and more consistent (fig. 4b)",
        ("one_waypoint_nonlinear",),
        [higher("one_waypoint_nonlinear"), steadier("one_waypoint_nonlinear")],
    ),
    Claim(
        3,
        (5,),
        "StaticObstacle, linear utility: A2C and MO-A2C are alike (fig. 5a)",
        ("static_obstacle_linear",),
        [alike("static_obstacle_linear")],
    ),
    Claim(
        4,
        (5,),
        "StaticObstacle, non-linear utility: MO-A2C learns, A2C does not and drives away (fig. 5b)",
        ("static_obstacle_nonlinear",),
        [
            learns("static_obstacle_nonlinear", MULTI_OBJECTIVE),
            does_not_learn("static_obstacle_nonlinear", BASELINE),
            drives_away("static_obstacle_nonlinear", BASELINE),
        ],
    ),
    Claim(
        5,
        (6, 8, 9),
        "Intersection: independent learners of either kind fail, MO-A2C less under the non-linear utility "
        "(fig. 6, 8, 9)",
        ("intersection_linear", "intersection_nonlinear"),
        [
            *(
                fails(cell, variant)
                for cell in ("intersection_linear", "intersection_nonlinear")
                for variant in (BASELINE, MULTI_OBJECTIVE)
            ),
            higher("intersection_nonlinear"),
        ],
    ),
    Claim(
        6,
        (7, 10),
        "OneWaypoint, unknown utility: PCN finds a broad range of behaviours (fig. 7, 10)",
        ("one_waypoint_front",),
        [
            _front("cardinality", f"over {POLICIES} non-dominated policies", lambda found: above(found, POLICIES)),
            _front(NEAREST, f"one goes less than {NEAR:g} m", lambda found: _below(found, NEAR), " m"),
            _front(FARTHEST, f"one goes over {FAR:g} m", lambda found: above(found, FAR), " m"),
        ],
    ),
)
