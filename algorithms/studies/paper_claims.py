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

from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from algorithms.studies.paper_results import BASELINE, FRONT_LEARNER, FRONT_TASK, LABELS, MULTI_OBJECTIVE
from mo_deepdrive.evaluation.metrics import (
    CARDINALITY,
    FRONT,
    HIGHEST_DISTANCE,
    HYPERVOLUME,
    LOWEST_DISTANCE,
    STOCHASTIC,
    SUCCESS,
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
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from algorithms.studies.paper_results import PaperResults, TaskResults

# Limits of the criteria.
SOLVED, LEARNED, FAILED = 0.95, 0.5, 0.05  # success rates
SIMILAR = 0.05  # relative to the baseline's utility
FLAT = 0.05  # gain at the end of training, relative to the score that is reached
RATIOS = (0.5, 0.25)  # true ratios of deviations, for which the power of the test is reported
MIN_EVALUATIONS = 5  # of a learning curve, to tell whether it is flat

Conclusion = Literal["reproduced", "not reproduced", "inconclusive"]


class Measured(NamedTuple):
    """What is measured, with its text; limits are in multiples of the unit."""

    estimate: Estimate
    text: str
    unit: float = 1.0


class Check(NamedTuple):
    """A criterion applied to results; ``passed`` is None if it is inconclusive.

    ``stopped_at`` is the step at which training stopped too early for an answer; None if that is not the reason.
    """

    criterion: str
    measured: str
    passed: bool | None
    stopped_at: int | None = None


@dataclass(frozen=True)
class Criterion:
    """That what is measured of a task lies between two limits.

    Attributes:
        task: its name, without the protocol.
        text: the criterion in words.
        measure: raises KeyError if results are missing.
        above, below: the limits.
        lasting: the answer that longer training could only confirm; None if it could change both.
    """

    task: str
    text: str
    measure: Callable[[TaskResults], Measured]
    above: float = -inf
    below: float = inf
    lasting: bool | None = None

    def check(self, results: TaskResults) -> Check:
        """Apply it to results of its task."""
        estimate, measured, unit = self.measure(results)
        passed = is_between(estimate, unit * self.above, unit * self.below)
        if passed is None or passed is self.lasting or is_settled(results):
            return Check(self.text, measured, passed)
        return Check(self.text, measured, None, results.steps)


class Verdict(NamedTuple):
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
    """A claim of the paper: its number, the paper's figures, the claim in words, and the criteria that decide it."""

    number: int
    figures: tuple[int, ...]
    statement: str
    criteria: Sequence[Criterion]

    @property
    def tasks(self) -> list[str]:
        """The tasks, without the protocol, that it is about."""
        return list(dict.fromkeys(criterion.task for criterion in self.criteria))

    def judge(self, results: PaperResults, protocol: str) -> Verdict | None:
        """The verdict under a protocol; None if results are missing."""
        try:
            checks = tuple(criterion.check(results.tasks[criterion.task][protocol]) for criterion in self.criteria)
        except KeyError:
            return None
        passed = [check.passed for check in checks]
        conclusion: Conclusion = "inconclusive" if None in passed else "reproduced"
        return Verdict("not reproduced" if False in passed else conclusion, checks)

    def verdicts(self, results: PaperResults) -> dict[str, Verdict]:
        """The verdicts by protocol; only protocols with results for all tasks."""
        judged = {protocol: self.judge(results, protocol) for protocol in results.tasks.get(self.tasks[0], {})}
        return {protocol: verdict for protocol, verdict in judged.items() if verdict is not None}


def compare(results: TaskResults) -> tuple[Estimate, Estimate, Estimate, Estimate]:
    """Utilities of A2C and MO-A2C: interquartile means over seeds, their difference, P(a run of MO-A2C is higher)."""
    first, second = (results.values(learner, results.utility) for learner in LABELS)
    return iqm(first), iqm(second), iqm_difference(second, first), probability_of_improvement(second, first)


def utility_kind(task: str) -> str:
    """Either "linear" or "non-linear"."""
    return "non-linear" if task.endswith("nonlinear") else "linear"


def is_settled(results: TaskResults) -> bool:
    """Whether the learning curves were flat at the end of training.

    They are if, for every compared algorithm, the upper end of the interval over seeds of the gain (the mean of the
    last fifth of the evaluations minus that of the fifth before) is below FLAT times the mean of the last fifth. The
    score is the utility of the stochastic policy, for a front its hypervolume.
    """
    name = f"{FRONT}/{HYPERVOLUME}" if results.is_front else f"{STOCHASTIC}/{results.utility}"
    return all(
        _is_flat([curve[name] for curve in results.learning_curves(learner) if name in curve])
        for learner in ((FRONT_LEARNER,) if results.is_front else (BASELINE, MULTI_OBJECTIVE))
    )


def _is_flat(curves: Sequence[NDArray[np.float64]]) -> bool:
    """Whether the curves of one algorithm, one per seed, are flat at their end; False if they are too short to tell."""
    scores = [curve[np.isfinite(curve)] for curve in curves]
    if not scores or min(map(len, scores)) < MIN_EVALUATIONS:
        return False
    fifths = [(curve[-2 * (n := len(curve) // 5) : -n].mean(), curve[-n:].mean()) for curve in scores]
    before, last = np.array(fifths).T
    return is_between(mean(last - before), -inf, FLAT * abs(float(last.mean()))) is True


def is_between(estimate: Estimate, above: float, below: float) -> bool | None:
    """Whether an interval lies between two limits; None if it contains one, or is not known."""
    if estimate.low is None or estimate.high is None:  # of too few runs
        return None
    if above < estimate.low and estimate.high < below:
        return True
    return False if estimate.high < above or estimate.low > below else None


def shown(estimate: Estimate) -> str:
    """A score with its interval, to hundredths at most: the episodes of an evaluation do not tell more."""
    return estimate.text(other_width=0.1)


def percent(estimate: Estimate) -> str:
    """A fraction in percent, with its interval."""
    bounds = [None if bound is None else 100.0 * bound for bound in (estimate.low, estimate.high)]
    return f"{shown(Estimate(100.0 * estimate.value, *bounds))}%"


# ---------------------------------------------------------------------------------------------------------- criteria


def _arrives(task: str, learner: str, *, above: float = -inf, below: float = inf) -> Criterion:
    """The share of episodes in which the vehicle, or all vehicles, arrive is above or below a limit."""
    limit = f"above {above:.0%}" if above > -inf else f"below {below:.0%}"
    which = f" ({utility_kind(task)} utility)" if task.startswith("intersection") else ""

    def measure(results: TaskResults) -> Measured:
        rate = iqm(results.values(learner, SUCCESS))
        return Measured(rate, f"success rate {percent(rate)}")

    text = f"{LABELS[learner]}: success rate {limit}{which}"
    return Criterion(task, text, measure, above, below, lasting=above > -inf)


def _progress_of_baseline(results: TaskResults) -> Measured:
    progress = iqm(results.values(BASELINE, return_of("distance")))
    return Measured(progress, f"progress {shown(progress)} m")


def _relative_difference(results: TaskResults) -> Measured:
    baseline, _, difference, _ = compare(results)
    utility = abs(baseline.value)
    return Measured(difference, f"difference {shown(difference)}, {SIMILAR:.0%} is {SIMILAR * utility:.2g}", utility)


def _difference(results: TaskResults) -> Measured:
    difference = compare(results)[2]
    return Measured(difference, f"difference {shown(difference)}")


def _deviations(results: TaskResults) -> Measured:
    first, second = (results.values(learner, results.utility) for learner in (MULTI_OBJECTIVE, BASELINE))
    ratio, runs = spread_ratio(first, second), min(len(first), len(second))
    powers = [f"{spread_ratio_power(runs, true):.0%} for a true ratio of {true:g}" for true in RATIOS]
    return Measured(ratio, f"ratio of deviations {ratio.text()}; power of the test: {', '.join(powers)}")


def _similar(task: str) -> Criterion:
    text = f"the utilities differ by less than {SIMILAR:.0%}"
    return Criterion(task, text, _relative_difference, -SIMILAR, SIMILAR)


def _higher(task: str) -> Criterion:
    return Criterion(task, "MO-A2C has the higher utility", _difference, above=0.0)


def _front(metric: str, unit: str, text: str, **limits: float) -> Criterion:
    """A metric of PCN's front, which longer training broadens, is on the right side of a limit."""

    def measure(results: TaskResults) -> Measured:
        score = iqm(results.values(FRONT_LEARNER, metric, FRONT))
        return Measured(score, shown(score) + unit)

    return Criterion(FRONT_TASK, text, measure, lasting=True, **limits)


CLAIMS = (
    Claim(
        1,
        (4,),
        "OneWaypoint, linear utility: A2C and MO-A2C both solve it, with similar utility (fig. 4a)",
        [
            _arrives("one_waypoint_linear", BASELINE, above=SOLVED),
            _arrives("one_waypoint_linear", MULTI_OBJECTIVE, above=SOLVED),
            _similar("one_waypoint_linear"),
        ],
    ),
    Claim(
        2,
        (4,),
        "OneWaypoint, non-linear utility: MO-A2C reaches a higher utility, more consistently (fig. 4b)",
        [
            _higher("one_waypoint_nonlinear"),
            Criterion("one_waypoint_nonlinear", "MO-A2C varies less between seeds", _deviations, below=1.0),
        ],
    ),
    Claim(
        3,
        (5,),
        "StaticObstacle, linear utility: A2C and MO-A2C reach similar utility (fig. 5a)",
        [_similar("static_obstacle_linear")],
    ),
    Claim(
        4,
        (5,),
        "StaticObstacle, non-linear utility: MO-A2C learns; A2C does not, and moves away from the destination "
        "(fig. 5b)",
        [
            _arrives("static_obstacle_nonlinear", MULTI_OBJECTIVE, above=LEARNED),
            _arrives("static_obstacle_nonlinear", BASELINE, below=LEARNED),
            Criterion(
                "static_obstacle_nonlinear", "A2C moves away from the destination", _progress_of_baseline, below=0.0
            ),
        ],
    ),
    Claim(
        5,
        (6, 8, 9),
        "Intersection: independent learners of both kinds fail; MO-A2C fails less badly under the non-linear utility "
        "(fig. 6, 8, 9)",
        [
            *(
                _arrives(task, learner, below=FAILED)
                for task in ("intersection_linear", "intersection_nonlinear")
                for learner in (BASELINE, MULTI_OBJECTIVE)
            ),
            _higher("intersection_nonlinear"),
        ],
    ),
    Claim(
        6,
        (7, 10),
        "OneWaypoint, unknown utility: PCN finds a broad range of behaviours (fig. 7, 10)",
        [
            _front(CARDINALITY, "", "over 10 non-dominated policies", above=10),
            _front(LOWEST_DISTANCE, " m", "some policy progresses less than 1 m", below=1.0),  # it stands still
            _front(HIGHEST_DISTANCE, " m", "some policy progresses over 10 m", above=10.0),  # it nearly arrives
        ],
    ),
)
