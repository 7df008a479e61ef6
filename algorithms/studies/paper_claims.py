"""Whether results reproduce the paper's claims, which are in ``paper_claims.yaml`` with the criteria that decide them.

The claims were fixed before the runs were trained; the one exception is the rule that learning curves must be flat,
which was added afterwards (docs/reproduction.md).

A criterion is decided by a 95% bootstrap interval over seeds: it passes, fails, or is inconclusive if the interval
contains the limit. If training stopped before the learning curves were flat (:func:`is_settled`), it is inconclusive
too, unless longer training could only confirm the answer. A claim is reproduced if all criteria pass, not reproduced if
one fails, and inconclusive otherwise.
Scores are interquartile means over seeds (Agarwal et al. 2021) of the final evaluation of the stochastic policy, which
is the policy that actor-critics optimise.
"""

from __future__ import annotations

from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
import yaml

from algorithms.studies.paper_results import BASELINE, FRONT_LEARNER, LABELS, MULTI_OBJECTIVE
from mo_deepdrive.evaluation.metrics import CARDINALITY, FRONT, HYPERVOLUME, STOCHASTIC, SUCCESS, return_of
from mo_deepdrive.evaluation.statistics import (
    Estimate,
    iqm,
    iqm_difference,
    mean,
    probability_of_improvement,
    spread_ratio,
    spread_ratio_power,
)
from mo_deepdrive.world.config import Settings

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from algorithms.studies.paper_results import PaperResults, TaskResults

SIMILAR = 0.05  # relative to the baseline's utility
FLAT = 0.05  # gain at the end of training, relative to the score that is reached
RATIOS = (0.5, 0.25)  # true ratios of deviations, for which the power of the test is reported
MIN_EVALUATIONS = 5  # of a learning curve, to tell whether it is flat


class Check(NamedTuple):
    """A criterion applied to results; ``passed`` is None if it is inconclusive.

    ``stopped_at`` is the step at which training stopped too early for an answer; None if that is not the reason.
    """

    criterion: str
    measured: str
    passed: bool | None
    stopped_at: int | None = None


class Verdict(NamedTuple):
    """Whether a claim is reproduced under a protocol, and the checks that decide it."""

    conclusion: Literal["reproduced", "not reproduced", "inconclusive"]
    checks: tuple[Check, ...]

    @property
    def text(self) -> str:
        """The conclusion, and the step at which training stopped if that was too early for another one."""
        steps = [check.stopped_at for check in self.checks if check.stopped_at is not None]
        early = self.conclusion == "inconclusive" and steps
        return f"{self.conclusion}: stopped at {max(steps):,} steps" if early else self.conclusion


class Criterion(Settings):
    """That what is measured of a task lies between two limits."""

    text: str
    task: str  # without the protocol
    measure: Literal["success", "progress", "difference", "relative_difference", "deviations", "front"]
    of: str = ""  # the learner, or the metric of the front
    above: float = -inf
    below: float = inf
    lasting: bool | None = None  # the answer that longer training could only confirm; None if it could change both

    def check(self, results: TaskResults) -> Check:
        """Apply it to results of its task; KeyError if some are missing."""
        estimate, measured, unit = MEASURES[self.measure](results, self.of)
        passed = is_between(estimate, unit * self.above, unit * self.below)
        if passed is None or passed is self.lasting or is_settled(results):
            return Check(self.text, measured, passed)
        return Check(self.text, measured, None, results.steps)


class Claim(Settings):
    """A claim of the paper, the figures that show it, and what decides it."""

    number: int
    statement: str
    figures: list[int]
    criteria: list[Criterion]

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
        passed = {check.passed for check in checks}
        return Verdict(
            "not reproduced" if False in passed else "inconclusive" if None in passed else "reproduced", checks
        )

    def verdicts(self, results: PaperResults) -> dict[str, Verdict]:
        """The verdicts by protocol; only protocols with results for all tasks."""
        judged = {protocol: self.judge(results, protocol) for protocol in results.tasks.get(self.tasks[0], {})}
        return {protocol: verdict for protocol, verdict in judged.items() if verdict is not None}


CLAIMS = [Claim(**claim) for claim in yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text("utf-8"))]


def compare(results: TaskResults) -> tuple[Estimate, Estimate, Estimate, Estimate]:
    """Utilities of A2C and MO-A2C: interquartile means over seeds, their difference, P(a run of MO-A2C is higher)."""
    first, second = (results.values(learner, results.utility) for learner in LABELS)
    return iqm(first), iqm(second), iqm_difference(second, first), probability_of_improvement(second, first)


def is_settled(results: TaskResults) -> bool:
    """Whether the learning curves were flat at the end of training.

    They are if, for every compared algorithm, the upper end of the interval over seeds of the gain (the mean of the
    last fifth of the evaluations minus that of the fifth before) is below FLAT times the mean of the last fifth. The
    score is the utility of the stochastic policy, for a front its hypervolume.
    """
    name = f"{FRONT}/{HYPERVOLUME}" if results.is_front else f"{STOCHASTIC}/{results.utility}"
    return all(
        _is_flat([curve[name] for curve in results.learning_curves(learner) if name in curve])
        for learner in ((FRONT_LEARNER,) if results.is_front else LABELS)
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


# ------------------------------------------------------------------------------------------------------------ measures
# Each gives an estimate, its text, and the unit of the limits that it is compared with.

Measured = tuple[Estimate, str, float]


def _success(results: TaskResults, learner: str) -> Measured:
    rate = iqm(results.values(learner, SUCCESS))
    return rate, f"success rate {percent(rate)}", 1.0


def _progress(results: TaskResults, learner: str) -> Measured:
    progress = iqm(results.values(learner, return_of("distance")))
    return progress, f"progress {shown(progress)} m", 1.0


def _difference(results: TaskResults, _: str) -> Measured:
    difference = compare(results)[2]
    return difference, f"difference {shown(difference)}", 1.0


def _relative_difference(results: TaskResults, _: str) -> Measured:
    baseline, difference = compare(results)[::2]
    unit = abs(baseline.value)
    return difference, f"difference {shown(difference)}, {SIMILAR:.0%} is {SIMILAR * unit:.2g}", unit


def _deviations(results: TaskResults, _: str) -> Measured:
    first, second = (results.values(learner, results.utility) for learner in (MULTI_OBJECTIVE, BASELINE))
    ratio, runs = spread_ratio(first, second), min(len(first), len(second))
    powers = [f"{spread_ratio_power(runs, true):.0%} for a true ratio of {true:g}" for true in RATIOS]
    return ratio, f"ratio of deviations {ratio.text()}; power of the test: {', '.join(powers)}", 1.0


def _front(results: TaskResults, metric: str) -> Measured:
    score = iqm(results.values(FRONT_LEARNER, metric, FRONT))
    return score, shown(score) + ("" if metric == CARDINALITY else " m"), 1.0


MEASURES: dict[str, Callable[[TaskResults, str], Measured]] = {
    "success": _success,
    "progress": _progress,
    "difference": _difference,
    "relative_difference": _relative_difference,
    "deviations": _deviations,
    "front": _front,
}
