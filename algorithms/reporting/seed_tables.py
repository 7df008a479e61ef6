"""Final scores of many runs over their seeds, with 95% intervals, and comparisons of their algorithms."""

from __future__ import annotations

import os
from collections import defaultdict
from dataclasses import dataclass, field
from itertools import combinations, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.reporting.run_records import LEFT_OUT, EvaluationRecord, label_of, read_runs
from algorithms.reporting.seed_groups import distinct_labels, group_by_experiment, identifying_settings
from algorithms.reporting.style import algorithm_order
from algorithms.reporting.wide_tables import Rows, print_rows
from mo_deepdrive.evaluation.metrics import (
    ADDITIVE_EPSILON,
    CARDINALITY,
    COLLISION,
    EXPECTED_UTILITY,
    FRONT,
    HYPERVOLUME,
    IGD_PLUS,
    LENGTH,
    POLICIES,
    RETURN,
    SUCCESS,
    SUITE_SCORE,
    UTILITY_ESR,
    UTILITY_SER,
    MetricName,
    end_by,
    mean_of,
    return_of,
    split_name,
)
from mo_deepdrive.evaluation.statistics import (
    MIN_SAMPLES,
    Estimate,
    interquartile_mean,
    iqm_difference,
    mann_whitney_p,
    mean_difference,
    means,
    of_three,
)
from mo_deepdrive.support.names import nearest_few

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from rich.console import Console

    from algorithms.reporting.run_records import RunRecord

# The columns of tables that are read; CSV files also have the returns of all objectives.
TABLE_METRICS = (
    *(UTILITY_ESR, UTILITY_SER, SUCCESS, end_by(COLLISION), return_of("lane_violation")),
    *(LENGTH, mean_of("g_force"), mean_of("jerk")),
    *(HYPERVOLUME, CARDINALITY, EXPECTED_UTILITY, IGD_PLUS, ADDITIVE_EPSILON),
)

UTILITY_IQM = f"{UTILITY_ESR}_iqm"  # the interquartile mean over seeds
TABLE_COLUMNS = (*TABLE_METRICS, UTILITY_IQM)
COMPARED = ("mean", "low", "high", "n", "n_other", "p")  # columns of a comparison

Cells = list[list[Any]]  # of a table with one number per cell, header first


@dataclass
class ScoreGroup:
    """The final scores of runs that differ in their seed alone.

    Attributes:
        about: the first cells of its rows, by column.
        task: those of them that groups to be compared have in common.
        algorithm: in which such groups differ.
        measured: what else they must share, as text.
        seeds: of the runs that have scores.
        scores: one value per seed for every policy, vehicle and metric; the vehicle is "" for the scores of the only
            vehicle, or of all together.
        wanted: how many seeds there are to be; None if that is not known.
        widths: the widths of the scores' own intervals, over evaluation episodes, where they are known.
        evaluation: how the runs were evaluated.
    """

    about: dict[str, str]
    task: dict[str, str]
    algorithm: str
    measured: str
    seeds: list[int] = field(default_factory=list)
    scores: dict[MetricName, list[float]] = field(default_factory=lambda: defaultdict(list))
    wanted: int | None = None
    widths: dict[MetricName, list[float]] = field(default_factory=lambda: defaultdict(list))
    evaluation: EvaluationRecord = field(default_factory=EvaluationRecord)

    @property
    def policies(self) -> list[str]:
        """The policies that have scores."""
        found = {policy for policy, _, _ in self.scores}
        return [policy for policy in POLICIES if policy in found]

    @property
    def vehicles(self) -> list[str]:
        """The vehicles that have scores, "" first."""
        return sorted({vehicle for _, vehicle, _ in self.scores})

    @property
    def seeds_text(self) -> str:
        """The seeds; if it is known how many there are to be, their number."""
        if self.wanted is None:
            return " ".join(str(seed) for seed in sorted(self.seeds))
        return str(self.wanted) if len(self.seeds) == self.wanted else f"{len(self.seeds)} of {self.wanted}"

    def values(self, place: MetricName) -> list[float]:
        """The scores of one policy, vehicle and metric.

        Evaluations in another library's environment may have a success rate only if some episode succeeded
        (:mod:`mo_deepdrive.evaluation.evaluation`): where one seed has it, it is 0 for those evaluated without.
        """
        known = self.scores[place]
        if place.metric != SUCCESS:
            return known
        evaluated = self.scores.get(place._replace(metric=LENGTH), [])
        return known + [0.0] * (len(evaluated) - len(known))


@dataclass(frozen=True)
class ScoreEstimate:
    """A score of a group over its n seeds; ``text`` has the digits that the intervals support."""

    group: ScoreGroup
    place: MetricName
    mean: Estimate
    n: int
    text: str


def find_runs(paths: Sequence[Path], warn: Callable[[str], None]) -> list[Path]:
    """The run directories among and below ``paths``, each once; links to runs and folders are followed.

    Args:
        paths: run directories, or folders that hold some.
        warn: called with a line about every folder that holds none, if another one does.

    Raises:
        ValueError: if a path is not a folder, or none holds a run.
    """
    runs: dict[Path, Path] = {}
    without: list[str] = []
    for path in paths:
        found = sorted(_runs_below(path))
        if not found:
            without.append(
                f"{str(path)!r} holds no run: there is no config.yaml in it or below it; nor is it a sweep, which has "
                "a manifest.jsonl"
            )
            if not path.is_dir():
                raise ValueError(without[-1])
        for run in found:
            runs.setdefault(run.resolve(), run)
    if without and not runs:
        raise ValueError(without[0])
    for problem in without:
        warn(f"{LEFT_OUT}{problem}")
    return list(runs.values())


def _runs_below(path: Path) -> Iterator[Path]:
    top, seen = path.resolve(), set()
    for folder, folders, files in os.walk(path, followlinks=True):
        place = Path(folder).resolve()
        if place in seen or place in top.parents:  # a link to what is walked anyway, or back to a folder around it
            folders.clear()
            continue
        seen.add(place)
        if "config.yaml" in files:
            folders.clear()  # W&B writes a config.yaml of its own below a run
            yield Path(folder)


def group_runs(paths: Sequence[Path], warn: Callable[[str], None], *, everything: bool = False) -> list[ScoreGroup]:
    """Group the finished runs among and below ``paths`` by :mod:`algorithms.reporting.seed_groups`.

    Args:
        paths: run directories, or folders that hold some.
        warn: called with a message about every run that is left out, because it has no final evaluation.
        everything: also read metrics that are neither of :data:`TABLE_METRICS` nor returns.

    Raises:
        ValueError: if a path holds no run, or two runs of a group have the same seed.
    """
    finished: list[RunRecord] = []
    for run in read_runs(find_runs(paths, warn), warn, scores=True):
        if run.scores:
            finished.append(run)
        else:
            warn(f"{LEFT_OUT}{run.path} has no final evaluation")
    members = group_by_experiment(finished)
    experiments = [runs[0].experiment for runs in members]
    labels = {
        name: distinct_labels([label_of(section) for section in sections], sections)
        for name, sections in (
            ("environment", [experiment.environment for experiment in experiments]),
            ("utility", [experiment.utility for experiment in experiments]),
        )
    }
    groups = []
    for e, (experiment, runs) in enumerate(zip(experiments, members, strict=True)):
        task = {name: texts[e] for name, texts in labels.items()}
        steps = experiment.training.total_timesteps
        about = {**task, "algorithm": experiment.algorithm.name, "steps": "" if steps is None else str(steps)}
        measured = f"{experiment.task_key} {experiment.evaluation.split}"
        group = ScoreGroup(about, task, experiment.algorithm.name, measured, evaluation=experiment.evaluation)
        for run in runs:
            group.seeds.append(run.experiment.training.seed)
            for name, score in run.scores.items():
                place = split_name(name)
                if everything or place.metric in TABLE_METRICS or place.metric.startswith(RETURN):
                    group.scores[place].append(score.value)
                    if score.low is not None and score.high is not None:
                        group.widths[place].append(score.high - score.low)
        _remove_impossible_collisions(group, runs[0].scores)
        groups.append(group)
    _tell_apart(groups, [identifying_settings(experiment) for experiment in experiments])
    return sorted(groups, key=lambda group: (*group.task.values(), algorithm_order(group.algorithm)))


def _tell_apart(groups: Sequence[ScoreGroup], settings: Sequence[Mapping[str, Any]]) -> None:
    """Add the settings that differ to what is said about groups of the same task, algorithm and steps."""
    namesakes: dict[tuple[str, ...], list[int]] = defaultdict(list)
    for g, group in enumerate(groups):
        namesakes[tuple(group.about.values())].append(g)
    for members in namesakes.values():
        labels = distinct_labels([""] * len(members), [settings[g] for g in members])
        for g, label in zip(members, labels, strict=True):
            groups[g].about["settings"] = label


def _remove_impossible_collisions(group: ScoreGroup, scores: Mapping[str, Estimate]) -> None:
    """Remove collision rates of 0 where collisions are no objective: there is nothing to collide with."""
    if any(name.endswith(return_of(COLLISION)) for name in scores):
        return
    for place in [place for place in group.scores if place.metric == end_by(COLLISION)]:
        if not any(group.scores[place]):
            del group.scores[place]


def score_estimates(groups: Sequence[ScoreGroup], metrics: Sequence[str] | None = None) -> list[ScoreEstimate]:
    """The means over seeds with their intervals, and the interquartile means of the utilities, which have none.

    Args:
        groups: in the order of the result.
        metrics: in the order of the result; None for :data:`TABLE_METRICS` and all other metrics of the groups.
    """
    wanted = metrics
    if metrics is None:
        metrics = list(dict.fromkeys([*TABLE_METRICS, *(place.metric for group in groups for place in group.scores)]))
    metrics = list(dict.fromkeys(UTILITY_ESR if name == UTILITY_IQM else name for name in metrics))
    places = [
        (group, MetricName(policy, vehicle, metric))
        for group in groups
        for policy, vehicle, metric in product(group.policies, group.vehicles, metrics)
        if (policy, vehicle, metric) in group.scores
    ]
    samples = [group.values(place) for group, place in places]
    found = []
    for (group, place), values, estimate in zip(places, samples, means(samples), strict=True):
        width = float(np.mean(group.widths.get(place, [0.0])))
        found.append(ScoreEstimate(group, place, estimate, len(values), estimate.text(width)))
        if place.metric == UTILITY_ESR:
            middle = interquartile_mean(np.array(values))
            name = place._replace(metric=UTILITY_IQM)
            found.append(ScoreEstimate(group, name, Estimate(middle), len(values), f"{middle:.3f}"))
    return [each for each in found if wanted is None or each.place.metric in wanted]


def scores_table(groups: Sequence[ScoreGroup], metrics: Sequence[str] | None = None) -> Rows:
    """One row per group, policy and vehicle, one column per metric: the means over seeds with their intervals.

    The digits are also no more than one run's interval over evaluation episodes supports, where it is known. Where
    two groups were measured alike, and no more, there are rows of their differences, second minus first.

    Args:
        groups: the rows.
        metrics: the columns; None for those of :func:`score_estimates`, the interquartile mean of the utility last.
    """
    estimates = score_estimates(groups, metrics)
    about = list(dict.fromkeys(name for group in groups for name in group.about))
    names = dict.fromkeys([*TABLE_METRICS, *(each.place.metric for each in estimates)])
    columns = [*(name for name in names if name != UTILITY_IQM), UTILITY_IQM] if metrics is None else [*metrics]
    rows: dict[tuple[int, str, str], list[str]] = {}
    for each in estimates:
        policy, vehicle, metric = each.place
        first = [*(each.group.about.get(name, "") for name in about), policy, vehicle, each.group.seeds_text]
        row = rows.setdefault((id(each.group), policy, vehicle), [*first, *[""] * len(columns)])
        row[len(first) + columns.index(metric)] = each.text
    body = [*rows.values(), *_difference_rows(groups, about, columns)]
    return without_empty_columns([[*about, "policy", "vehicle", "seeds", *columns], *body])


def _difference_rows(groups: Sequence[ScoreGroup], about: Sequence[str], columns: Sequence[str]) -> Iterator[list[str]]:
    """Rows of :func:`scores_table` for every two groups that alone were measured alike, if the seeds suffice."""
    alike: dict[str, list[ScoreGroup]] = defaultdict(list)
    for group in groups:
        alike[group.measured].append(group)
    for first, second in (members for members in alike.values() if len(members) == 2):
        texts = [(first.about.get(name, ""), second.about.get(name, "")) for name in about]
        labels = [old if old == new else f"{new or 'none'} minus {old or 'none'}" for old, new in texts]
        seeds = first.seeds_text if first.seeds_text == second.seeds_text else ""
        for policy, vehicle in product(first.policies, first.vehicles):
            row = [*labels, policy, vehicle, seeds]
            for metric in columns:
                place = MetricName(policy, vehicle, UTILITY_ESR if metric == UTILITY_IQM else metric)
                samples = [np.array(group.values(place)) for group in (second, first) if place in group.scores]
                enough = len(samples) == 2 and min(map(len, samples)) >= MIN_SAMPLES
                difference = iqm_difference if metric == UTILITY_IQM else mean_difference
                row.append(difference(*samples).text() if enough else "")
            if any(row[-len(columns) :]):
                yield row


def check_columns(groups: Sequence[ScoreGroup], columns: Sequence[str] | None) -> None:
    """Refuse columns of which no group has a score.

    Raises:
        ValueError: naming the column and the nearest ones that there are.
    """
    known = {place.metric for group in groups for place in group.scores}
    known |= {UTILITY_IQM} if UTILITY_ESR in known else set()
    for name in columns or ():
        if name not in known:
            raise ValueError(f"--columns {name}: no run has such a score; the nearest: {nearest_few(name, known)}")


def tidy_scores(groups: Sequence[ScoreGroup], metrics: Sequence[str] | None = None) -> Cells:
    """One row per group, policy, vehicle and metric: mean, low and high end of its interval, and n, how many seeds."""
    about = list(dict.fromkeys(name for group in groups for name in group.about))
    rows: Cells = [[*about, "seeds", "policy", "vehicle", "metric", "mean", "low", "high", "n"]]
    for each in score_estimates(groups, metrics):
        first = [each.group.about.get(name, "") for name in about]
        seeds = " ".join(map(str, sorted(each.group.seeds)))
        rows.append([*first, seeds, *each.place, each.mean.value, each.mean.low, each.mean.high, each.n])
    return rows


def tidy_comparisons(groups: Sequence[ScoreGroup]) -> Cells:
    """One row per policy and vehicle of two groups that differ in the algorithm: how their means differ.

    Each has the difference of the means with its interval, n, the seeds of the first, n_other, those of the other, and
    p of a two-sided Mann-Whitney test. If not all groups were trained for the same number of steps, rows have those of
    the pair.
    """
    shared = list(groups[0].task) if groups else []
    rows: Cells = [[*shared, "policy", "vehicle", "difference", "steps", "metric", *COMPARED]]
    same_steps = len({group.about.get("steps", "") for group in groups}) == 1
    comparable: dict[tuple[str, ...], list[ScoreGroup]] = defaultdict(list)
    for group in groups:
        comparable[(*group.task.values(), group.measured)].append(group)
    in_order = (sorted(members, key=lambda group: algorithm_order(group.algorithm)) for members in comparable.values())
    for first, second in (pair for members in in_order for pair in combinations(members, 2)):
        if first.algorithm == second.algorithm:
            continue
        for policy, vehicle in product(first.policies, first.vehicles):
            metric = HYPERVOLUME if policy == FRONT else UTILITY_ESR
            place = MetricName(policy, vehicle, metric)
            later, earlier = (np.array(group.scores.get(place, [])) for group in (second, first))
            if min(len(later), len(earlier)) < 2:
                continue
            found = mean_difference(later, earlier)
            pairing = f"{second.algorithm} - {first.algorithm}"
            taken = dict.fromkeys(group.about.get("steps", "") for group in (second, first))
            steps = "" if same_steps else " against ".join(taken)
            numbers = [found.value, found.low, found.high, len(later), len(earlier), mann_whitney_p(later, earlier)]
            rows.append([*first.task.values(), policy, vehicle, pairing, steps, metric, *numbers])
    return rows


def comparison_table(groups: Sequence[ScoreGroup]) -> Rows:
    """The rows of :func:`tidy_comparisons` as text, without columns that are empty."""

    def text(cell: str | float | None) -> str:
        return "" if cell is None else f"{cell:.3f}" if isinstance(cell, float) else str(cell)

    return without_empty_columns([[text(cell) for cell in row] for row in tidy_comparisons(groups)])


def without_empty_columns(rows: Rows) -> Rows:
    """The rows without the columns that only the header fills."""
    kept = [i for i in range(len(rows[0])) if any(row[i] for row in rows[1:])]
    return [[row[i] for i in kept] for row in rows]


def interval_note(groups: Sequence[ScoreGroup]) -> str:
    """What the numbers of a table and their intervals are."""
    sizes = {len(group.seeds) for group in groups}
    note = f"Means over seeds with 95% bootstrap intervals over seeds{of_three(sizes)}."
    if any(1 < size < MIN_SAMPLES for size in sizes):
        note += f" Fewer than {MIN_SAMPLES} seeds have no interval."
    if episodes := sorted({group.evaluation.label for group in groups} - {""}):
        note += f" Every run was evaluated at its end in {' or '.join(episodes)}."
    if tasks := sorted({group.evaluation.task for group in groups if group.evaluation.task}):
        note += (
            f" For {', '.join(tasks)} of the suite cite the score on the scenarios of the task, as the scoreboard does "
            f"(suite table, or --columns {SUITE_SCORE})."
        )
    return note


def print_runs(
    paths: Sequence[Path], console: Console, warn: Callable[[str], None], columns: Sequence[str] | None = None
) -> list[ScoreGroup]:
    """Print the scores of runs over seeds and the comparisons of their algorithms, task by task.

    Args:
        paths: run directories, or folders that hold some.
        console: where to print.
        warn: called with a message about every run that is left out.
        columns: of the scores; None for :data:`TABLE_COLUMNS`.

    Returns:
        The scores.

    Raises:
        ValueError: as :func:`group_runs`, or if no run has a final evaluation, or such a column.
    """
    groups = group_runs(paths, warn, everything=columns is not None)
    if not groups:
        raise ValueError("no run has a final evaluation that can be read")
    check_columns(groups, columns)
    task = groups[0].task
    for title, rows in _by_task(scores_table(groups, columns or TABLE_COLUMNS), task).items():
        print_rows(console, rows, title, rows[0].index("seeds") + 1)
    for title, rows in _by_task(comparison_table(groups), task).items():
        print_rows(console, rows, f"{title}: differences of the algorithms", rows[0].index("mean"))
    console.print(interval_note(groups), highlight=False)
    return groups


def _by_task(rows: Rows, task: Iterable[str]) -> dict[str, Rows]:
    """The rows of each task without the columns that name it, which become its title."""
    header, *body = rows
    rest = [i for i, name in enumerate(header) if name not in task]
    tables: dict[str, Rows] = {}
    for row in body:
        title = ", ".join(cell for i, cell in enumerate(row) if i not in rest and cell)
        tables.setdefault(title, [[header[i] for i in rest]]).append([row[i] for i in rest])
    return {title: without_empty_columns(table) for title, table in tables.items()}
