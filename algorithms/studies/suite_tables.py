"""The tables of the suite: normalised scores per task and learner, aggregates per track, and performance profiles."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from statistics import fmean, median
from typing import TYPE_CHECKING

import numpy as np

from algorithms.studies.results import FINISHED
from mo_deepdrive import suite
from mo_deepdrive.evaluation.metrics import GREEDY, STOCHASTIC
from mo_deepdrive.evaluation.statistics import (
    Estimate,
    improvement_over_tasks,
    iqm,
    iqm_over_tasks,
    mean,
    mean_difference,
)
from mo_deepdrive.suite.results import FAILED
from mo_deepdrive.suite.scorers import SCORE
from mo_deepdrive.suite.tasks import LOWEST
from mo_deepdrive.support.names import nearest

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from algorithms.reporting.tables import Rows
    from mo_deepdrive.suite import Row, Task

BASELINE = "lintune"  # which others are compared with, if there are results of it
NOTE = (
    "Scores between floor (0) and ceiling (1) of each task: interquartile means over seeds with 95% bootstrap "
    f"intervals. A run that failed counts as {LOWEST:g}; the number of runs that are not finished is in brackets."
)
MEANS_NOTE = (
    "Scores between floor (0) and ceiling (1) of each task, and differences of learners, paired where their seeds are "
    f"the same: means over seeds with 95% bootstrap intervals. A run that failed counts as {LOWEST:g}."
)
PROFILE = np.linspace(-0.25, 1.25, 151)  # scores at which a performance profile is drawn


def read_results(path: Path) -> list[Row]:
    """The rows of a table of results of the suite."""
    rows = suite.read_rows(path)
    if not rows:
        raise ValueError(f"there are no results in {str(path)!r}; mo-deepdrive suite run writes a results.csv")
    for row in rows:
        try:
            suite.check_of_suite(row)
        except ValueError as error:
            raise ValueError(f"{str(path)!r} has {error}") from None
    return rows


def minutes_per_run(rows: Iterable[Row]) -> dict[str, float]:
    """The median minutes of a core that a run takes, by task, of those for which they are known."""
    seconds: dict[str, dict[tuple[str, int], float]] = defaultdict(dict)
    for row in rows:
        if row.cpu_seconds is not None and row.state == FINISHED:
            seconds[row.task][row.learner, row.seed] = row.cpu_seconds
    return {task: median(runs.values()) / 60.0 for task, runs in seconds.items()}


@dataclass(frozen=True)
class Scores:
    """The normalised scores of a learner on a task, of the runs that finished or failed."""

    by_seed: dict[int, float]
    failed: int  # how many of those failed
    unfinished: int  # further runs, which have no score yet

    @property
    def values(self) -> NDArray[np.float64]:
        """(n,) the scores."""
        return np.array([*self.by_seed.values()], dtype=np.float64)

    @property
    def iqm(self) -> Estimate:
        """The interquartile mean with its interval."""
        return iqm(self.values)

    @property
    def text(self) -> str:
        """The interquartile mean with its interval, and what is missing."""
        missing = ((self.failed, FAILED), (self.unfinished, "unfinished"))
        notes = [f"{number} {state}" for number, state in missing if number]
        value = self.iqm.text() if self.by_seed else ""
        return f"{value} ({', '.join(notes)})" if notes else value


class Scoreboard:
    """The normalised scores of a table of results, of tasks of the suite in its version."""

    def __init__(self, results: Sequence[Row]):
        self._rows: dict[tuple[str, str], list[Row]] = defaultdict(list)
        for result in results:
            self._rows[result.task, result.learner].append(result)
        scored = {task for task, _ in self._rows}
        # In the order of the suite, and in that of the results.
        self.tasks: dict[str, Task] = {name: task for name, task in suite.load().tasks.items() if name in scored}
        self.learners = list(dict.fromkeys(result.learner for result in results))

    def scores(self, task: str, policy: str | None = None) -> dict[str, Scores]:
        """The scores of the learners that were trained on a task, by one policy; None for the one that is ranked."""
        policy, by_learner = policy or self.tasks[task].policy, {}
        for learner in self.learners:
            if rows := self._rows.get((task, learner)):
                scored = {row.seed: row.normalised for row in rows if (row.policy, row.column) == (policy, SCORE)}
                known = {seed: score for seed, score in scored.items() if score is not None}
                states = {row.seed: row.state for row in rows}
                failed = dict.fromkeys((seed for seed, state in states.items() if state == FAILED), LOWEST)
                unfinished = sum(state not in (FINISHED, FAILED) for state in states.values())
                by_learner[learner] = Scores(known | failed, len(failed), unfinished)
        return by_learner

    def _reference(self, option: str, learner: str | None) -> str:
        """The learner that others are compared with: the one that is named, or else :data:`BASELINE`, or the first."""
        if learner is not None and learner not in self.learners:
            raise ValueError(f"{option} {learner}: there are no results of it; {nearest(learner, self.learners)}")
        return learner or (BASELINE if BASELINE in self.learners else self.learners[0])

    def task_table(self, *, ranked: bool = True) -> Rows:
        """Scores by task and learner, and who is clearly best, by the policy that is ``ranked`` or by the other one."""
        rows = [["task", "track", "floor", "ceiling", "policy", *self.learners, "clearly best"]]
        for name, task in self.tasks.items():
            policy = task.policy if ranked else {GREEDY: STOCHASTIC, STOCHASTIC: GREEDY}[task.policy]
            scores = self.scores(name, policy)
            bounds = [f"{task.floor.value:.4g}", f"{task.ceiling.value:.4g} ({task.ceiling.kind})"]
            texts = [scores[learner].text if learner in scores else "" for learner in self.learners]
            track = task.track if task.counted else "not counted"
            rows.append([name, track, *bounds, policy, *texts, _clearly_best(scores)])
        return rows

    def track_tables(self, against: str | None = None) -> list[tuple[str, Rows]]:
        """A table per track with its name: a row per learner, the best first, compared with one, else BASELINE."""
        self._reference("--against", against)
        tables: list[tuple[str, Rows]] = []
        for track, by_learner in self._tracks().items():
            other = against or (BASELINE if BASELINE in by_learner else next(iter(by_learner)))
            total = sum(task.counted and task.track == track for task in suite.load().tasks.values())
            header = ["learner", "tasks", "runs", FAILED, "IQM over tasks", f"P(better than {other})", "worst task"]
            ranked: list[tuple[bool, float, list[str]]] = []
            for learner, by_task in by_learner.items():
                together = iqm_over_tasks([scores.values for scores in by_task.values()])
                worst = min(by_task, key=lambda task: by_task[task].iqm.value)
                runs = sum(len(scores.by_seed) for scores in by_task.values())
                failed = sum(scores.failed for scores in by_task.values())
                better = "" if learner == other else _improvement(by_task, by_learner.get(other, {}))
                about = [learner, f"{len(by_task)} of {total}", str(runs), str(failed)]
                row = [*about, together.text(), better, f"{worst} {by_task[worst].iqm.text()}"]
                ranked.append((len(by_task) < total, -together.value, row))
            tables.append((track, [header, *(row for *_, row in sorted(ranked))]))
        return tables

    def _tracks(self) -> dict[str, dict[str, dict[str, Scores]]]:
        """The scores by track, learner and task, of the tasks that count and have a run that has ended."""
        tracks: dict[str, dict[str, dict[str, Scores]]] = {}
        for name, task in self.tasks.items():
            for learner, scores in self.scores(name).items():
                if task.counted and scores.by_seed:
                    tracks.setdefault(task.track, {}).setdefault(learner, {})[name] = scores
        for track, of_track in tracks.items():
            tracks[track] = {learner: of_track[learner] for learner in self.learners if learner in of_track}
        return tracks

    def comparison(self, baseline: str | None, own: Container[str] = ()) -> tuple[Rows, Rows]:
        """Scores of learners by tasks, and their differences from a baseline; the last row is the mean over tasks.

        The tasks are those of all learners that are shown: of ``own``, the baseline (without one :data:`BASELINE` if it
        is there, else the first), and others with all these tasks.
        """
        other = self._reference("--baseline", baseline)
        # By task, learner and seed.
        runs = {task: {name: scores.by_seed for name, scores in self.scores(task).items()} for task in self.tasks}
        first = [other, *(learner for learner in self.learners if learner in own and learner != other)]
        tasks = [task for task in runs if all(runs[task].get(learner) for learner in first)]
        if not tasks:
            raise ValueError(f"no task has results of all of {', '.join(first)}")
        shown = [name for name in self.learners if name in first or all(runs[task].get(name) for task in tasks)]
        lines, means = {task: runs[task] for task in tasks}, {}
        for learner in shown:
            common = set.intersection(*({*runs[task][learner]} for task in tasks))
            means[learner] = {seed: fmean(runs[task][learner][seed] for task in tasks) for seed in sorted(common)}
        lines["mean"] = means
        others = [learner for learner in shown if learner != other]
        scores, differences = [["task", *shown]], [["task", *(f"{learner} - {other}" for learner in others)]]
        for name, line in lines.items():
            scores.append([name, *(_mean(line[learner]) for learner in shown)])
            differences.append([name, *(_difference(line[learner], line[other]) for learner in others)])
        return scores, differences

    def draw_profiles(self, path: Path, labels: Mapping[str, str]) -> None:
        """Draw the performance profiles: the share of runs that score at least so much, the mean over tasks."""
        from matplotlib.figure import Figure

        from algorithms.reporting.style import algorithm_colours, figure_style, save_figure

        tracks = self._tracks()
        if not tracks:
            raise ValueError("no run of a task that counts has ended yet")
        colours = algorithm_colours(self.learners)
        with figure_style():
            figure = Figure(figsize=(4.2 * len(tracks), 3.4), layout="constrained")
            panels = figure.subplots(1, len(tracks), sharey=True, squeeze=False)[0]
            for axes, (track, by_learner) in zip(panels, tracks.items(), strict=True):
                for learner, scores in by_learner.items():
                    shares = np.mean([(its.values[:, None] >= PROFILE).mean(axis=0) for its in scores.values()], axis=0)
                    axes.plot(PROFILE, shares, color=colours[learner], label=labels.get(learner, learner))
                axes.set(title=track, xlabel="score (floor 0, ceiling 1)", ylim=(-0.02, 1.02))
                axes.legend(frameon=False, fontsize=8)
            figure.axes[0].set_ylabel("share of runs that score at least this")
            save_figure(figure, path)


def _mean(runs: dict[int, float]) -> str:
    """The mean of runs by their seeds; empty if there are none."""
    return mean(np.array([*runs.values()])).text() if runs else ""


def _difference(first: dict[int, float], second: dict[int, float]) -> str:
    """The mean difference of runs by their seeds: paired where the seeds are the same, else of independent samples."""
    if not first or not second:
        return ""
    if first.keys() == second.keys():
        return _mean({seed: first[seed] - second[seed] for seed in first})
    return mean_difference(np.array([*first.values()]), np.array([*second.values()])).text()


def _clearly_best(scores: Mapping[str, Scores]) -> str:
    """The learner whose interval lies above those of all others; empty if there is none."""
    estimates = {learner: its.iqm for learner, its in scores.items() if its.by_seed}
    if len(estimates) < 2:
        return ""
    best = max(estimates, key=lambda learner: estimates[learner].value)
    low, highs = estimates[best].low, [other.high for learner, other in estimates.items() if learner != best]
    clear = low is not None and all(high is not None and high < low for high in highs)
    return best if clear else ""


def _improvement(first: Mapping[str, Scores], second: Mapping[str, Scores]) -> str:
    """The probability that a run of ``first`` scores higher than one of ``second``, over the tasks of both."""
    common = [task for task in first if task in second]
    pairs = ([scores[task].values for task in common] for scores in (first, second))
    return improvement_over_tasks(*pairs).text() if common else ""
