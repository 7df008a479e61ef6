"""Final scores over seeds, of runs or of a sweep.

    python scripts/table.py RUN... [--output FILE.csv]
    python scripts/table.py SWEEP [--sort METRIC] [--top N] [--output FILE.csv]

Runs (or folders that hold runs) are grouped by everything but their seed. Each row gives the mean over seeds of the
run's final evaluation with a 95% bootstrap interval, and the interquartile mean of the utility; with several vehicles
there is a row for each, and one for all together (success: all arrived). Fronts have their indicators instead. Groups
that differ in the algorithm alone are compared: difference of the mean utilities (hypervolumes) with its interval, and
the p-value of a two-sided Mann-Whitney test.

A sweep (a directory with a manifest, made by scripts/sweep.py) has a row per cell, or per trial of a search, the best
first; cells of other environments or utilities are apart. The terminal shows the best cells, the policy by which they
are sorted, and as many columns as it has room for; the CSV has everything. With several vehicles the row of all
together has the sum of their utilities. Cells that differ in the algorithm alone are compared by the same policy.
What the runs have scored and logged is kept for other programs in SWEEP/collected/ as Parquet files, which are brought
up to date here; algorithms/sweeps/collection.py says what is in them.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, product
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray
from rich.table import Table
from scipy import stats

from algorithms.common.atomic_io import atomic_write, csv_bytes
from algorithms.evaluation.statistics import Estimate, bootstrap, interquartile_mean
from algorithms.experiments.progress_bar import make_console
from algorithms.experiments.run_directory import Run
from algorithms.sweeps.collection import POLICIES, SCORE_KEYS, Collection, ScoreKey, as_json, collect, split_score_name
from algorithms.sweeps.manifest import is_sweep
from algorithms.sweeps.ranking import (
    TOTAL,
    Ranking,
    environment_label,
    rank,
    short_names,
    totals,
    utility_label,
    value_labels,
    value_text,
    varying_keys,
)
from algorithms.sweeps.run_scores import final_metrics

METRICS = (
    *("utility_esr", "utility_ser", "success", "end/collision", "return/lane_violation"),
    *("length", "mean_g_force", "mean_jerk"),
    *("hypervolume", "cardinality", "expected_utility", "igd_plus", "additive_epsilon"),
)
OF_ALGORITHMS = ("config", "algorithm", "algorithm.name")  # keys of cells that choose the algorithm
RESAMPLES = 10_000
TOP = 20


@dataclass
class Group:
    """Runs that differ in their seed alone.

    Attributes:
        about: the first cells of its rows, by column.
        setting: of these, what groups to be compared have in common.
        algorithm: which they differ in.
        measured: what else they must share, as text.
        seeds: of the runs that have numbers.
        scores: (policy, vehicle, metric) to one value per seed; the vehicle is "" for the numbers of one vehicle, or of
            all together.
        wanted: how many seeds there are to be; None where that is not known.
    """

    about: dict[str, str]
    setting: dict[str, str]
    algorithm: str
    measured: str
    seeds: list[int] = field(default_factory=list)
    scores: dict[ScoreKey, list[float]] = field(default_factory=lambda: defaultdict(list))
    wanted: int | None = None

    @property
    def policies(self) -> list[str]:
        """The kinds of policy that have numbers."""
        found = {policy for policy, _, _ in self.scores}
        return [policy for policy in POLICIES if policy in found]

    @property
    def vehicles(self) -> list[str]:
        """The vehicles that have numbers, "" first."""
        return sorted({vehicle for _, vehicle, _ in self.scores})

    @property
    def seeds_text(self) -> str:
        """Which seeds; or how many, of how many."""
        if self.wanted is None:
            return " ".join(str(seed) for seed in sorted(self.seeds))
        return str(self.wanted) if len(self.seeds) == self.wanted else f"{len(self.seeds)} of {self.wanted}"


def find_runs(paths: list[Path]) -> list[Path]:
    """The run directories among and below ``paths``.

    Raises:
        ValueError: if a path holds none.
    """
    runs: list[Path] = []
    for path in paths:
        found = sorted(config.parent for config in path.rglob("config.yaml"))
        if not found:
            raise ValueError(
                f"{str(path)!r} holds no run: there is no config.yaml in it or below it; nor is it a sweep, which has "
                "a manifest.jsonl"
            )
        runs += found
    return runs


def group_runs(paths: list[Path]) -> list[Group]:
    """Group the finished runs; what is not finished is named on stderr and left out.

    Raises:
        ValueError: if there is no run, or a seed twice.
    """
    groups: dict[str, Group] = {}
    for path in find_runs(paths):
        scores = final_metrics(path)
        if not scores:
            print(f"left out: {path} has no final evaluation", file=sys.stderr)
            continue
        experiment = Run.open(path).experiment
        values = experiment.to_dict()
        seed = values["training"].pop("seed")
        algorithm = experiment.algorithm["name"]
        setting = {
            "environment": environment_label(experiment.environment),
            "utility": utility_label(experiment.utility),
        }
        about = {**setting, "algorithm": algorithm, "steps": str(experiment.training.total_timesteps)}
        measured = f"{experiment.evaluation.gamma} {experiment.evaluation.reference_point}"
        group = groups.setdefault(as_json(values), Group(about, setting, algorithm, measured))
        if seed in group.seeds:
            raise ValueError(f"{path} repeats seed {seed} of another run of the same experiment")
        group.seeds.append(seed)
        for name, value in scores.items():
            place = split_score_name(name)
            if place[-1] in METRICS:
                group.scores[place].append(value)
    return sorted(groups.values(), key=lambda group: (*group.setting.values(), group.algorithm))


def group_cells(collection: Collection, setting: Ranking) -> list[Group]:
    """The cells of a setting that have final evaluations, in its order."""
    wanted = collection.scores.filter(pl.col("metric").is_in([*METRICS, setting.metric]))
    known = wanted.select("run", *SCORE_KEYS, "value").collect()
    scores: dict[str, dict[ScoreKey, float]] = defaultdict(dict)
    for run, policy, vehicle, metric, value in pl.concat([known, totals(known.filter(metric=setting.metric))]).rows():
        # A total stands in the row of all together where there is nothing else.
        scores[run].setdefault((policy, "" if vehicle == TOTAL else vehicle, metric), value)
    groups = []
    for cell in setting.cells:
        texts = {key: value_text(value) for key, value in cell.keys.items()}
        alike = {key: text for key, text in texts.items() if key not in OF_ALGORITHMS}
        trial = {} if cell.trial is None else {"trial": str(cell.trial)}
        group = Group({**trial, **texts}, alike, cell.config["algorithm"]["name"], setting.title, wanted=len(cell.rows))
        for row in cell.rows:
            if row.id in collection.scored:
                group.seeds.append(row.seed)
                for place, value in scores[row.id].items():
                    group.scores[place].append(value)
        groups += [group] if group.seeds else []
    return groups


def difference(first: NDArray[np.float64], second: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Mean of ``first`` minus mean of ``second``, its 95% bootstrap interval, and the Mann-Whitney p-value."""
    rng = np.random.default_rng(0)
    resampled = rng.choice(first, (RESAMPLES, len(first))).mean(axis=1) - rng.choice(
        second, (RESAMPLES, len(second))
    ).mean(axis=1)
    low, high = np.quantile(resampled, [0.025, 0.975])
    p = float(stats.mannwhitneyu(first, second, alternative="two-sided").pvalue)
    return float(first.mean() - second.mean()), float(low), float(high), p


def means(samples: Sequence[Sequence[float]]) -> list[Estimate]:
    """The mean of each sample with its interval; samples of the same size share their resamples, which saves time."""
    found: dict[int, Estimate] = {}
    by_size: dict[int, list[int]] = defaultdict(list)
    for i, sample in enumerate(samples):
        by_size[len(sample)].append(i)
    for places in by_size.values():
        together = np.array([samples[i] for i in places]).T
        for i, value, low, high in zip(places, together.mean(axis=0), *bootstrap(together), strict=True):
            interval = (None, None) if np.isnan(low) else (float(low), float(high))
            found[i] = Estimate(float(value), *interval)
    return [found[i] for i in range(len(samples))]


def scores_table(groups: Sequence[Group], metrics: Sequence[str] = METRICS) -> list[list[str]]:
    """One row per group, policy and vehicle, header first."""
    about = list(dict.fromkeys(name for group in groups for name in group.about))
    places = [(g, place) for g, group in enumerate(groups) for place in group.scores]
    texts = [each.text() for each in means([groups[g].scores[place] for g, place in places])]
    cells = dict(zip(places, texts, strict=True))
    rows = [[*about, "policy", "vehicle", "seeds", *metrics, "utility_esr_iqm"]]
    for g, group in enumerate(groups):
        for policy, vehicle in product(group.policies, group.vehicles):
            utilities = group.scores.get((policy, vehicle, "utility_esr"))
            iqm = f"{interquartile_mean(np.array(utilities)):.3f}" if utilities else ""
            numbers = [cells.get((g, (policy, vehicle, metric)), "") for metric in metrics]
            whose = [*(group.about.get(name, "") for name in about), policy, vehicle, group.seeds_text]
            rows.append([*whose, *numbers, iqm])
    return without_empty_columns(rows)


def without_empty_columns(rows: list[list[str]]) -> list[list[str]]:
    """The rows without the columns that only the header fills."""
    kept = [i for i in range(len(rows[0])) if any(row[i] for row in rows[1:])]
    return [[row[i] for i in kept] for row in rows]


def comparisons(groups: Sequence[Group]) -> list[list[str]]:
    """One row per pair of groups that differ in the algorithm, header first."""
    shared = list(groups[0].setting) if groups else []
    rows = [[*shared, "policy", "vehicle", "difference", "of", "value", "low", "high", "p"]]
    alike: dict[tuple[str, ...], list[Group]] = defaultdict(list)
    for group in groups:
        alike[(*group.setting.values(), group.measured)].append(group)
    in_order = (sorted(members, key=lambda group: group.algorithm) for members in alike.values())
    for first, second in (pair for members in in_order for pair in combinations(members, 2)):
        if first.algorithm == second.algorithm:
            continue
        for policy, vehicle in product(first.policies, first.vehicles):
            metric = "hypervolume" if policy == "front" else "utility_esr"
            pair = [np.array(group.scores.get((policy, vehicle, metric), [])) for group in (second, first)]
            if min(map(len, pair)) < 2:
                continue
            numbers = [f"{number:.3f}" for number in difference(*pair)]
            pairing = f"{second.algorithm} - {first.algorithm}"
            rows.append([*first.setting.values(), policy, vehicle, pairing, metric, *numbers])
    return without_empty_columns(rows)


def show(rows: list[list[str]], title: str | None = None) -> None:
    """Print rows, header first."""
    table = Table(*(name.replace("[", r"\[") for name in rows[0]), title=title, title_justify="left")
    for row in rows[1:]:
        table.add_row(*(cell.replace("[", r"\[") for cell in row))
    make_console().print(table)


def ranked_by(setting: Ranking, group: Group) -> Group:
    """A group with the scores of one policy alone, which is the one that its setting is sorted by."""
    place = (setting.policy, "" if setting.vehicle == TOTAL else setting.vehicle)
    return replace(group, scores={name: values for name, values in group.scores.items() if name[:2] == place})


def best(setting: Ranking, groups: Sequence[Group], top: int) -> list[list[str]]:
    """What the terminal shows of a setting: the best cells by their short names, and their scores of one policy."""
    cells = setting.ranked[:top]
    keys = varying_keys([cell.keys for cell in setting.cells])
    columns = {name: value_labels([cell.keys.get(key) for cell in cells]) for key, name in short_names(keys).items()}
    brief = []
    for i, group in enumerate(groups[: len(cells)]):
        trial = {name: text for name, text in group.about.items() if name == "trial"}
        names = {name: texts[i] for name, texts in columns.items()}
        brief.append(replace(ranked_by(setting, group), about={**trial, **names}))
    rows = scores_table(brief, [setting.metric, *(name for name in METRICS if name != setting.metric)])
    rows = [[cell for name, cell in zip(rows[0], row, strict=True) if name not in SCORE_KEYS] for row in rows]
    return fitting(rows, rows[0].index(setting.metric) + 1)


def fitting(rows: list[list[str]], least: int) -> list[list[str]]:
    """The rows with as many of the first columns as the terminal has room for, and ``least`` in any case."""
    widths = [max(len(row[i]) for row in rows) + len("│  ") for i in range(len(rows[0]))]
    count = max(least, int((np.cumsum(widths) < make_console().width).sum()))
    return [row[:count] for row in rows]


def tables_of_runs(paths: list[Path]) -> list[list[list[str]]]:
    """Print and return the scores of runs, and the comparisons.

    Raises:
        ValueError: if there is no run, or none has a final evaluation.
    """
    groups = group_runs(paths)
    if not groups:
        raise ValueError("no run has a final evaluation")
    tables = [scores_table(groups), comparisons(groups)]
    for rows in tables:
        if len(rows) > 1:
            show(rows)
    return tables


def tables_of_sweep(sweep: Path, metric: str | None, top: int, whole: bool) -> list[list[list[str]]]:
    """Print the best cells of a sweep and the first comparisons.

    Args:
        sweep: its directory.
        metric: to sort by; None for the utility or the hypervolume.
        top: rows to print of each table.
        whole: whether to return the scores of all cells, and all comparisons.

    Raises:
        ValueError: if it is no sweep, or an empty one, or no run has a final evaluation or the metric.
    """
    collection = collect(sweep)
    for remark in collection.remarks:
        print(f"left out: {remark}", file=sys.stderr)
    if not collection.scored:
        raise ValueError(
            f"no run of sweep {str(sweep)!r} has a final evaluation yet; scripts/plot.py draws what runs have logged"
        )
    every: list[Group] = []
    to_compare: list[Group] = []
    for setting in rank(collection.cells, collection.scores.collect(), metric):
        groups = group_cells(collection, setting)
        every += groups
        to_compare += [ranked_by(setting, group) for group in groups]
        if setting.ranked:
            shown = min(top, len(setting.ranked))
            title = f"{setting.title}: {shown} of {len(setting.cells)} cells, by {setting.score_name}"
            show(best(setting, groups, top), title)
        elif groups:
            print(f"left out: no run has {metric} in {setting.title}", file=sys.stderr)
    compared = comparisons(to_compare)
    if len(compared) > 1:
        count = len(compared) - 1
        show(compared[: 1 + top], f"algorithms where nothing else differs: {min(top, count)} of {count} comparisons")
    return [scores_table(every), compared] if whole else []


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "runs", nargs="+", type=Path, metavar="RUN", help="run directories, or folders that hold some; or one sweep"
    )
    parser.add_argument("--output", type=Path, metavar="FILE", help="also write both tables as CSV")
    parser.add_argument(
        "--sort", metavar="METRIC", help="sweep: greedy/success and so on (default: the utility, or the hypervolume)"
    )
    parser.add_argument("--top", type=int, metavar="N", help=f"sweep: rows on the terminal (default: {TOP})")
    arguments = parser.parse_args()
    try:
        if not any(is_sweep(path) for path in arguments.runs):
            if arguments.sort is not None or arguments.top is not None:
                raise ValueError("--sort and --top are for a sweep, a directory with a manifest.jsonl")
            tables = tables_of_runs(arguments.runs)
        elif len(arguments.runs) > 1:
            raise ValueError("a sweep has a table of its own: give one sweep, or else runs")
        elif arguments.top is not None and arguments.top < 1:
            raise ValueError(f"--top {arguments.top} must be at least 1")
        else:
            whole = arguments.output is not None
            tables = tables_of_sweep(arguments.runs[0], arguments.sort, arguments.top or TOP, whole)
        if arguments.output is not None:
            atomic_write(arguments.output, csv_bytes([*tables[0], [], *tables[1]]))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
