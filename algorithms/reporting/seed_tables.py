"""Final scores of many runs over their seeds, with 95% intervals, and comparisons of their algorithms."""

from __future__ import annotations

import json
import os
from collections import defaultdict
from dataclasses import dataclass, field
from itertools import combinations, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import registry

from algorithms.common.yaml_io import read_mapping
from algorithms.reporting.seed_groups import (
    distinct_labels,
    group_by_experiment,
    identifying_settings,
    task_settings,
)
from algorithms.reporting.style import algorithm_order
from algorithms.reporting.wide_tables import Rows, print_rows
from mo_deepdrive.config import EnvConfig
from mo_deepdrive.evaluation.front import EVALUATION_FILE
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
    mann_whitney_p,
    mean_difference,
    means,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from rich.console import Console

# The columns of the terminal; files also have the returns of all objectives.
TABLE_METRICS = (
    *(UTILITY_ESR, UTILITY_SER, SUCCESS, end_by(COLLISION), return_of("lane_violation")),
    *(LENGTH, mean_of("g_force"), mean_of("jerk")),
    *(HYPERVOLUME, CARDINALITY, EXPECTED_UTILITY, IGD_PLUS, ADDITIVE_EPSILON),
)


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
    """

    about: dict[str, str]
    task: dict[str, str]
    algorithm: str
    measured: str
    seeds: list[int] = field(default_factory=list)
    scores: dict[MetricName, list[float]] = field(default_factory=lambda: defaultdict(list))
    wanted: int | None = None
    widths: dict[MetricName, list[float]] = field(default_factory=lambda: defaultdict(list))

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


def final_scores(run: Path) -> dict[str, Estimate]:
    """The final evaluation of a run by metric, as ``greedy/utility_esr``; empty if there is none yet.

    The intervals are those over evaluation episodes.

    Raises:
        ValueError: if its file is broken.
    """
    file = run / EVALUATION_FILE
    if not file.is_file():
        return {}
    try:
        return {
            f"{policy}/{name}": Estimate(
                _number(estimate["value"]),
                *(None if estimate.get(end) is None else _number(estimate[end]) for end in ("low", "high")),
            )
            for policy, estimates in json.loads(file.read_bytes())["policies"].items()
            for name, estimate in estimates.items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"{str(file)!r} is not a final evaluation: {type(error).__name__}: {error}") from None


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"{value!r} must be a number")
    return float(value)


def final_metrics(run: Path) -> dict[str, float]:
    """The values of :func:`final_scores`, with its errors."""
    return {name: score.value for name, score in final_scores(run).items()}


def find_runs(paths: Sequence[Path]) -> list[Path]:
    """The run directories among and below ``paths``, each once; links to runs and folders are followed.

    Raises:
        ValueError: if a path holds none.
    """
    runs: dict[Path, Path] = {}
    for path in paths:
        found = sorted(_runs_below(path))
        if not found:
            raise ValueError(
                f"{str(path)!r} holds no run: there is no config.yaml in it or below it; nor is it a sweep, which has "
                "a manifest.jsonl"
            )
        for run in found:
            runs.setdefault(run.resolve(), run)
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


def group_runs(paths: Sequence[Path], warn: Callable[[str], None]) -> list[ScoreGroup]:
    """Group the finished runs among and below ``paths`` by :mod:`algorithms.reporting.seed_groups`.

    Args:
        paths: run directories, or folders that hold some.
        warn: called with a message about every run that is left out, because it has no final evaluation.

    Raises:
        ValueError: if a path holds no run, or two runs of a group have the same seed.
    """
    finished: list[Path] = []
    scores: list[dict[str, Estimate]] = []
    for path in find_runs(paths):
        found = final_scores(path)
        if found:
            finished.append(path)
            scores.append(found)
        else:
            warn(f"left out: {path} has no final evaluation")
    configs = [read_mapping(path / "config.yaml") for path in finished]
    experiments = group_by_experiment(finished, configs)
    settings = [task_settings(configs[members[0]]) for members in experiments]
    environments = distinct_labels([each["environment"] for each in settings], environment_label)
    utilities = distinct_labels([each["utility"] for each in settings], utility_label)
    groups = []
    for e, members in enumerate(experiments):
        config = configs[members[0]]
        algorithm = config["algorithm"]["name"]
        task = {"environment": environments[e], "utility": utilities[e]}
        about = {**task, "algorithm": algorithm, "steps": str(config["training"]["total_timesteps"])}
        measured = json.dumps([settings[e], config.get("evaluation", {}).get("split")], sort_keys=True)
        group = ScoreGroup(about, task, algorithm, measured)
        for i in members:
            group.seeds.append(configs[i]["training"]["seed"])
            for name, score in scores[i].items():
                place = split_name(name)
                if place.metric in TABLE_METRICS or place.metric.startswith(RETURN):
                    group.scores[place].append(score.value)
                    if score.low is not None and score.high is not None:
                        group.widths[place].append(score.high - score.low)
        _remove_impossible_collisions(group, scores[members[0]])
        groups.append(group)
    _tell_apart(groups, [identifying_settings(configs[members[0]]) for members in experiments])
    return sorted(groups, key=lambda group: (*group.task.values(), algorithm_order(group.algorithm)))


def _tell_apart(groups: Sequence[ScoreGroup], settings: Sequence[Mapping[str, Any]]) -> None:
    """Add the settings that differ to what is said about groups of the same task, algorithm and steps."""
    namesakes: dict[tuple[str, ...], list[int]] = defaultdict(list)
    for g, group in enumerate(groups):
        namesakes[tuple(group.about.values())].append(g)
    for members in namesakes.values():
        labels = distinct_labels([settings[g] for g in members], lambda _: "")
        for g, label in zip(members, labels, strict=True):
            groups[g].about["settings"] = label


def _remove_impossible_collisions(group: ScoreGroup, scores: Mapping[str, Estimate]) -> None:
    """Remove collision rates of 0 where collisions are no objective: there is nothing to collide with."""
    if any(name.endswith(return_of(COLLISION)) for name in scores):
        return
    for place in [place for place in group.scores if place.metric == end_by(COLLISION)]:
        if not any(group.scores[place]):
            del group.scores[place]


def environment_label(environment: Mapping[str, Any]) -> str:
    """The id of an environment and, if it is ours, the arguments that are not the default.

    Args:
        environment: the section of a resolved experiment.
    """
    env_id, arguments = environment["id"], environment.get("arguments", {})
    spec = registry.get(env_id.rpartition(":")[2])
    if spec is None or not str(spec.vector_entry_point).startswith("mo_deepdrive."):
        return str(env_id)
    defaults = {name: field.default for name, field in EnvConfig.model_fields.items()}
    changed = [f"{name}={value}" for name, value in arguments.items() if value != defaults.get(name)]
    return " ".join([env_id, *changed])


def utility_label(utility: Mapping[str, Any] | None) -> str:
    """The name of a utility and those of vehicles with another one; empty if no utility is known.

    Args:
        utility: the section of a resolved experiment.
    """
    if utility is None:
        return ""
    others = [f"{vehicle}={other['name']}" for vehicle, other in utility.get("vehicles", {}).items()]
    return " ".join([utility["name"], *others])


def scores_table(groups: Sequence[ScoreGroup], metrics: Sequence[str] | None = None) -> Rows:
    """One row per group, policy and vehicle: the means over seeds with their intervals.

    The digits are also no more than one run's interval over evaluation episodes supports, where it is known.

    Args:
        groups: the rows.
        metrics: the columns; None for :data:`TABLE_METRICS` and all other metrics of the groups.
    """
    if metrics is None:
        metrics = list(dict.fromkeys([*TABLE_METRICS, *(place.metric for group in groups for place in group.scores)]))
    about = list(dict.fromkeys(name for group in groups for name in group.about))
    places = [(g, place) for g, group in enumerate(groups) for place in group.scores if place.metric in metrics]
    estimates = means([groups[g].values(place) for g, place in places])
    widths = [float(np.mean(groups[g].widths.get(place, [0.0]))) for g, place in places]
    texts = [each.text(width) for each, width in zip(estimates, widths, strict=True)]
    cells = dict(zip(places, texts, strict=True))
    rows = [[*about, "policy", "vehicle", "seeds", *metrics, f"{UTILITY_ESR}_iqm"]]
    for g, group in enumerate(groups):
        for policy, vehicle in product(group.policies, group.vehicles):
            utilities = group.scores.get(MetricName(policy, vehicle, UTILITY_ESR))
            iqm = f"{interquartile_mean(np.array(utilities)):.3f}" if utilities else ""
            numbers = [cells.get((g, MetricName(policy, vehicle, metric)), "") for metric in metrics]
            first = [*(group.about.get(name, "") for name in about), policy, vehicle, group.seeds_text]
            rows.append([*first, *numbers, iqm])
    return without_empty_columns(rows)


def comparison_table(groups: Sequence[ScoreGroup]) -> Rows:
    """One row per pair of groups that differ in the algorithm: difference of the means and Mann-Whitney test.

    If not all groups were trained for the same number of steps, rows have those of the pair.
    """
    shared = list(groups[0].task) if groups else []
    rows = [[*shared, "policy", "vehicle", "difference", "steps", "of", "value", "low", "high", "p"]]
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
            numbers = (found.value, found.low, found.high, mann_whitney_p(later, earlier))
            pairing = f"{second.algorithm} - {first.algorithm}"
            taken = dict.fromkeys(group.about.get("steps", "") for group in (second, first))
            steps = "" if same_steps else " against ".join(taken)
            texts = ["" if number is None else f"{number:.3f}" for number in numbers]
            rows.append([*first.task.values(), policy, vehicle, pairing, steps, metric, *texts])
    return without_empty_columns(rows)


def without_empty_columns(rows: Rows) -> Rows:
    """The rows without the columns that only the header fills."""
    kept = [i for i in range(len(rows[0])) if any(row[i] for row in rows[1:])]
    return [[row[i] for i in kept] for row in rows]


def print_runs(paths: Sequence[Path], console: Console, warn: Callable[[str], None]) -> list[Rows]:
    """Print the scores of runs over seeds and the comparisons of their algorithms, task by task; returns both tables.

    Args:
        paths: run directories, or folders that hold some.
        console: where to print.
        warn: called with a message about every run that is left out.

    Raises:
        ValueError: as :func:`group_runs`, or if no run has a final evaluation.
    """
    groups = group_runs(paths, warn)
    if not groups:
        raise ValueError("no run has a final evaluation")
    scores, compared = scores_table(groups), comparison_table(groups)
    for task, rows in _by_task(_for_the_terminal(scores), groups[0].task).items():
        print_rows(console, rows, task, rows[0].index("seeds") + 1)
    for task, rows in _by_task(compared, groups[0].task).items():
        print_rows(console, rows, f"{task}: differences of the algorithms", rows[0].index("value"))
    console.print("Means over seeds with 95% bootstrap intervals over seeds.", highlight=False)
    if any(1 < len(group.seeds) < MIN_SAMPLES for group in groups):
        console.print(f"Fewer than {MIN_SAMPLES} seeds have no interval.", highlight=False)
    return [scores, compared]


def _for_the_terminal(scores: Rows) -> Rows:
    """The rows without the returns that are in files alone."""
    kept = [i for i, name in enumerate(scores[0]) if name in TABLE_METRICS or not name.startswith(RETURN)]
    return [[row[i] for i in kept] for row in scores]


def _by_task(rows: Rows, task: Iterable[str]) -> dict[str, Rows]:
    """The rows of each task without the columns that name it, which become its title."""
    header, *body = rows
    rest = [i for i, name in enumerate(header) if name not in task]
    tables: dict[str, Rows] = {}
    for row in body:
        title = ", ".join(cell for i, cell in enumerate(row) if i not in rest and cell)
        tables.setdefault(title, [[header[i] for i in rest]]).append([row[i] for i in rest])
    return {title: without_empty_columns(table) for title, table in tables.items()}
