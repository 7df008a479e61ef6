"""Final scores over seeds: ``python scripts/table.py RUN... [--output FILE.csv]``.

Runs (or folders that hold runs) are grouped by everything but their seed. Each row gives the mean over seeds of the
run's final evaluation with a 95% bootstrap interval, and the interquartile mean of the utility; with several vehicles
there is a row for each, and one for all together (success: all arrived). Fronts have their indicators instead. Groups
that differ in the algorithm alone are compared: difference of the mean utilities (hypervolumes) with its interval, and
the p-value of a two-sided Mann-Whitney test.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from dataclasses import dataclass
from itertools import combinations, product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from scipy import stats

from algorithms.experiment import EnvironmentSettings, UtilitySettings, find_environment, is_ours
from algorithms.files import atomic_write, csv_bytes
from algorithms.intervals import mean
from algorithms.progress import make_console
from algorithms.runs import Run
from mo_deepdrive.config import EnvConfig

POLICIES = ("greedy", "stochastic", "front")
METRICS = (
    *("utility_esr", "utility_ser", "success", "end/collision", "return/lane_violation"),
    *("length", "mean_g_force", "mean_jerk"),
    *("hypervolume", "cardinality", "expected_utility", "igd_plus", "additive_epsilon"),
)
RESAMPLES = 10_000


@dataclass
class Group:
    """Runs that differ in their seed alone; ``scores`` maps (policy, vehicle, metric) to one value per seed.

    The vehicle is "" for the numbers of one vehicle, or of all together; ``steps`` are those of the training,
    ``measured`` what numbers of different groups must share to be compared.
    """

    scenario: str
    utility: str
    algorithm: str
    steps: int
    measured: str
    seeds: list[int]
    scores: dict[tuple[str, str, str], list[float]]

    @property
    def setting(self) -> tuple[str, str]:
        return self.scenario, self.utility

    @property
    def policies(self) -> list[str]:
        """The kinds of policy that have numbers."""
        found = {policy for policy, _, _ in self.scores}
        return [policy for policy in POLICIES if policy in found]

    @property
    def vehicles(self) -> list[str]:
        """The vehicles that have numbers, "" first."""
        return sorted({vehicle for _, vehicle, _ in self.scores})


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
                scenario=environment_label(experiment.environment),
                utility=utility_label(experiment.utility),
                algorithm=experiment.algorithm["name"],
                steps=experiment.training.total_timesteps,
                measured=f"{experiment.evaluation.gamma} {experiment.evaluation.reference_point}",
                seeds=[],
                scores=defaultdict(list),
            ),
        )
        if seed in group.seeds:
            raise ValueError(f"{path} repeats seed {seed} of another run of the same experiment")
        group.seeds.append(seed)
        policies = json.loads(evaluation.read_text())["policies"]
        for policy in POLICIES:
            for name, estimate in policies.get(policy, {}).items():
                vehicle, metric = split_vehicle(name)
                if metric in METRICS:
                    group.scores[policy, vehicle, metric].append(estimate["value"])
    return sorted(groups.values(), key=lambda group: (*group.setting, group.algorithm))


def environment_label(settings: EnvironmentSettings) -> str:
    """The id, and the arguments that are not the default."""
    if not is_ours(find_environment(settings.id)):
        return settings.id
    defaults = {name: field.default for name, field in EnvConfig.model_fields.items()}
    changed = [f"{name}={value}" for name, value in settings.arguments.items() if value != defaults[name]]
    return " ".join([settings.id, *changed])


def utility_label(settings: UtilitySettings | None) -> str:
    """The name, and those of the vehicles that have another utility; nothing where none is known."""
    if settings is None:
        return ""
    return " ".join([settings.name, *(f"{vehicle}={own.name}" for vehicle, own in settings.vehicles.items())])


def split_vehicle(name: str) -> tuple[str, str]:
    """``vehicle_0/end/collision`` as ``("vehicle_0", "end/collision")``; the vehicle is "" where none is named."""
    vehicle, slash, metric = name.partition("/")
    return (vehicle, metric) if slash and vehicle.startswith("vehicle_") else ("", name)


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
    about = ["environment", "utility", "algorithm", "steps", "policy", "vehicle", "seeds"]
    rows = [[*about, *METRICS, "utility_esr_iqm"]]
    for group in groups:
        for policy, vehicle in product(group.policies, group.vehicles):
            cells = []
            for metric in METRICS:
                values = group.scores.get((policy, vehicle, metric))
                cells.append(mean(np.array(values)).text() if values else "")
            utilities = group.scores.get((policy, vehicle, "utility_esr"))
            iqm = f"{stats.trim_mean(np.array(utilities), 0.25):.3f}" if utilities else ""
            seeds = " ".join(str(seed) for seed in sorted(group.seeds))
            whose = [group.scenario, group.utility, group.algorithm, str(group.steps), policy, vehicle, seeds]
            rows.append([*whose, *cells, iqm])
    return without_empty_columns(rows)


def without_empty_columns(rows: list[list[str]]) -> list[list[str]]:
    """The rows without the columns that only the header fills."""
    kept = [i for i in range(len(rows[0])) if any(row[i] for row in rows[1:])]
    return [[row[i] for i in kept] for row in rows]


def comparisons(groups: list[Group]) -> list[list[str]]:
    """One row per pair of groups that differ in the algorithm, header first."""
    rows = [["environment", "utility", "policy", "vehicle", "difference", "of", "value", "low", "high", "p"]]
    for first, second in combinations(groups, 2):
        alike = (first.setting, first.measured) == (second.setting, second.measured)
        if not alike or first.algorithm == second.algorithm:
            continue
        for policy, vehicle in product(first.policies, first.vehicles):
            metric = "hypervolume" if policy == "front" else "utility_esr"
            pair = [np.array(group.scores.get((policy, vehicle, metric), [])) for group in (second, first)]
            if min(map(len, pair)) < 2:
                continue
            numbers = [f"{number:.3f}" for number in difference(*pair)]
            pairing = f"{second.algorithm} - {first.algorithm}"
            rows.append([*first.setting, policy, vehicle, pairing, metric, *numbers])
    return without_empty_columns(rows)


def show(rows: list[list[str]]) -> None:
    """Print rows, header first."""
    table = Table(*(name.replace("[", r"\[") for name in rows[0]))
    for row in rows[1:]:
        table.add_row(*(cell.replace("[", r"\[") for cell in row))
    make_console().print(table)


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
            atomic_write(arguments.output, csv_bytes([*tables[0], [], *tables[1]]))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
