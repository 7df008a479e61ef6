"""The paper's figures 4 to 10, drawn from the results of the reproduction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, MaxNLocator

from algorithms.reporting.curves import curve
from algorithms.reporting.style import ALGORITHM_COLOURS, figure_style, save_figure, surround, widened
from algorithms.studies.paper_claims import LABELS, utility_kind
from mo_deepdrive.evaluation.metrics import STEP, STOCHASTIC, TOTAL_UTILITY_ESR, UTILITY_ESR, title_of, vehicle_prefix
from mo_deepdrive.evaluation.statistics import MIN_SAMPLES

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from matplotlib.axes import Axes

    from algorithms.studies.paper_plan import Plan
    from algorithms.studies.paper_results import ReproductionResults

MIN_WIDTH = 8.4  # inches, for the title and the note below it


@dataclass(frozen=True)
class CurveFigure:
    """A figure of learning curves, with a column per task and a row per protocol.

    Attributes:
        title: of the figure.
        metric: of the evaluations, on the y-axis.
        tasks: keys of the tasks in the plan.
    """

    title: str
    metric: str
    tasks: tuple[str, ...]


_INTERSECTION = ("intersection_linear", "intersection_nonlinear")
CURVE_FIGURES = {
    4: CurveFigure("OneWaypoint", UTILITY_ESR, ("one_waypoint_linear", "one_waypoint_nonlinear")),
    5: CurveFigure("StaticObstacle", UTILITY_ESR, ("static_obstacle_linear", "static_obstacle_nonlinear")),
    6: CurveFigure("Intersection, both vehicles together", TOTAL_UTILITY_ESR, _INTERSECTION),
    8: CurveFigure(
        "Intersection, the vehicle that turns left (vehicle 0)", vehicle_prefix(0, 2) + UTILITY_ESR, _INTERSECTION
    ),
    9: CurveFigure(
        "Intersection, the vehicle that goes straight (vehicle 1)", vehicle_prefix(1, 2) + UTILITY_ESR, _INTERSECTION
    ),
}
# Drawn from a front by algorithms.reporting.explorer.plots, as the figure with this name.
FRONT_FIGURES = {7: "importance", 10: "reduction"}


def file_name(number: int) -> str:
    """The file name of a figure."""
    return f"figure_{number:02}.png"


def draw_curves(number: int, plan: Plan, results: ReproductionResults, path: Path) -> bool:
    """Draw a figure of learning curves; returns False, without a file, if there are no results for it.

    Raises:
        OSError: if the file cannot be written.
    """
    spec = CURVE_FIGURES[number]
    found = [(protocol, task) for task in spec.tasks for protocol in results.protocols(task)]
    panels = [(protocol, task) for protocol, task in found if _compares_algorithms(results, task, protocol)]
    protocols = list(dict.fromkeys(protocol for protocol, _ in panels))
    tasks = list(dict.fromkeys(task for _, task in panels))
    if not panels:
        return False
    with figure_style():
        figure = Figure(figsize=(max(4.7 * len(tasks), MIN_WIDTH), 2.9 * len(protocols)))
        axes = figure.subplots(len(protocols), len(tasks), squeeze=False)
        for row, protocol in zip(axes, protocols, strict=True):
            for axis, task in zip(row, tasks, strict=True):
                if (protocol, task) not in panels:
                    axis.set_visible(False)
                    continue
                _draw_panel(axis, results, task, protocol, f"{STOCHASTIC}/{spec.metric}")
                kind = utility_kind(task).capitalize()
                axis.set_title(f"{kind} utility\n{plan.tasks[task].protocols[protocol].title}", fontsize=9.5)
        for axis in axes[-1]:
            axis.set_xlabel("environment steps")
        for axis in axes[:, 0]:
            axis.set_ylabel(title_of(UTILITY_ESR))
        _add_title_and_legend(figure, f"Figure {number}. {spec.title}", _seed_counts(results, panels))
        save_figure(figure, path)
    return True


def _compares_algorithms(results: ReproductionResults, task: str, protocol: str) -> bool:
    """Whether a protocol compares exactly the two algorithms that the figures show."""
    return set(results.variants(task, protocol)) == set(LABELS)


def _draw_panel(axis: Axes, results: ReproductionResults, task: str, protocol: str, metric: str) -> None:
    """Draw the mean over seeds with its interval, and every seed as a thin line."""
    last = []
    for variant in LABELS:
        colour, runs = ALGORITHM_COLOURS[variant], results.learning_curves(task, protocol, variant)
        for run in runs:
            if metric in run:
                axis.plot(run[STEP], run[metric], color=colour, linewidth=0.6, alpha=0.45, zorder=2)
                last.append(run[metric][-max(1, len(run[metric]) // 2) :])
        found = curve(runs, metric)
        if found is None:
            continue
        steps, mean, low, high = found
        axis.plot(steps, mean, color=colour, linewidth=2.1, zorder=4)
        if np.isfinite(low).all():
            axis.fill_between(steps, low, high, color=colour, alpha=0.17, linewidth=0, zorder=3)
    if last:
        _limit_y_axis(axis, np.concatenate(last))
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    axis.xaxis.set_major_locator(MaxNLocator(5))
    axis.yaxis.set_major_locator(MaxNLocator(6))
    axis.margins(x=0.015)


def _limit_y_axis(axis: Axes, settled: np.ndarray) -> None:
    """Cut off values far below those of the second half of training, which would flatten the curves."""
    low, high = np.nanquantile(settled, [0.1, 1.0])
    scale = float(np.nanmax(np.abs(settled)))
    reach = 0.5 * (high - low)
    bottom, top = axis.get_ylim()
    axis.set_ylim(*widened(max(bottom, low - reach), min(top, high + 0.2 * reach), scale))


def _seed_counts(results: ReproductionResults, panels: Sequence[tuple[str, str]]) -> list[int]:
    """The numbers of seeds per curve: the least and, if it differs, the most."""
    curves = [results.learning_curves(task, protocol, variant) for protocol, task in panels for variant in LABELS]
    counts = [len(runs) for runs in curves]
    return list(dict.fromkeys((min(counts), max(counts))))


def _add_title_and_legend(figure: Figure, title: str, seeds: Sequence[int]) -> None:
    count = " to ".join(map(str, seeds))
    note = f"{STOCHASTIC} policy on unseen scenarios; thin: each of {count} seeds; thick: mean"
    note += " with 95% bootstrap interval" if seeds[-1] >= MIN_SAMPLES else f", too few for an interval (n = {count})"
    handles = [Line2D([], [], color=ALGORITHM_COLOURS[key], linewidth=2.4, label=name) for key, name in LABELS.items()]
    surround(figure, title, [note], handles)
