"""Final scores over seeds: ``python scripts/table.py RUN... [--output FILE.csv]``.

Runs (or folders that hold runs) are grouped by everything but their seed. Each row gives the mean over seeds of the
run's final evaluation with a 95% bootstrap interval, and the interquartile mean of the utility. Groups that differ in
the algorithm alone are compared: difference of the mean utilities with its interval, and the p-value of a two-sided
Mann-Whitney test.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import sys
from collections import defaultdict
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy import stats

from algorithms.files import atomic_write
from algorithms.intervals import mean
from algorithms.runs import Run

POLICIES = ("greedy", "stochastic")
METRICS = ("utility_esr", "utility_ser", "success", "end/collision", "length", "mean_g_force", "mean_jerk")
RESAMPLES = 10_000


@dataclass
class Group:
    """Runs that differ in their seed alone; ``scores`` maps (policy, metric) to one value per seed."""

    scenario: str
    utility: str
    algorithm: str
    seeds: list[int]
    scores: dict[tuple[str, str], list[float]]

    @property
    def setting(self) -> tuple[str, str]:
        return self.scenario, self.utility


def find_runs(paths: list[Path]) -> list[Path]:
    """The run directories among and below ``paths``.

    Raises:
        ValueError: if a path holds none.
    """
    runs: list[Path] = []
    for path in paths:
        found = sorted(config.parent for config in path.rglob("config.yaml"))
        if not found:
            raise ValueError(f"{str(path)!r} holds no run: there is no config.yaml in it or below it")
        runs += found
    return runs


def collect(paths: list[Path]) -> list[Group]:
    """Group the finished runs; what is not finished is named on stderr and left out."""
    groups: dict[str, Group] = {}
    for path in find_runs(paths):
        evaluation = path / "evaluation.json"
        if not evaluation.is_file():
            print(f"left out: {path} has no final evaluation", file=sys.stderr)
            continue
        experiment = Run.open(path).experiment
        values = experiment.to_dict()
        seed = values["training"].pop("seed")
        key = json.dumps(values, sort_keys=True)
        group = groups.setdefault(
            key,
            Group(
                scenario=experiment.environment.id,
                utility=experiment.utility.name,
                algorithm=experiment.algorithm["name"],
                seeds=[],
                scores=defaultdict(list),
            ),
        )
        if seed in group.seeds:
            raise ValueError(f"{path} repeats seed {seed} of another run of the same experiment")
        group.seeds.append(seed)
        policies = json.loads(evaluation.read_text())["policies"]
        for policy in POLICIES:
            for metric in METRICS:
                if metric in policies[policy]:
                    group.scores[policy, metric].append(policies[policy][metric]["value"])
    return sorted(groups.values(), key=lambda group: (*group.setting, group.algorithm))


def difference(first: NDArray[np.float64], second: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Mean of ``first`` minus mean of ``second``, its 95% bootstrap interval, and the Mann-Whitney p-value."""
    rng = np.random.default_rng(0)
    resampled = rng.choice(first, (RESAMPLES, len(first))).mean(axis=1) - rng.choice(
        second, (RESAMPLES, len(second))
    ).mean(axis=1)
    low, high = np.quantile(resampled, [0.025, 0.975])
    p = float(stats.mannwhitneyu(first, second, alternative="two-sided").pvalue)
    return float(first.mean() - second.mean()), float(low), float(high), p


def scores_table(groups: list[Group]) -> list[list[str]]:
    """One row per group and policy, header first."""
    rows = [["environment", "utility", "algorithm", "policy", "seeds", *METRICS, "utility_esr_iqm"]]
    for group in groups:
        for policy in POLICIES:
            cells = []
            for metric in METRICS:
                values = group.scores.get((policy, metric))
                cells.append(mean(np.array(values)).text() if values else "")
            utilities = np.array(group.scores[policy, "utility_esr"])
            iqm = f"{stats.trim_mean(utilities, 0.25):.3f}"
            seeds = " ".join(str(seed) for seed in sorted(group.seeds))
            rows.append([group.scenario, group.utility, group.algorithm, policy, seeds, *cells, iqm])
    return rows


def comparisons(groups: list[Group]) -> list[list[str]]:
    """One row per pair of groups that differ in the algorithm, header first."""
    rows = [["environment", "utility", "policy", "difference of utility_esr", "value", "low", "high", "p"]]
    for first, second in combinations(groups, 2):
        if first.setting != second.setting or first.algorithm == second.algorithm:
            continue
        for policy in POLICIES:
            a, b = (np.array(group.scores[policy, "utility_esr"]) for group in (second, first))
            if min(len(a), len(b)) < 2:
                continue
            numbers = [f"{number:.3f}" for number in difference(a, b)]
            rows.append([*first.setting, policy, f"{second.algorithm} - {first.algorithm}", *numbers])
    return rows


def show(rows: list[list[str]]) -> None:
    """Print rows, header first."""
    table = Table(*(name.replace("[", r"\[") for name in rows[0]))
    for row in rows[1:]:
        table.add_row(*(cell.replace("[", r"\[") for cell in row))
    Console().print(table)


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="run directories, or folders that hold some")
    parser.add_argument("--output", type=Path, help="also write both tables as CSV")
    arguments = parser.parse_args()
    try:
        groups = collect(arguments.runs)
        if not groups:
            raise ValueError("no run has a final evaluation")
        tables = [scores_table(groups), comparisons(groups)]
        for rows in tables:
            if len(rows) > 1:
                show(rows)
        if arguments.output is not None:
            buffer = io.StringIO()
            csv.writer(buffer, lineterminator="\n").writerows([*tables[0], [], *tables[1]])
            atomic_write(arguments.output, buffer.getvalue().encode())
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
