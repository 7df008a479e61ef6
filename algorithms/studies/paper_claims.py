"""The paper's claims and the criteria that decide them, which were fixed before the runs were trained.

The one exception is the rule that learning curves must be flat, which was added afterwards (docs/reproduction.md).

A criterion is decided by a 95% bootstrap interval over seeds: it passes, fails, or is inconclusive if the interval
contains the limit. If training stopped before the learning curves were flat (:func:`is_settled`), it is inconclusive
too, unless longer training could only confirm the answer. A claim is reproduced if all criteria pass, not reproduced if
one fails, and inconclusive otherwise.
Scores are interquartile means over seeds (Agarwal et al. 2021) of the final evaluation of the stochastic policy, which
is the policy that actor-critics optimise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from mo_deepdrive.evaluation.metrics import (
    CARDINALITY,
    FRONT,
    HIGHEST_DISTANCE,
    HYPERVOLUME,
    LOWEST_DISTANCE,
    STOCHASTIC,
    SUCCESS,
    TOTAL_UTILITY_ESR,
    UTILITY_ESR,
    return_of,
)
from mo_deepdrive.evaluation.statistics import (
    Estimate,
    iqm,
    iqm_difference,
    mean,
    probability_of_improvement,
    spread_ratio,
    spread_ratio_power,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from algorithms.studies.paper_results import PaperResults
    from algorithms.studies.settings import Study

# The two algorithms that are compared, by their keys in the study.
BASELINE, MULTI_OBJECTIVE = "a2c", "mo_a2c"
LABELS = {BASELINE: "A2C", MULTI_OBJECTIVE: "MO-A2C"}
# The task with an unknown utility, and the learner of its front.
FRONT_TASK, FRONT_LEARNER = "one_waypoint_front", "pcn"
# Limits of the criteria.
SOLVED, LEARNED, FAILED = 0.95, 0.5, 0.05  # success rates
SIMILAR = 0.05  # relative to the baseline's utility
FLAT = 0.05  # gain at the end of training, relative to the score that is reached
RATIOS = (0.5, 0.25)  # true ratios of deviations, for which the power of the test is reported
MIN_EVALUATIONS = 5  # of a learning curve, to tell whether it is flat
MIN_POLICIES = 10  # of a broad front
SHORT_PROGRESS, LONG_PROGRESS = 1.0, 10.0  # m: from standing still to arriving

Conclusion = Literal["reproduced", "not reproduced", "inconclusive"]


@dataclass(frozen=True)
class Check:
    """A criterion applied to results.

    Attributes:
        criterion: in words.
        measured: the measured value with its interval.
        passed: None if it is inconclusive.
        stopped_at: the step at which training stopped too early for an answer; None if that is not the reason.
    """

    criterion: str
    measured: str
    passed: bool | None
    stopped_at: int | None = None


Criterion = Callable[["PaperResults", str], Check]  # of the results and a protocol
Decision = Callable[[Estimate, float], bool | None]  # of an estimate and a limit


class AlgorithmComparison(NamedTuple):
    """Utilities of A2C and MO-A2C: interquartile means over seeds, their difference, P(a run of MO-A2C is higher)."""

    baseline: Estimate
    multi_objective: Estimate
    difference: Estimate
    improvement: Estimate


@dataclass(frozen=True)
class Verdict:
    """Whether a claim is reproduced under a protocol, and the checks that decide it."""

    conclusion: Conclusion
    checks: tuple[Check, ...]

    @property
    def text(self) -> str:
        """The conclusion, and the step at which training stopped if that was too early for another one."""
        steps = [check.stopped_at for check in self.checks if check.stopped_at is not None]
        early = self.conclusion == "inconclusive" and steps
        return f"{self.conclusion}: stopped at {max(steps):,} steps" if early else self.conclusion


@dataclass(frozen=True)
class Claim:
    """A claim of the paper.

    Attributes:
        number: as in the documentation.
        figures: of the paper.
        statement: the claim in words.
        tasks: of the study, without the protocol, that the claim is about.
        criteria: which decide it.
    """

    number: int
    figures: tuple[int, ...]
    statement: str
    tasks: tuple[str, ...]
    criteria: Sequence[Criterion]

    def judge(self, results: PaperResults, protocol: str) -> Verdict | None:
        """The verdict under a protocol; None if results are missing."""
        try:
            checks = tuple(criterion(results, protocol) for criterion in self.criteria)
        except KeyError:
            return None
        passed = [check.passed for check in checks]
        conclusion: Conclusion = "inconclusive" if None in passed else "reproduced"
        return Verdict("not reproduced" if False in passed else conclusion, checks)


def compare(results: PaperResults, task: str, protocol: str) -> AlgorithmComparison:
    """Compare the utilities of A2C and MO-A2C."""
    baseline, multi_objective = (
        results.values(task, protocol, learner, utility_metric(task)) for learner in (BASELINE, MULTI_OBJECTIVE)
    )
    return AlgorithmComparison(
        iqm(baseline),
        iqm(multi_objective),
        iqm_difference(multi_objective, baseline),
        probability_of_improvement(multi_objective, baseline),
    )


def is_ablation(study: Study, key: str) -> bool:
    """Whether a task, TASK/PROTOCOL, is an ablation, instead of a comparison of A2C and MO-A2C or a run of PCN."""
    return set(study.learners_of(key)) not in ({BASELINE, MULTI_OBJECTIVE}, {FRONT_LEARNER})


def utility_metric(task: str) -> str:
    """The name of the metric for an episode's utility; with two vehicles it is the sum of their utilities."""
    return TOTAL_UTILITY_ESR if task.startswith("intersection") else UTILITY_ESR


def utility_kind(task: str) -> str:
    """Either "linear" or "non-linear"."""
    return "non-linear" if task.endswith("nonlinear") else "linear"


def is_settled(results: PaperResults, task: str, protocol: str) -> bool:
    """Whether the learning curves were flat at the end of training.

    They are if, for every compared algorithm, the upper end of the interval over seeds of the gain (the mean of the
    last fifth of the evaluations minus that of the fifth before) is below FLAT times the mean of the last fifth. The
    score is the utility of the stochastic policy, for a front its hypervolume.
    """
    front = task == FRONT_TASK
    name = f"{FRONT}/{HYPERVOLUME}" if front else f"{STOCHASTIC}/{utility_metric(task)}"
    return all(
        _is_flat([curve[name] for curve in results.learning_curves(task, protocol, learner) if name in curve])
        for learner in ((FRONT_LEARNER,) if front else (BASELINE, MULTI_OBJECTIVE))
    )


def _is_flat(curves: Sequence[NDArray[np.float64]]) -> bool:
    """Whether the curves of one algorithm, one per seed, are flat at their end; False if they are too short to tell."""
    scores = [curve[np.isfinite(curve)] for curve in curves]
    if not scores or min(map(len, scores)) < MIN_EVALUATIONS:
        return False
    fifths = [(curve[-2 * (n := len(curve) // 5) : -n].mean(), curve[-n:].mean()) for curve in scores]
    before, last = np.array(fifths).T
    return is_above(mean(last - before), FLAT * abs(float(last.mean()))) is False


def _check(
    results: PaperResults,
    task: str,
    protocol: str,
    criterion: str,
    measured: str,
    passed: bool | None,
    lasting: bool | None = None,
) -> Check:
    """A check, which is inconclusive if training stopped too early for its answer.

    ``passed`` is what the interval over seeds says; ``lasting`` is the answer that longer training could only confirm,
    None if it could change both.
    """
    if passed is None or passed is lasting or is_settled(results, task, protocol):
        return Check(criterion, measured, passed)
    return Check(criterion, measured, None, stopped_at=results.steps(task, protocol))


def is_above(estimate: Estimate, limit: float) -> bool | None:
    """Whether the interval of an estimate is entirely above the limit; None if it contains the limit."""
    low, high = _interval(estimate)
    return True if low > limit else False if high < limit else None


def is_below(estimate: Estimate, limit: float) -> bool | None:
    """Whether the interval of an estimate is entirely below the limit; None if it contains the limit."""
    above = is_above(estimate, limit)
    return None if above is None else not above


def _is_within(estimate: Estimate, margin: float) -> bool | None:
    """Whether the interval of an estimate is inside [-margin, margin]; None if it is partly inside."""
    low, high = _interval(estimate)
    return True if -margin <= low and high <= margin else False if low > margin or high < -margin else None


def _interval(estimate: Estimate) -> tuple[float, float]:
    """The interval of an estimate; unbounded if there is only one run."""
    if estimate.low is None or estimate.high is None:
        return -np.inf, np.inf
    return estimate.low, estimate.high


def shown(estimate: Estimate) -> str:
    """A score with its interval, to hundredths at most: the episodes of an evaluation do not tell more."""
    return estimate.text(other_width=0.1)


def percent(estimate: Estimate) -> str:
    """A fraction in percent, with its interval."""
    bounds = [None if bound is None else 100.0 * bound for bound in (estimate.low, estimate.high)]
    return f"{shown(Estimate(100.0 * estimate.value, *bounds))}%"


def arrives(task: str, learner: str, decide: Decision, limit: float, results: PaperResults, protocol: str) -> Check:
    """The share of episodes in which the vehicle, or all vehicles, arrive is above or below the limit."""
    rate = iqm(results.values(task, protocol, learner, SUCCESS))
    above = decide is is_above
    name = f"{LABELS[learner]}: success rate {'above' if above else 'below'} {limit:.0%}"
    if task.startswith("intersection"):
        name += f" ({utility_kind(task)} utility)"
    measured = f"success rate {percent(rate)}"
    return _check(results, task, protocol, name, measured, decide(rate, limit), lasting=above)


def moves_away(task: str, learner: str, results: PaperResults, protocol: str) -> Check:
    """Episodes end farther from the destination than they start."""
    progress = iqm(results.values(task, protocol, learner, return_of("distance")))
    name = f"{LABELS[learner]} moves away from the destination"
    return _check(results, task, protocol, name, f"progress {shown(progress)} m", is_below(progress, 0.0))


def similar_utility(task: str, results: PaperResults, protocol: str) -> Check:
    """The utilities differ by less than SIMILAR of the baseline's."""
    compared = compare(results, task, protocol)
    margin = SIMILAR * abs(compared.baseline.value)
    name = f"the utilities differ by less than {SIMILAR:.0%}"
    measured = f"difference {shown(compared.difference)}, {SIMILAR:.0%} is {margin:.2g}"
    return _check(results, task, protocol, name, measured, _is_within(compared.difference, margin))


def higher_utility(task: str, results: PaperResults, protocol: str) -> Check:
    """MO-A2C has a higher utility than A2C."""
    difference = compare(results, task, protocol).difference
    name, measured = "MO-A2C has the higher utility", f"difference {shown(difference)}"
    return _check(results, task, protocol, name, measured, is_above(difference, 0.0))


def more_consistent(task: str, results: PaperResults, protocol: str) -> Check:
    """The utility of MO-A2C varies less between seeds than that of A2C."""
    first, second = (
        results.values(task, protocol, learner, utility_metric(task)) for learner in (MULTI_OBJECTIVE, BASELINE)
    )
    ratio = spread_ratio(first, second)
    runs = min(len(first), len(second))
    powers = [f"{spread_ratio_power(runs, true):.0%} for a true ratio of {true:g}" for true in RATIOS]
    measured = f"ratio of deviations {ratio.text()}; power of the test: {', '.join(powers)}"
    return _check(results, task, protocol, "MO-A2C varies less between seeds", measured, is_below(ratio, 1.0))


def broad_front(metric: str, decide: Decision, limit: float, name: str, results: PaperResults, protocol: str) -> Check:
    """A metric of PCN's front, which longer training broadens, is on the right side of the limit."""
    score = iqm(results.values(FRONT_TASK, protocol, FRONT_LEARNER, metric, FRONT))
    unit = "" if metric == CARDINALITY else " m"
    return _check(results, FRONT_TASK, protocol, name, f"{shown(score)}{unit}", decide(score, limit), lasting=True)


CLAIMS = (
    Claim(
        1,
        (4,),
        "OneWaypoint, linear utility: A2C and MO-A2C both solve it, with similar utility (fig. 4a)",
        ("one_waypoint_linear",),
        [
            partial(arrives, "one_waypoint_linear", BASELINE, is_above, SOLVED),
            partial(arrives, "one_waypoint_linear", MULTI_OBJECTIVE, is_above, SOLVED),
            partial(similar_utility, "one_waypoint_linear"),
        ],
    ),
    Claim(
        2,
        (4,),
        "OneWaypoint, non-linear utility: MO-A2C reaches a higher utility, more consistently (fig. 4b)",
        ("one_waypoint_nonlinear",),
        [partial(higher_utility, "one_waypoint_nonlinear"), partial(more_consistent, "one_waypoint_nonlinear")],
    ),
    Claim(
        3,
        (5,),
        "StaticObstacle, linear utility: A2C and MO-A2C reach similar utility (fig. 5a)",
        ("static_obstacle_linear",),
        [partial(similar_utility, "static_obstacle_linear")],
    ),
    Claim(
        4,
        (5,),
        "StaticObstacle, non-linear utility: MO-A2C learns; A2C does not, and moves away from the destination "
        "(fig. 5b)",
        ("static_obstacle_nonlinear",),
        [
            partial(arrives, "static_obstacle_nonlinear", MULTI_OBJECTIVE, is_above, LEARNED),
            partial(arrives, "static_obstacle_nonlinear", BASELINE, is_below, LEARNED),
            partial(moves_away, "static_obstacle_nonlinear", BASELINE),
        ],
    ),
    Claim(
        5,
        (6, 8, 9),
        "Intersection: independent learners of both kinds fail; MO-A2C fails less badly under the non-linear utility "
        "(fig. 6, 8, 9)",
        ("intersection_linear", "intersection_nonlinear"),
        [
            *(
                partial(arrives, task, learner, is_below, FAILED)
                for task in ("intersection_linear", "intersection_nonlinear")
                for learner in (BASELINE, MULTI_OBJECTIVE)
            ),
            partial(higher_utility, "intersection_nonlinear"),
        ],
    ),
    Claim(
        6,
        (7, 10),
        "OneWaypoint, unknown utility: PCN finds a broad range of behaviours (fig. 7, 10)",
        (FRONT_TASK,),
        [
            partial(broad_front, CARDINALITY, is_above, MIN_POLICIES, f"over {MIN_POLICIES} non-dominated policies"),
            partial(
                broad_front,
                LOWEST_DISTANCE,
                is_below,
                SHORT_PROGRESS,
                f"some policy progresses less than {SHORT_PROGRESS:g} m",
            ),
            partial(
                broad_front,
                HIGHEST_DISTANCE,
                is_above,
                LONG_PROGRESS,
                f"some policy progresses over {LONG_PROGRESS:g} m",
            ),
        ],
    ),
)
