"""The tables of the suite: normalised scores per task and learner, aggregates per track, and performance profiles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from algorithms.studies.results import FINISHED
from mo_deepdrive.evaluation.metrics import GREEDY, STOCHASTIC
from mo_deepdrive.evaluation.statistics import (
    Estimate,
    improvement_over_tasks,
    iqm,
    iqm_over_tasks,
    mean,
    mean_difference,
)
from mo_deepdrive.suite.scorers import SCORE
from mo_deepdrive.suite.scoring import FAILED
from mo_deepdrive.suite.tasks import LOWEST
from mo_deepdrive.support.names import nearest

if TYPE_CHECKING:
    from collections.abc import Container, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from algorithms.reporting.tables import Rows
    from mo_deepdrive.suite import Row, Suite, Task

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


@dataclass(frozen=True)
class Scores:
    """The normalised scores of a learner on a task.

    Attributes:
        values: (n,) of the runs that finished or failed.
        failed: number of those that failed.
        unfinished: number of further runs that have no score yet.
    """

    values: NDArray[np.float64]
    failed: int
    unfinished: int

    @property
    def text(self) -> str:
        """The interquartile mean with its interval, and what is missing."""
        notes = [
            f"{number} {what}" for number, what in ((self.failed, FAILED), (self.unfinished, "unfinished")) if number
        ]
        value = iqm(self.values).text() if len(self.values) else ""
        return f"{value} ({', '.join(notes)})" if notes else value


class Scoreboard:
    """The scores of a table of results, normalised.

    Args:
        results: of tasks of the suite.
        suite: with their floors and ceilings.

    Attributes:
        tasks: that have results, by id, in the order of the suite.
        learners: in the order of the results.

    Raises:
        ValueError: if a task is unknown, or a result is of another version.
    """

    def __init__(self, results: Sequence[Row], suite: Suite):
        for result in results:
            suite.task(result.task)
            if result.version not in (suite.version, 0):
                raise ValueError(
                    f"the results of {result.learner} on {result.task} are of version {result.version} of the suite; "
                    f"its version is {suite.version}, by which their runs must be scored again"
                )
        self.suite = suite
        self.tasks: dict[str, Task] = {
            name: task for name, task in suite.tasks.items() if any(result.task == name for result in results)
        }
        self.learners = list(dict.fromkeys(result.learner for result in results))
        self._results = results

    def scores(self, task: str, learner: str, policy: str | None = None) -> Scores | None:
        """The scores of a learner on a task; None if it was not trained on it.

        Args:
            task: its id.
            learner: its name.
            policy: "greedy" or "stochastic"; None for the one that is ranked.
        """
        mine = [result for result in self._results if (result.task, result.learner) == (task, learner)]
        if not mine:
            return None
        policy = policy or self.tasks[task].policy
        values = [
            each.value for each in mine if (each.policy, each.column) == (policy, SCORE) and each.value is not None
        ]
        states = {each.seed: each.state for each in mine}
        failed = sum(state == FAILED for state in states.values())
        normalised = np.asarray(self.tasks[task].normalised(np.array(values, dtype=np.float64)))
        return Scores(
            np.append(normalised, np.full(failed, LOWEST)),
            failed,
            sum(state not in (FINISHED, FAILED) for state in states.values()),
        )

    def task_table(self, *, ranked: bool = True) -> Rows:
        """Scores by task and learner; with ``ranked`` false, those of the policy that is not ranked.

        The last column names the best learner, if its interval lies above those of all others.
        """
        rows = [["task", "track", "floor", "ceiling", "policy", *self.learners, "clearly best"]]
        for name, task in self.tasks.items():
            policy = task.policy if ranked else {GREEDY: STOCHASTIC, STOCHASTIC: GREEDY}[task.policy]
            found = [self.scores(name, learner, policy) for learner in self.learners]
            bounds = [f"{task.floor.value:.4g}", f"{task.ceiling.value:.4g} ({task.ceiling.kind})"]
            texts = ["" if each is None else each.text for each in found]
            best = _clearly_best(
                {key: each for key, each in zip(self.learners, found, strict=True) if each is not None}
            )
            rows.append([name, task.track if task.counted else "not counted", *bounds, policy, *texts, best])
        return rows

    def track_tables(self, against: str | None = None) -> list[tuple[str, Rows]]:
        """A table per track with its name: a row per learner, the best first.

        Args:
            against: the learner that others are compared with; None for :data:`BASELINE` if there is one, else the
                first one.

        Raises:
            ValueError: if there is no such learner.
        """
        if against is not None and against not in self.learners:
            raise ValueError(f"--against {against}: there are no results of it; {nearest(against, self.learners)}")
        tables: list[tuple[str, Rows]] = []
        for track in dict.fromkeys(task.track for task in self.tasks.values()):
            by_learner = self.of_track(track)
            if not by_learner:
                continue
            other = against or (BASELINE if BASELINE in by_learner else next(iter(by_learner)))
            total = sum(task.counted and task.track == track for task in self.suite.tasks.values())
            header = ["learner", "tasks", "runs", FAILED, "IQM over tasks", f"P(better than {other})", "worst task"]
            ranked: list[tuple[bool, float, list[str]]] = []
            for learner, scores in by_learner.items():
                together = iqm_over_tasks([each.values for each in scores.values()])
                worst = min(scores, key=lambda task: iqm(scores[task].values).value)
                row = [
                    learner,
                    f"{len(scores)} of {total}",
                    str(sum(len(each.values) for each in scores.values())),
                    str(sum(each.failed for each in scores.values())),
                    together.text(),
                    _improvement(scores, by_learner.get(other, {})) if learner != other else "",
                    f"{worst} {iqm(scores[worst].values).text()}",
                ]
                ranked.append((len(scores) < total, -together.value, row))
            tables.append((track, [header, *(row for *_, row in sorted(ranked))]))
        return tables

    def of_track(self, track: str) -> dict[str, dict[str, Scores]]:
        """The scores of a track's counted tasks, by learner and task; only those with a run that has ended."""
        found: dict[str, dict[str, Scores]] = {}
        for learner in self.learners:
            for name, task in self.tasks.items():
                scores = self.scores(name, learner) if task.counted and task.track == track else None
                if scores is not None and len(scores.values):
                    found.setdefault(learner, {})[name] = scores
        return found

    def comparison(self, baseline: str | None, own: Container[str] = ()) -> tuple[Rows, Rows]:
        """Scores of learners by tasks, and their differences from a baseline; the last row is the mean over tasks.

        The tasks are those of all learners that are shown: of ``own``, the baseline, and others with all these tasks.

        Args:
            baseline: with which the others are compared; None for :data:`BASELINE` if there is one, else the first.
            own: learners that are shown in any case; empty for all.

        Raises:
            ValueError: if there are no results of the baseline, or no task has results of it and of all of ``own``.
        """
        if baseline is not None and baseline not in self.learners:
            raise ValueError(f"--baseline {baseline}: there are no results of it; {nearest(baseline, self.learners)}")
        other = baseline or (BASELINE if BASELINE in self.learners else self.learners[0])
        runs = {(task, learner): self.runs(task, learner) for task in self.tasks for learner in self.learners}
        first = [other, *(each for each in self.learners if each in own and each != other)]
        tasks = [task for task in self.tasks if all(runs[task, learner] for learner in first)]
        if not tasks:
            raise ValueError(f"no task has results of all of {', '.join(first)}")
        shown = [each for each in self.learners if each in first or all(runs[task, each] for task in tasks)]
        scores: Rows = [["task", *shown]]
        differences: Rows = [["task", *(f"{each} - {other}" for each in shown if each != other)]]
        for task in tasks:
            scores.append([task, *(mean(np.array([*runs[task, each].values()])).text() for each in shown)])
            differences.append(
                [task, *(_difference(runs[task, each], runs[task, other]).text() for each in shown if each != other)]
            )

        def over_tasks(learner: str) -> dict[int, float]:
            """Of every seed with a run on all tasks, the mean of its scores."""
            seeds = set.intersection(*({*runs[task, learner]} for task in tasks))
            return {seed: float(np.mean([runs[task, learner][seed] for task in tasks])) for seed in sorted(seeds)}

        means = {each: over_tasks(each) for each in shown}
        scores.append(
            ["mean", *(mean(np.array([*found.values()])).text() if found else "" for found in means.values())]
        )
        differences.append(
            [
                "mean",
                *(
                    _difference(means[each], means[other]).text() if means[each] and means[other] else ""
                    for each in shown
                    if each != other
                ),
            ]
        )
        return scores, differences

    def runs(self, task: str, learner: str) -> dict[int, float]:
        """The normalised score of every run of a learner on a task, by its seed; a failed run has the lowest."""
        mine = [row for row in self._results if (row.task, row.learner) == (task, learner)]
        found = {row.seed: LOWEST for row in mine if row.state == FAILED}
        policy = self.tasks[task].policy
        for row in mine:
            if (row.policy, row.column) == (policy, SCORE) and row.normalised is not None:
                found[row.seed] = row.normalised
        return found

    def draw_profiles(self, path: Path, labels: Mapping[str, str]) -> None:
        """Draw the performance profiles: the share of runs that score at least so much, the mean over tasks.

        Args:
            path: of the picture.
            labels: what learners are called there, by their names; others by their names.

        Raises:
            ValueError: if no run has ended, or the ending of the path is not an image format.
            OSError: if it cannot be written.
        """
        from matplotlib.figure import Figure

        from algorithms.reporting.style import algorithm_colours, figure_style, save_figure

        tracks = {
            track: found
            for track in dict.fromkeys(task.track for task in self.tasks.values())
            if (found := self.of_track(track))
        }
        if not tracks:
            raise ValueError("no run of a task that counts has ended yet")
        colours = algorithm_colours(self.learners)
        with figure_style():
            figure = Figure(figsize=(4.2 * len(tracks), 3.4), layout="constrained")
            for axes, (track, by_learner) in zip(
                np.atleast_1d(figure.subplots(1, len(tracks), sharey=True)), tracks.items(), strict=True
            ):
                for learner, scores in by_learner.items():
                    shares = [(each.values[:, None] >= PROFILE).mean(axis=0) for each in scores.values()]
                    axes.plot(
                        PROFILE, np.mean(shares, axis=0), color=colours[learner], label=labels.get(learner, learner)
                    )
                axes.set(title=track, xlabel="score (floor 0, ceiling 1)", ylim=(-0.02, 1.02))
                axes.legend(frameon=False, fontsize=8)
            figure.axes[0].set_ylabel("share of runs that score at least this")
            save_figure(figure, path)


def _difference(first: dict[int, float], second: dict[int, float]) -> Estimate:
    """The mean difference of runs by their seeds: paired where the seeds are the same, else of independent samples."""
    if first.keys() == second.keys():
        return mean(np.array([first[seed] - second[seed] for seed in first]))
    return mean_difference(np.array([*first.values()]), np.array([*second.values()]))


def _clearly_best(scores: dict[str, Scores]) -> str:
    """The learner whose interval lies above those of all others; empty if there is none."""
    found: dict[str, Estimate] = {name: iqm(each.values) for name, each in scores.items() if len(each.values)}
    if len(found) < 2:
        return ""
    best = max(found, key=lambda name: found[name].value)
    low, highs = found[best].low, [each.high for name, each in found.items() if name != best]
    clear = low is not None and all(high is not None and high < low for high in highs)
    return best if clear else ""


def _improvement(first: dict[str, Scores], second: dict[str, Scores]) -> str:
    """The probability that a run of ``first`` scores higher than one of ``second``, over the tasks of both."""
    common = [task for task in first if task in second]
    if not common:
        return ""
    return improvement_over_tasks(
        [first[task].values for task in common], [second[task].values for task in common]
    ).text()
