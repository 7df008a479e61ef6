"""What docs/results says about an environment: learning results, and which objectives conflict."""

from __future__ import annotations

import csv
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.evaluation.statistics import interquartile_mean
from mo_deepdrive.scenarios import SCENARIOS
from site_pages.markdown import table

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mo_deepdrive.scenarios import Scenario

RESULTS = Path(__file__).resolve().parents[2] / "results"
CONFLICTS = "conflicts.csv"


def results_text(scenario: Scenario) -> str:
    """The rows about an environment of the files in docs/results."""
    parts = []
    reproduction = reproduction_rows(scenario)
    if reproduction:
        header = ["task", "protocol", "algorithm", "steps", "seeds", "episodes", "utility", "arrivals (%)"]
        parts.append(
            "[Reproduction](../results/reproduction.md): utility (ESR) and arrivals of the stochastic policy,\n"
            "interquartile means over the seeds; with two vehicles the sum of the utilities; arrivals of both.\n\n"
            + table(header, reproduction)
        )
    for path in sorted(RESULTS.glob("*.csv")):
        tables = [table(*each) for each in (*environment_tables(path, scenario.id), *driver_tables(path, scenario))]
        if tables:
            parts.append(f"[{path.name}](../results/{path.name}):\n\n" + "\n".join(tables))
    return "\n".join(parts) or "None yet."


def csv_tables(path: Path) -> Iterator[tuple[list[str], list[dict[str, str]]]]:
    """The tables of a CSV file, which an empty line separates: columns, and rows by column."""
    for block in path.read_text(encoding="utf-8").split("\n\n"):
        reader = csv.DictReader(block.splitlines())
        yield list(reader.fieldnames or []), list(reader)


def environment_tables(path: Path, env_id: str) -> list[tuple[list[str], list[list[str]]]]:
    """Of every table of a CSV file the rows whose column ``environment`` begins with an id, without empty columns."""
    found = []
    for columns, everything in csv_tables(path):
        rows = [row for row in everything if row.get("environment", "").split(" ")[0] == env_id]
        for row in rows:
            row["environment"] = row["environment"].removeprefix(env_id).strip()
        header = [name for name in columns if any(row[name] for row in rows)]
        if rows:
            names = [name if name != "environment" else "arguments" for name in header]
            found.append((names, [[row[name] for name in header] for row in rows]))
    return found


def driver_tables(path: Path, scenario: Scenario) -> list[tuple[list[str], list[list[str]]]]:
    """The drivers compared in a file that is named after a scenario, with intervals in the cells of their values."""
    if not path.name.startswith(f"{scenario.name}_"):
        return []
    found = []
    for columns, rows in csv_tables(path):
        if "driver" in columns:
            ends = {f"{name}{end}" for name in columns for end in ("_low", "_high")}
            header = [name for name in columns if name not in ends and name != "gap"]
            found.append((header, [[_with_interval(row, name) for name in header] for row in rows]))
    return found


def _with_interval(row: dict[str, str], name: str) -> str:
    """A cell, with its 95% interval if the row has one; four significant digits."""
    if not row.get(f"{name}_low"):
        return row[name]
    value, low, high = (f"{float(row[key]):.4g}" for key in (name, f"{name}_low", f"{name}_high"))
    return f"{value} [{low}, {high}]"


def reproduction_rows(scenario: Scenario) -> list[list[object]]:
    """Interquartile means over seeds of the stochastic policies in reproduction_scores.csv, apart from ablations."""
    groups: dict[tuple[str, ...], list[dict[str, str]]] = defaultdict(list)
    with (RESULTS / "reproduction_scores.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            named = [each.name for each in SCENARIOS.values() if row["task"].startswith(f"{each.name}_")]
            if max(named, key=len, default="") == scenario.name and row["policy"] == "stochastic":
                key = row["task"], row["protocol"], row["label"], row["steps"], row["first_episode"]
                groups[key].append(row)
    found: list[list[object]] = []
    for (task, protocol, label, steps, first), rows in groups.items():
        if protocol == "without":  # ablations
            continue
        utilities = np.array([float(row["total_utility_esr"] or row["utility_esr"]) for row in rows])
        arrivals = np.array([100 * float(row["success"]) for row in rows])
        utility, arrived = (float(interquartile_mean(values)) for values in (utilities, arrivals))
        split = "test split" if int(first) in SPLITS["test"] else f"from seed {first}"
        scores = [f"{utility:.4g}", f"{arrived:.3g}"]
        found.append([f"`{task}`", protocol, label, int(steps), len(rows), split, *scores])
    return found


def conflicts_of_drivers(scenario: Scenario) -> list[str]:
    """A text for every population of drivers of a scenario in the file of conflicts."""
    populations: dict[str, list[dict[str, str]]] = defaultdict(list)
    for _, rows in csv_tables(RESULTS / CONFLICTS):
        for row in rows:
            if row["population"].split(",")[0] == scenario.title:
                populations[row["population"]].append(row)
    found = []
    for population, rows in populations.items():
        kind = population.partition(", ")[2] or "random drivers"
        rows = sorted(rows, key=lambda row: float(row["spearman"]))
        cells = [
            [f"`{row['first']}`", f"`{row['second']}`", f"{row['spearman']} [{row['low']}, {row['high']}]"]
            for row in rows
        ]
        drivers = "[what the drivers are](../left_turn.md#which-objectives-conflict)"
        found.append(
            f"Spearman's rank correlation of the mean returns of {rows[0]['drivers']} {kind},\n"
            f"with its 95% interval, the lowest first ({drivers}, [{CONFLICTS}](../results/{CONFLICTS})).\n\n"
            + table(["objective", "objective", "rank correlation"], cells)
        )
    return found
