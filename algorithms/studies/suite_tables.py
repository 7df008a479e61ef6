"""The tables of the suite: per task the learners' normalised scores and their differences, and a picture of them."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass
from functools import cache
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

from algorithms.reporting.tables import markdown
from algorithms.studies import REFERENCE
from algorithms.studies.results import FINISHED
from algorithms.studies.settings import Learner, load_study
from mo_deepdrive import suite
from mo_deepdrive.evaluation.statistics import Resampled, holm, shares
from mo_deepdrive.suite.results import FAILED
from mo_deepdrive.suite.scorers import SCORE, SCORERS
from mo_deepdrive.suite.tasks import LOWEST
from mo_deepdrive.support.names import nearest
from mo_deepdrive.world.objectives import OBJECTIVES

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Sequence
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from algorithms.reporting.tables import Rows
    from mo_deepdrive.suite import Row, Samples, Task

BASELINE = "lintune"  # which others are compared with, if there are results of it
SIGNIFICANT = 0.05  # p-values below, corrected for several comparisons
NOTE = (
    "Scores between floor (0) and ceiling (1), and their differences on the same scenarios: means over seeds with 95% "
    "bootstrap intervals. Seeds and scenarios are resampled together; seeds alone where no samples are kept. "
    f"A run whose training failed counts as {LOWEST:g}; a seed has failed if it is not above the floor. P-values are "
    f"corrected by Holm's method; the best are a tie where p >= {SIGNIFICANT:g}."
)
MEANS_NOTE = f"{NOTE.partition(' P-values')[0]} Of differences with a *, p < {SIGNIFICANT:g} after Holm's correction."


def read_results(path: Path) -> tuple[list[Row], Samples]:
    """The rows of a table of results of the suite, and the samples of their scores that are kept beside it."""
    rows = suite.read_rows(path)
    if not rows:
        raise ValueError(f"there are no results in {str(path)!r}; mo-deepdrive suite run writes a results.csv")
    for row in rows:
        try:
            suite.check_of_suite(row)
        except ValueError as error:
            raise ValueError(f"{str(path)!r} has {error}") from None
    try:
        return rows, suite.samples_of(rows, suite.read_samples(path))
    except ValueError as error:
        raise ValueError(f"{str(path)!r}: {error}") from None


def run_minutes(rows: Iterable[Row]) -> dict[tuple[str, str], list[float]]:
    """The minutes of a core that the finished runs took, by task and learner, of those for which they are known."""
    seconds: dict[tuple[str, str], dict[int, float]] = defaultdict(dict)
    for row in rows:
        if row.cpu_seconds is not None and row.state == FINISHED:
            seconds[row.task, row.learner][row.seed] = row.cpu_seconds
    return {arm: [used / 60.0 for used in runs.values()] for arm, runs in seconds.items()}


def sentence(text: str) -> str:
    """A text with a capital, which a label need not have, and a full stop."""
    return f"{text[0].upper()}{text[1:]}."


@dataclass(frozen=True)
class Scores:
    """The normalised scores of a learner on a task, of the runs that finished or failed."""

    by_seed: dict[int, float]
    mean: Resampled  # over seeds
    unfinished: int  # further runs, which have no score yet

    @property
    def failed(self) -> str:
        """How many seeds are not above the floor, and how many are not finished."""
        missing = f" ({self.unfinished} unfinished)" if self.unfinished else ""
        return f"{sum(score <= 0.0 for score in self.by_seed.values())} of {len(self.by_seed)}{missing}"


class Difference(NamedTuple):
    """What a learner scores more than another one on the same scenarios."""

    mean: Resampled
    p: float  # corrected for all that the other one is compared with


class Scoreboard:
    """The normalised scores of a table of results, of tasks of the suite in its version."""

    def __init__(self, results: Sequence[Row], samples: Samples | None = None):
        self._rows: dict[tuple[str, str], list[Row]] = defaultdict(list)
        for result in results:
            self._rows[result.task, result.learner].append(result)
        self._samples, self._minutes = samples or {}, run_minutes(results)
        scored = {task for task, _ in self._rows}
        # In the order of the suite, and in that of the results.
        self.tasks: dict[str, Task] = {name: task for name, task in suite.load().tasks.items() if name in scored}
        self.learners = list(dict.fromkeys(result.learner for result in results))
        self.scores, self._study = cache(self._scores), load_study(REFERENCE)
        self.labels = self._study.labels

    def _scores(self, name: str) -> dict[str, Scores]:
        """The scores by learner of the policy that a task ranks, of those of whom a run has ended; the best first."""
        task, by_learner = suite.load().task(name), {}
        part_of = {(learner, seed): part for (of, learner, seed), part in self._samples.items() if of == name}
        drawn = shares(task.episodes, stream=name) if part_of else None
        arms = self._study.learners_of(name) if name in self._study.tasks else {}
        for learner in self.learners:
            rows = self._rows.get((name, learner), [])
            scored = {row.seed: row.normalised for row in rows if (row.policy, row.column) == (task.policy, SCORE)}
            states = {row.seed: row.state for row in rows}
            scored |= dict.fromkeys((seed for seed, state in states.items() if state == FAILED), LOWEST)
            known = {seed: score for seed, score in scored.items() if score is not None}
            if not known:
                continue
            resampled: dict[int, float | NDArray[np.float64]] = {**known}
            for seed in known:
                if drawn is not None and (part := part_of.get((learner, seed))) is not None:
                    resampled[seed] = task.normalised(SCORERS[task.score].score(task, drawn @ part))
            arm = arms.get(learner, Learner())
            # Seeds are those of other runs, and drawn apart, unless the policies are the same.
            stream = f"{name}/{arm.ablation_of if arm.same_policies else learner}"
            mean = Resampled.over_seeds([(known[seed], resampled[seed]) for seed in known], stream)
            unfinished = sum(state not in (FINISHED, FAILED) for state in states.values())
            by_learner[learner] = Scores(known, mean, unfinished)
        return dict(sorted(by_learner.items(), key=lambda item: -item[1].mean.value))

    def minutes(self, task: str) -> float | None:
        """The median minutes of a core that a run on a task takes; None where that is not known."""
        minutes = [used for (of, _), runs in self._minutes.items() if of == task for used in runs]
        return median(minutes) if minutes else None

    def differences(self, task: str, other: str | None = None) -> dict[str, Difference]:
        """What the learners score more on a task than another one, by default than the best."""
        scores = self.scores(task)
        other = other or next(iter(scores), "")
        means = {learner: its.mean - scores[other].mean for learner, its in scores.items() if learner != other}
        corrected = holm([mean.p for mean in means.values()])
        return {learner: Difference(mean, p) for (learner, mean), p in zip(means.items(), corrected, strict=True)}

    def best(self, task: str) -> list[str]:
        """The learner with the highest mean on a task, and those that it is not clearly ahead of."""
        scores = self.scores(task)
        if not scores:
            return []
        # Intervals of scores overlap by what scenarios have in common; their difference does not have that.
        tied = [learner for learner, difference in self.differences(task).items() if difference.p >= SIGNIFICANT]
        return [next(iter(scores)), *tied]

    def _reference(self, learner: str | None) -> str:
        """The learner that others are compared with: the one that is named, or else :data:`BASELINE`, or the first."""
        if learner is not None and learner not in self.learners:
            raise ValueError(f"--baseline {learner}: there are no results of it; {nearest(learner, self.learners)}")
        return learner or (BASELINE if BASELINE in self.learners else self.learners[0])

    def _label(self, learner: str) -> str:
        return self.labels.get(learner, learner)

    def task_tables(self, baseline: str | None = None, only: str | None = None) -> list[tuple[str, Rows]]:
        """A table per task, or of one, with its title: the learners between ceiling and floor, the best first.

        They are compared with a baseline that has been trained on it, or else with the best.
        """
        if baseline is not None:
            self._reference(baseline)
        tables: list[tuple[str, Rows]] = []
        for name, task in self.tasks.items():
            if only not in (None, name) or not (scores := self.scores(name)):
                continue
            other = baseline if baseline in scores else next(iter(scores))
            differences = self.differences(name, other)
            header = ["", "score", "failed seeds", "CPU minutes", f"difference from {other}", "p", ""]
            rows = [(1.0, [f"ceiling ({task.ceiling.kind})", f"1 ({task.ceiling.value:.4g})"])]
            if task.rule is not None:
                rule = float(task.normalised(task.rule.value))
                rows.append((rule, ["reference", f"{rule:.2f} ({task.rule.value:.4g})"]))
            tied = self.best(name)
            for learner, its in scores.items():
                minutes = self._minutes.get((name, learner))
                about = [learner, its.mean.estimate.text(), its.failed, f"{median(minutes):.1f}" if minutes else ""]
                difference = differences.get(learner)
                about += [difference.mean.estimate.text(), f"{difference.p:.3f}"] if difference else ["", ""]
                rows.append((its.mean.value, [*about, ("tie" if tied[1:] else "best") if learner in tied else ""]))
            rows.append((0.0, ["floor", f"0 ({task.floor.value:.4g})"]))
            lines = [[*row, *[""] * (len(header) - len(row))] for _, row in sorted(rows, key=lambda item: -item[0])]
            tables.append((f"{name}: {task.title}{'' if task.counted else ' (not counted)'}", [header, *lines]))
        return tables

    def sentences(self, name: str) -> list[str]:
        """What the results of a task say, each sentence with the test that it follows from."""
        scores, ablation = self.scores(name), suite.load().task(name).ablation
        if not scores:
            return ["Not run."]
        whole = any(of == name for of, _, _ in self._samples)
        test = f"paired bootstrap over seeds{' and scenarios' if whole else ''}"
        tied, differences = self.best(name), self.differences(name)
        values = {learner: scores[learner].mean.estimate.text().partition(" [")[0] for learner in tied}
        first, *others = [f"{self._label(learner)} ({value})" for learner, value in values.items()]
        said = f"{first} is tied with {' and '.join(others)}" if others else f"{first} is the best"
        behind = next((learner for learner in differences if learner not in tied), None)
        if behind is not None:
            gap = (scores[tied[0]].mean - scores[behind].mean).estimate.text()
            whom = f"the ablation, {self._label(behind)}," if behind == ablation else self._label(behind)
            said += f", ahead of {whom} by {gap} with p = {differences[behind].p:.3f}"
        said += f" ({test}, Holm's correction for {len(differences)})" if differences else " that was run"
        if ablation not in scores or len(scores) == 1:
            return [sentence(said)]
        ablated = self._study.learners_of(name).get(ablation, Learner()).ablation_of
        if ablated not in scores:
            ablated = next(learner for learner in scores if learner != ablation)
        if (tied[0], behind) == (ablated, ablation):
            return [sentence(said)]
        difference = scores[ablated].mean - scores[ablation].mean
        ahead = difference.value > 0.0 and difference.p < SIGNIFICANT
        cause = f"{self._label(ablated)} is {'' if ahead else 'not '}ahead of the ablation, {self._label(ablation)}"
        cause += f" ({difference.estimate.text()}, p = {difference.p:.3f}, {test})"
        return [sentence(said), sentence(f"{cause}{'' if ahead else ': no cause is claimed'}")]

    def page(self, name: str) -> str:
        """All about a task as Markdown: utility, bounds, reference, ablation, CPU minutes, and its learners."""
        task = suite.load().task(name)
        if task.rulebook is None:
            parts = [part for part in OBJECTIVES if part.name in re.findall(r"\w+", task.formula)]
            units = [part.name + f" ({part.unit})" * (part.unit != "1") for part in parts]
            judged = f"u = `{task.formula}`, with sums over an episode of {', '.join(units)}"
        else:
            rules = [f"{rule.objective} at most {rule.at_most:g}" for rule in task.rulebook.rules]
            judged = (
                f"{', then '.join(rules)}, then {task.rulebook.then}; of the first rule that is broken minus the excess"
            )
        rule = task.rule or (task.ceiling if task.ceiling.kind == "best known" else None)
        minutes = self.minutes(name)
        about = {
            "Tests": task.tests,
            "Utility" if task.rulebook is None else "Rules": judged,
            "Score": f"{task.score.replace('_', ' ')}, {task.episodes} episodes",
            "Floor": f"{task.floor.value:.4g}, {task.floor.by}",
            "Ceiling": f"{task.ceiling.value:.4g} ({task.ceiling.kind}), {task.ceiling.by}",
            "Reference": f"score {task.normalised(rule.value):.2f}, {rule.by}" if rule else "none",
            "Ablation": self._label(task.ablation) if task.ablation else "none",
            "Training": f"{task.steps / 1e6:g} M steps" + (f", {minutes:.1f} CPU minutes a run" if minutes else ""),
        }
        lines = [f"### {name}: {task.title}", "\n".join(f"- **{key}**: {text}" for key, text in about.items())]
        if not self.scores(name):
            return "\n\n".join([*lines, "Not run."])
        ((_, (header, *rows)),) = self.task_tables(only=name)
        first = next(iter(self.scores(name)))
        header = [cell.replace(f"from {first}", f"from {self._label(first)}") for cell in header]
        table = [header, *([self._label(learner), *rest] for learner, *rest in rows)]
        return "\n\n".join([*lines, markdown(table, 1, "").strip()])

    def comparison(self, baseline: str | None, own: Container[str] = ()) -> tuple[Rows, Rows]:
        """Scores of learners by tasks, and their differences from a baseline; the last row is the mean over tasks.

        The tasks are those of all learners that are shown: of ``own``, the baseline (without one :data:`BASELINE` if it
        is there, else the first), and others with all these tasks.
        """
        other = self._reference(baseline)
        first = [other, *(learner for learner in self.learners if learner in own and learner != other)]
        tasks = [task for task in self.tasks if all(learner in self.scores(task) for learner in first)]
        if not tasks:
            raise ValueError(f"no task has results of all of {', '.join(first)}")
        shown = [name for name in self.learners if all(name in self.scores(task) for task in tasks)]
        lines = {task: {name: self.scores(task)[name].mean for name in shown} for task in tasks}
        lines["mean"] = {name: Resampled.mean([lines[task][name] for task in tasks]) for name in shown}
        others = [learner for learner in shown if learner != other]
        scores, differences = [["task", *shown]], [["task", *(f"{learner} - {other}" for learner in others)]]
        for name, means in lines.items():
            scores.append([name, *(mean.estimate.text() for mean in means.values())])
            gaps = [means[learner] - means[other] for learner in others]
            stars = [" *" if p < SIGNIFICANT else "" for p in holm([gap.p for gap in gaps])]
            texts = [gap.estimate.text() + star for gap, star in zip(gaps, stars, strict=True)]
            differences.append([name, *texts])
        return scores, differences

    def draw(self, path: Path) -> None:
        """Draw the learners of every task, the best on top: the mean with its interval, and every seed."""
        from matplotlib.figure import Figure

        from algorithms.reporting import style

        tasks = [name for name in self.tasks if self.scores(name)]
        if not tasks:
            raise ValueError("no run has ended yet")
        colours = style.algorithm_colours(self.learners)
        rows, columns = style.grid_shape(len(tasks))
        tallest = max(len(self.scores(name)) for name in tasks)
        with style.figure_style({"axes.grid.axis": "x"}):
            figure = Figure(figsize=(3.6 * columns, (0.9 + 0.24 * tallest) * rows))
            panels = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
            for axes in panels[len(tasks) :]:
                axes.set_axis_off()
            for axes, name in zip(panels, tasks, strict=False):
                scores = self.scores(name)
                for y, (learner, its) in enumerate(scores.items()):
                    values, colour = [*its.by_seed.values()], colours[learner]
                    axes.plot(values, [y] * len(values), "|", color=style.FAINT, markersize=9)
                    mean = its.mean.estimate
                    if mean.low is not None:
                        axes.plot([mean.low, mean.high], [y, y], color=colour, linewidth=2)
                    axes.plot([mean.value], [y], "o", color=colour, markersize=5)
                rule = self.tasks[name].rule
                rules = [] if rule is None else [float(self.tasks[name].normalised(rule.value))]
                for bound, line in [(0.0, ":"), (1.0, ":"), *((place, "--") for place in rules)]:
                    axes.axvline(bound, color=style.DIM, linewidth=0.8, linestyle=line)
                axes.set_yticks(range(len(scores)), [self._label(learner) for learner in scores])
                axes.set(title=name, ylim=(tallest - 0.5, -0.5))
                axes.xaxis.set_tick_params(labelbottom=True)
            note = "Means with 95% intervals; a stroke is a seed. Dotted: floor and ceiling; dashed: a reference."
            style.surround(figure, "Scores of the learners by task", [note])
            style.save_figure(figure, path)
