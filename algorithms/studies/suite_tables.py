"""The tables of the suite: normalised scores per task and learner, aggregates per track, and performance profiles."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import TYPE_CHECKING

import numpy as np

from algorithms.studies.results import FAILED, FINISHED
from mo_deepdrive.evaluation.metrics import GREEDY, STOCHASTIC
from mo_deepdrive.evaluation.statistics import (
    Estimate,
    improvement_over_tasks,
    iqm,
    iqm_over_tasks,
    mean,
    mean_difference,
)
from mo_deepdrive.names import nearest
from mo_deepdrive.suite.scorers import SCORE
from mo_deepdrive.suite.tasks import LOWEST

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from algorithms.reporting.seed_tables import Cells
    from algorithms.reporting.wide_tables import Rows
    from mo_deepdrive.suite import Row, Suite, Task

UNFINISHED = "unfinished"
BASELINE = "lintune"  # which others are compared with, if there are results of it
NOTE = (
    "Scores between floor (0) and ceiling (1) of each task: interquartile means over seeds with 95% bootstrap "
    "intervals, of the policy that a task ranks, on its scenarios of the test split. Averages are over the tasks that "
    f"they name, which all learners of the track have. A run that failed counts as {LOWEST:g}; the number of runs that "
    "are not finished is in brackets."
)
DIFFERENCES = (
    "Differences of the mean scores, learner minus {}, with 95% bootstrap intervals over seeds; paired by seed unless "
    f"the seeds are not the same (unpaired). Scores lie between floor (0) and ceiling (1); a failed run has {LOWEST:g}."
)
PROFILE = np.linspace(-0.25, 1.25, 151)  # scores at which a performance profile is drawn


@dataclass(frozen=True)
class Scores:
    """The normalised scores of a learner on a task.

    Attributes:
        by_seed: those of the runs that finished or failed.
        failed: number of those that failed.
        unfinished: number of further runs that have no score yet.
    """

    by_seed: Mapping[int, float]
    failed: int
    unfinished: int

    @property
    def values(self) -> NDArray[np.float64]:
        """(n,) in the order of the results."""
        return np.array([*self.by_seed.values()], dtype=np.float64)

    @property
    def text(self) -> str:
        """The interquartile mean with its interval, and what is missing."""
        notes = [
            f"{number} {what}" for number, what in ((self.failed, FAILED), (self.unfinished, UNFINISHED)) if number
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
        found = {
            each.seed: float(self.tasks[task].normalised(each.value))
            for each in mine
            if (each.policy, each.column) == (policy, SCORE) and each.value is not None
        }
        failed = dict.fromkeys((each.seed for each in mine if each.state == FAILED), LOWEST)
        unfinished = {each.seed for each in mine if each.state not in (FINISHED, FAILED)}
        return Scores(found | failed, len(failed), len(unfinished))

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
        """A table per track with its name: a row per learner, the best first by the tasks that all of them have.

        Args:
            against: the learner that others are compared with; None for :data:`BASELINE` if there is one, else the
                first one.

        Raises:
            ValueError: if there is no such learner.
        """
        self.check_learners("--baseline", [] if against is None else [against])
        tables: list[tuple[str, Rows]] = []
        for track in dict.fromkeys(task.track for task in self.tasks.values()):
            by_learner = self.of_track(track)
            if not by_learner:
                continue
            other = against or (BASELINE if BASELINE in by_learner else next(iter(by_learner)))
            total = sum(task.counted and task.track == track for task in self.suite.tasks.values())
            common = common_tasks(by_learner)
            average = f"IQM over {', '.join(common) or 'no common task'}"
            header = ["learner", "tasks", "runs", FAILED, average, f"P(better than {other})", "worst task"]
            ranked: list[tuple[float, list[str]]] = []
            for learner, scores in by_learner.items():
                together = iqm_over_tasks([scores[task].values for task in common]) if common else None
                worst = min(scores, key=lambda task: iqm(scores[task].values).value)
                row = [
                    learner,
                    f"{len(scores)} of {total}",
                    str(sum(len(each.values) for each in scores.values())),
                    str(sum(each.failed for each in scores.values())),
                    together.text() if together else "",
                    _improvement(scores, by_learner.get(other, {})) if learner != other else "",
                    f"{worst} {iqm(scores[worst].values).text()}",
                ]
                ranked.append((-together.value if together else 0.0, row))
            tables.append((track, [header, *(row for *_, row in sorted(ranked))]))
        return tables

    def check_learners(self, option: str, names: Sequence[str]) -> None:
        """Refuse learners that there are no results of.

        Raises:
            ValueError: naming the option, the learner and those that there are.
        """
        for name in names:
            if name not in self.learners:
                raise ValueError(f"{option} {name}: there are no results of it; {nearest(name, self.learners)}")

    def tidy_scores(self) -> Cells:
        """The scores, one a row; then averages of each track over the tasks that all its learners have."""
        rows: Cells = [["task", "learner", "n", FAILED, UNFINISHED, "iqm", "low", "high"]]
        for name in self.tasks:
            for learner in self.learners:
                if (each := self.scores(name, learner)) is not None:
                    found = astuple(iqm(each.values)) if each.by_seed else (None, None, None)
                    rows.append([name, learner, len(each.by_seed), each.failed, each.unfinished, *found])
        for track in dict.fromkeys(task.track for task in self.tasks.values()):
            by_learner = self.of_track(track)
            if len(tasks := common_tasks(by_learner)) < 2:
                continue
            for learner, scores in by_learner.items():
                those = [scores[task] for task in tasks]
                counts = np.sum([[len(each.by_seed), each.failed, each.unfinished] for each in those], axis=0).tolist()
                found = astuple(iqm_over_tasks([each.values for each in those]))
                rows.append([f"IQM over {', '.join(tasks)}", learner, *counts, *found])
        return rows

    def tidy_differences(self, baseline: str) -> Cells:
        """The difference of each learner's mean score to that of another one, a row per task; paired by equal seeds."""
        rows: Cells = [["task", "learner", "baseline", "n", "n_baseline", "paired", "mean", "low", "high"]]
        for name in self.tasks:
            other = self.scores(name, baseline)
            for learner in self.learners:
                mine = self.scores(name, learner)
                if learner == baseline or not mine or not other or not mine.by_seed or not other.by_seed:
                    continue
                paired = mine.by_seed.keys() == other.by_seed.keys()
                if paired:
                    found = mean(np.array([value - other.by_seed[seed] for seed, value in mine.by_seed.items()]))
                else:
                    found = mean_difference(mine.values, other.values)
                counts = [len(mine.by_seed), len(other.by_seed), int(paired)]
                rows.append([name, learner, baseline, *counts, *astuple(found)])
        return rows

    def of_track(self, track: str) -> dict[str, dict[str, Scores]]:
        """The scores of a track's counted tasks, by learner and task; only those with a run that has ended."""
        found: dict[str, dict[str, Scores]] = {}
        for learner in self.learners:
            for name, task in self.tasks.items():
                scores = self.scores(name, learner) if task.counted and task.track == track else None
                if scores is not None and len(scores.values):
                    found.setdefault(learner, {})[name] = scores
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


def tasks_by_learners(tidy: Cells, labels: Mapping[str, str]) -> Rows:
    """The numbers of a tidy table as text, with a row per task and a column per learner.

    Args:
        tidy: of :meth:`Scoreboard.tidy_scores` or :meth:`Scoreboard.tidy_differences`.
        labels: what learners are called, by their names; others by their names.
    """
    texts: dict[tuple[str, str], str] = {}
    for row in tidy[1:]:
        of = dict(zip(tidy[0], row, strict=True))
        notes = [f"{of[what]} {what}" for what in (FAILED, UNFINISHED) if of.get(what)]
        notes += [] if of.get("paired", True) else ["unpaired"]
        value = "" if row[-3] is None else Estimate(*row[-3:]).text()
        texts[of["task"], of["learner"]] = f"{value} ({', '.join(notes)})" if notes else value
    tasks, learners = (list(dict.fromkeys(key[i] for key in texts)) for i in (0, 1))
    header = ["task", *(labels.get(name, name) for name in learners)]
    return [header, *([task, *(texts.get((task, name), "") for name in learners)] for task in tasks)]


def common_tasks(by_learner: Mapping[str, Mapping[str, Scores]]) -> list[str]:
    """The tasks that all learners have scores of."""
    first = next(iter(by_learner.values()), {})
    return [task for task in first if all(task in scores for scores in by_learner.values())]


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
