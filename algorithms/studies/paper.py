"""The reproduction of the paper: a study of its tasks, whose results are judged, drawn and exported.

The name of a task of this study is ``TASK/PROTOCOL``, its title "task: protocol". A protocol is how a task is trained
and evaluated; the learners of a protocol are compared with each other.

The claims, and the criteria that decide them, are in ``paper_claims.yaml``. They were fixed before the runs were
trained; the one exception is the rule that learning curves must be flat, which was added afterwards
(docs/reproduction.md).

A criterion is decided by a 95% bootstrap interval over seeds: it passes, fails, or is inconclusive if the interval
contains the limit. If training stopped before the learning curves were flat (:func:`is_settled`), it is inconclusive
too, unless longer training could only confirm the answer. A claim is reproduced if all criteria pass, not reproduced if
one fails, and inconclusive otherwise.
Scores are interquartile means over seeds (Agarwal et al. 2021) of the final evaluation of the stochastic policy, which
is the policy that actor-critics optimise.
"""

from __future__ import annotations

import gzip
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
import polars as pl
import yaml

from algorithms.reporting import training_log
from algorithms.runs.run_directory import METRICS_FILE
from algorithms.studies.plan import StudyPlan
from algorithms.studies.results import frame_of, results_of
from algorithms.studies.settings import load_study
from mo_deepdrive.evaluation import metrics
from mo_deepdrive.evaluation.front import Front
from mo_deepdrive.evaluation.metrics import FRONT, HYPERVOLUME, STEP, STOCHASTIC, SUCCESS, MetricName
from mo_deepdrive.evaluation.statistics import (
    Estimate,
    iqm,
    iqm_difference,
    mean,
    probability_of_improvement,
    spread_ratio,
    spread_ratio_power,
)
from mo_deepdrive.suite import read_rows, write_rows
from mo_deepdrive.support.atomic_io import atomic_write
from mo_deepdrive.support.names import nearest
from mo_deepdrive.world.config import Settings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from algorithms.reporting.training_log import Columns
    from algorithms.studies.plan import ArmRuns
    from algorithms.studies.settings import Study
    from mo_deepdrive.suite import Row

# A quick reproduction: protocols, seeds, share of the steps, final episodes, and evaluations during training.
QUICK_PROTOCOLS, QUICK_SEEDS, QUICK_SHARE, QUICK_EPISODES, QUICK_EVALUATIONS = ("printed", "best"), 3, 10, 200, 5
SCORES_FILE, CURVES_FILE = "reproduction_scores.csv", "reproduction_curves.csv.gz"
CURVE_KEYS = {"task": pl.String, "learner": pl.String, "seed": pl.Int64, STEP: pl.Int64}
LABELS = {"a2c": "A2C", "mo_a2c": "MO-A2C"}  # of the two algorithms that are compared, by their keys in the study
# The task with an unknown utility, and the learner of its front.
FRONT_TASK, FRONT_LEARNER = "one_waypoint_front", "pcn"
SIMILAR = 0.05  # relative to the baseline's utility
FLAT = 0.05  # gain at the end of training, relative to the score that is reached
RATIOS = (0.5, 0.25)  # true ratios of deviations, for which the power of the test is reported
MIN_EVALUATIONS = 5  # of a learning curve, to tell whether it is flat


# -------------------------------------------------------------------------------------------------------------- plan


def load_paper(path: str | Path) -> Study:
    """Read the study of the paper: a YAML file, or the name of a shipped one."""
    study = load_study(path)
    for key, task in study.tasks.items():
        if "/" not in key or ": " not in (task.title or ""):
            raise ValueError(f"task {key!r} must be named TASK/PROTOCOL, with a title 'task: protocol'")
        needed = {SUCCESS, metrics.end_by(metrics.COLLISION), metrics.return_of("distance")}
        if key.startswith("intersection"):
            needed |= {metrics.TOTAL_UTILITY_ESR, metrics.vehicle_prefix(0, 2) + metrics.return_of("distance")}
        elif key.startswith(FRONT_TASK):
            needed = {metrics.CARDINALITY}
        if missing := needed - {*study.columns}:
            raise ValueError(f"task {key!r}: the report needs the columns {', '.join(sorted(missing))}")
    return study


def paper_plan(study: Study, tasks: Sequence[str], *, seeds: int | None = None, quick: bool = False) -> StudyPlan:
    """The arms to train for some tasks, in all their protocols, or quick ones, with so many ``seeds`` at most."""
    known = {key.partition("/")[0] for key in study.tasks}
    for name in (name for name in tasks if name not in known):
        raise ValueError(f"task {name!r} is unknown; {nearest(name, known)}")
    selected = [key for key in study.tasks if key.partition("/")[0] in tasks]
    if quick:
        selected = [key for key in selected if key.partition("/")[2] in QUICK_PROTOCOLS]
    if count := seeds or (min(QUICK_SEEDS, len(study.seeds)) if quick else None):
        first, tasks_of_fewer = study.seeds[0], {}
        for key, task in study.tasks.items():
            tasks_of_fewer[key] = task.model_copy(update={"seeds": task.seeds and task.seeds[:count]})
        study = study.model_copy(update={"tasks": tasks_of_fewer, "seeds": list(range(first, first + count))})
    plan = StudyPlan(study, selected)
    for arm in plan.arms if quick else ():
        steps = arm.values["training"]["total_timesteps"] // QUICK_SHARE
        arm.values["training"]["total_timesteps"] = steps
        shorter = {"interval": steps // QUICK_EVALUATIONS, "final_episodes": QUICK_EPISODES}
        arm.values["evaluation"] = {**(arm.values.get("evaluation") or {}), **shorter}
    return plan


# ------------------------------------------------------------------------------------------------------------- results


@dataclass(frozen=True)
class TaskResults:
    """The results of a task under one protocol; its scores and curves are those rows of :class:`PaperResults`."""

    study: Study
    key: str  # TASK/PROTOCOL
    scores: pl.DataFrame
    curves: pl.DataFrame

    @property
    def is_front(self) -> bool:
        """Whether the utility is unknown."""
        return self.key.startswith(FRONT_TASK)

    @property
    def vehicles(self) -> int:
        """The number of learning vehicles."""
        return 2 if self.key.startswith("intersection") else 1

    @property
    def score(self) -> MetricName:
        """By what learners are compared: the utility, with two vehicles the sum of theirs, or the hypervolume."""
        utility = metrics.TOTAL_UTILITY_ESR if self.vehicles > 1 else metrics.UTILITY_ESR
        return MetricName(FRONT, "", HYPERVOLUME) if self.is_front else MetricName(STOCHASTIC, "", utility)

    @property
    def titles(self) -> tuple[str, str]:
        """The titles of the task and of the protocol."""
        title, _, conditions = (self.study.tasks[self.key].title or "").partition(": ")
        return title, conditions

    @property
    def labels(self) -> dict[str, str]:
        """The labels of the learners with scores, by name."""
        scored = {*self.scores["learner"]}
        learners = self.study.learners_of(self.key)
        return {name: learner.label or name for name, learner in learners.items() if name in scored}

    @property
    def compared(self) -> tuple[str, ...]:
        """The learners that are judged: A2C and MO-A2C, or PCN; none of an ablation."""
        groups = (tuple(LABELS), (FRONT_LEARNER,))
        return next((group for group in groups if {*group} == self.study.learners_of(self.key).keys()), ())

    @property
    def steps(self) -> int:
        """The number of environment steps of a run."""
        return self.scores["steps"].cast(pl.Int64).max() or 0  # type: ignore[return-value]

    def by_seed(self, learner: str, metric: str, policy: str | None = None) -> dict[int, float]:
        """The metric of every run of a learner, by its seed."""
        chosen = self.scores.filter(learner=learner, column=metric, policy=policy or self.score.policy)
        return dict(chosen.select("seed", "value").iter_rows())

    def values(self, learner: str, metric: str) -> NDArray[np.float64]:
        """Values (seeds,) of a metric, one per run, in the order of seeds; KeyError if there are none."""
        by_seed = self.by_seed(learner, metric)
        if not by_seed:
            raise KeyError(f"no run of {self.key}/{learner} has {metric!r}")
        return np.array([*by_seed.values()], dtype=np.float64)

    def learning_curves(self, learner: str) -> list[Columns]:
        """Learning curves of all runs of a learner, in the order of seeds."""
        curves = self.curves.filter(learner=learner).drop("task", "learner").sort("seed", STEP)
        runs = curves.partition_by("seed", maintain_order=True, include_key=False)
        known = ([column for column in run if not column.is_null().all()] for run in runs)
        return [{column.name: column.to_numpy().astype(np.float64) for column in columns} for columns in known]


@dataclass(frozen=True)
class PaperResults:
    """Scores and learning curves of all runs of the paper's study."""

    study: Study
    rows: Sequence[Row]
    # A row per run and evaluation during training: CURVE_KEYS, then metrics whose names start with the policy.
    curves: pl.DataFrame

    @cached_property
    def scores(self) -> pl.DataFrame:
        """The rows with a value, in the order of seeds."""
        return frame_of(self.rows).filter(pl.col("value").is_not_null()).sort("seed", maintain_order=True)

    @cached_property
    def tasks(self) -> dict[str, dict[str, TaskResults]]:
        """What has scores, by task and protocol, in the order of the study."""
        scored = self.scores.partition_by("task", as_dict=True)
        tasks: dict[str, dict[str, TaskResults]] = {}
        for key in (key for key in self.study.tasks if (key,) in scored):
            task, _, protocol = key.partition("/")
            results = TaskResults(self.study, key, scored[key,], self.curves.filter(task=key))
            tasks.setdefault(task, {})[protocol] = results
        return tasks

    def write(self, directory: Path) -> None:
        """Write both tables."""
        write_rows(directory / SCORES_FILE, self.rows)
        # Without name and time in the header, equal curves give equal bytes.
        atomic_write(directory / CURVES_FILE, gzip.compress(self.curves.write_csv().encode(), mtime=0))

    @classmethod
    def read(cls, study: Study, directory: Path) -> PaperResults:
        """Read both tables from the directory that :meth:`write` wrote to."""
        try:
            table = gzip.decompress((directory / CURVES_FILE).read_bytes())
            curves = pl.read_csv(table, infer_schema=False)
            schema = pl.Schema({name: CURVE_KEYS.get(name, pl.Float64) for name in curves.columns})
            return cls(study, read_rows(directory / SCORES_FILE), curves.cast(schema))
        except (OSError, EOFError, ValueError, pl.exceptions.PolarsError) as error:
            raise ValueError(f"no results of a reproduction in {str(directory)!r}: {error}") from None


def gather(plan: StudyPlan, runs: Sequence[ArmRuns], directory: Path) -> PaperResults:
    """The results of all runs that have finished in the directory of the study."""
    rows = results_of(plan, runs, directory)
    for row in [row for row in rows if row.column == HYPERVOLUME]:
        front = Front.read(directory / row.source)
        if "distance" in front.objectives:
            distances = front.returns[:, front.objectives.index("distance")]
            for column, value in (
                (metrics.LOWEST_DISTANCE, distances.min()),
                (metrics.HIGHEST_DISTANCE, distances.max()),
            ):
                rows.append(replace(row, column=column, value=float(value), low=None, high=None))
    logs = [pl.DataFrame(schema=CURVE_KEYS)]
    for (task, learner), run in [(arm_runs.arm.key, run) for arm_runs in runs for run in arm_runs.final]:
        log = training_log.read_rows(directory / run.directory / METRICS_FILE).fill_nan(None)
        names = [name for name in log.columns if name.startswith(metrics.EVALUATION)]
        renamed = (pl.col(name).cast(pl.Float32).alias(name.removeprefix(metrics.EVALUATION)) for name in names)
        evaluated = log.filter(pl.any_horizontal(pl.col(name).is_not_null() for name in names))
        about = {"task": pl.lit(task), "learner": pl.lit(learner), "seed": pl.lit(run.seed, pl.Int64)}
        logs.append(evaluated.select(STEP, *renamed).with_columns(**about))
    curves = pl.concat(logs, how="diagonal")
    curves = curves.select(*CURVE_KEYS, *sorted({*curves.columns} - {*CURVE_KEYS}))
    return PaperResults(plan.study, rows, curves)


# -------------------------------------------------------------------------------------------------------------- claims


class Check(NamedTuple):
    """A criterion applied to results."""

    criterion: str
    measured: str
    passed: bool | None  # None if it is inconclusive
    stopped_at: int | None = None  # the step at which training stopped too early for an answer, if that is the reason


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
    measure: str  # a metric of one learner, or what is compared between A2C and MO-A2C
    of: str = ""  # the learner
    above: float = -inf
    below: float = inf
    lasting: bool | None = None  # the answer that longer training could only confirm; None if it could change both

    def check(self, results: TaskResults) -> Check:
        """Apply it to results of its task; KeyError if some are missing."""
        estimate, measured, unit = self.measured(results)
        passed = is_between(estimate, unit * self.above, unit * self.below)
        if passed is None or passed is self.lasting or is_settled(results):
            return Check(self.text, measured, passed)
        return Check(self.text, measured, None, results.steps)

    def measured(self, results: TaskResults) -> tuple[Estimate, str, float]:
        """What is measured, its text, and the unit of the limits that it is compared with."""
        if self.of:
            score = iqm(results.values(self.of, self.measure))
            text = percent(score) if self.measure == SUCCESS else shown(score)
            return score, text if self.measure in (SUCCESS, metrics.CARDINALITY) else f"{text} m", 1.0
        if self.measure == "deviations":
            second, first = (results.values(learner, results.score.metric) for learner in LABELS)
            ratio, runs = spread_ratio(first, second), min(len(first), len(second))
            powers = [f"{spread_ratio_power(runs, true):.0%} for a true ratio of {true:g}" for true in RATIOS]
            return ratio, f"ratio of deviations {ratio.text()}; power of the test: {', '.join(powers)}", 1.0
        baseline, _, difference, _ = compare(results)
        text, unit = f"difference {shown(difference)}", abs(baseline.value)
        if self.measure == "difference":
            return difference, text, 1.0
        return difference, f"{text}, {SIMILAR:.0%} is {SIMILAR * unit:.2g}", unit


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
        if False in passed:
            return Verdict("not reproduced", checks)
        return Verdict("inconclusive" if None in passed else "reproduced", checks)

    def verdicts(self, results: PaperResults) -> dict[str, Verdict]:
        """The verdicts by protocol; only protocols with results for all tasks."""
        judged = {protocol: self.judge(results, protocol) for protocol in results.tasks.get(self.tasks[0], {})}
        return {protocol: verdict for protocol, verdict in judged.items() if verdict is not None}


CLAIMS_FILE = Path(__file__).with_name("paper_claims.yaml")
CLAIMS = [Claim(**claim) for claim in yaml.safe_load(CLAIMS_FILE.read_text("utf-8"))]


def compare(results: TaskResults) -> tuple[Estimate, Estimate, Estimate, Estimate]:
    """Utilities of A2C and MO-A2C: interquartile means over seeds, their difference, P(a run of MO-A2C is higher)."""
    first, second = (results.values(learner, results.score.metric) for learner in LABELS)
    return (
        iqm(first),
        iqm(second),
        iqm_difference(second, first),
        probability_of_improvement(second, first),
    )


def is_settled(results: TaskResults) -> bool:
    """Whether the learning curves were flat at the end of training.

    They are if, for every compared algorithm, the upper end of the interval over seeds of the gain (the mean of the
    last fifth of the evaluations minus that of the fifth before) is below FLAT times the mean of the last fifth. The
    score is the utility of the stochastic policy, for a front its hypervolume. Curves that are too short are not.
    """
    name = f"{results.score.policy}/{results.score.metric}"
    for learner in results.compared:
        curves = [curve[name] for curve in results.learning_curves(learner) if name in curve]
        known = [curve[np.isfinite(curve)] for curve in curves]
        if not known or min(map(len, known)) < MIN_EVALUATIONS:
            return False
        fifths = [(curve[-2 * (n := len(curve) // 5) : -n].mean(), curve[-n:].mean()) for curve in known]
        before, last = np.array(fifths).T
        if not is_between(mean(last - before), -inf, FLAT * abs(float(last.mean()))):
            return False
    return True


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
