"""Evaluations as numbers with intervals: a table to read, JSON and CSV to keep."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from algorithms.common.atomic_io import atomic_write, csv_bytes, write_json
from algorithms.evaluation.evaluate import Evaluation
from algorithms.evaluation.statistics import Estimate, mean, rate, utility_of_mean

# Ends of an episode that are reported even when none occurred.
USUAL_ENDS = ("collision", "off_lane", "time_limit")
# Objectives of which magnitudes per decision are reported.
COMFORT = ("g_force", "jerk")


def summarise(evaluation: Evaluation) -> dict[str, Estimate]:
    """Every number of an evaluation by name; with several vehicles prefixed by ``vehicle_0/`` and so on.

    With several vehicles ``success`` is the share of episodes in which all arrived, ``end/collision`` of those in
    which any collided.

    Means and utilities have bootstrap intervals over episodes, rates have Wilson's; the largest magnitudes of a
    decision have none.
    """
    summary: dict[str, Estimate] = {}
    vehicles = evaluation.returns.shape[1]
    if vehicles > 1:
        summary["success"] = rate(np.asarray(evaluation.succeeded.all(axis=1)))
        summary["end/collision"] = rate(np.array(["collision" in ends for ends in evaluation.ends.tolist()]))
    for v in range(vehicles):
        prefix = f"vehicle_{v}/" if vehicles > 1 else ""
        summary |= {prefix + name: value for name, value in _of_vehicle(evaluation, v).items()}
    return summary


def _of_vehicle(evaluation: Evaluation, v: int) -> dict[str, Estimate]:
    utility = evaluation.utilities[v]
    returns, discounted = evaluation.returns[:, v], evaluation.discounted[:, v]
    lengths, ends = evaluation.lengths[:, v], evaluation.ends[:, v]
    summary = {
        "utility_esr": mean(np.asarray(utility(returns))),
        "utility_ser": utility_of_mean(returns, utility),
        "discounted_utility_esr": mean(np.asarray(utility(discounted))),
        "discounted_utility_ser": utility_of_mean(discounted, utility),
    }
    known = [str(end) for end in ends if end is not None]
    if known or evaluation.succeeded[:, v].any():
        summary["success"] = rate(evaluation.succeeded[:, v])
    if known:
        others = sorted(set(known) - {"arrived", *USUAL_ENDS})
        summary |= {f"end/{end}": rate(np.asarray(ends == end)) for end in (*USUAL_ENDS, *others)}
    summary["length"] = mean(lengths.astype(np.float64))
    for i, objective in enumerate(evaluation.objectives):
        summary[f"return/{objective}"] = mean(returns[:, i])
        summary[f"discounted_return/{objective}"] = mean(discounted[:, i])
    for i, objective in enumerate(evaluation.objectives):
        if objective in COMFORT:
            summary[f"mean_{objective}"] = mean(np.abs(returns[:, i]) / np.maximum(lengths, 1))
            summary[f"max_{objective}"] = Estimate(float(evaluation.largest[:, v, i].max()))
    return summary


def table(evaluations: Mapping[str, Evaluation], title: str) -> Table:
    """A table of one column per policy."""
    summaries = {policy: summarise(evaluation) for policy, evaluation in evaluations.items()}
    names: list[str] = []
    for summary in summaries.values():
        place = 0
        for name in summary:
            if name not in names:
                names.insert(place, name)
            place = names.index(name) + 1
    result = Table(title=f"{title}; 95% intervals", title_justify="left", title_style="bold", box=SIMPLE_HEAD)
    result.add_column("", no_wrap=True, min_width=max(map(len, names)))
    for policy in summaries:
        result.add_column(policy, justify="right", no_wrap=True)
    for name in names:
        cells = [summary[name].text() if name in summary else "" for summary in summaries.values()]
        result.add_row(name, *(cell.replace("[", r"\[") for cell in cells))
    return result


def write(directory: Path, evaluations: Mapping[str, Evaluation], about: Mapping[str, Any]) -> None:
    """Write evaluation.json and evaluation.csv (the summary) and episodes.csv (one row per episode and vehicle).

    Args:
        directory: where to.
        evaluations: one per policy.
        about: what the numbers are of: seed, gamma, step and so on.

    Raises:
        OSError: if a file cannot be written; each is whole or untouched.
    """
    summaries = {policy: summarise(evaluation) for policy, evaluation in evaluations.items()}
    policies = {
        policy: {name: asdict(estimate) for name, estimate in summary.items()} for policy, summary in summaries.items()
    }
    write_json(directory / "evaluation.json", {**about, "policies": policies})
    rows: list[list[Any]] = [["policy", "metric", "value", "low", "high"]]
    for policy, summary in summaries.items():
        rows += [[policy, name, e.value, e.low, e.high] for name, e in summary.items()]
    atomic_write(directory / "evaluation.csv", csv_bytes(rows))
    atomic_write(directory / "episodes.csv", csv_bytes(_episodes(evaluations, int(about["seed"]))))


def _episodes(evaluations: Mapping[str, Evaluation], seed: int) -> list[list[Any]]:
    objectives = next(iter(evaluations.values())).objectives
    rows: list[list[Any]] = [
        [
            *("policy", "seed", "vehicle", "success", "end", "length", "utility"),
            *(f"return/{objective}" for objective in objectives),
            *(f"discounted_return/{objective}" for objective in objectives),
        ]
    ]
    for policy, evaluation in evaluations.items():
        episodes, vehicles, _ = evaluation.returns.shape
        for v in range(vehicles):
            utilities = evaluation.episode_utilities(v)
            for e in range(episodes):
                how = [bool(evaluation.succeeded[e, v]), evaluation.ends[e, v], int(evaluation.lengths[e, v])]
                returns = [*evaluation.returns[e, v].tolist(), *evaluation.discounted[e, v].tolist()]
                rows.append([policy, seed + e, v, *how, float(utilities[e]), *returns])
    return rows
