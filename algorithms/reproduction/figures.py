"""The paper's figures 4 to 10, drawn from the results of a reproduction."""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, MaxNLocator

from algorithms.common.atomic_io import atomic_write
from algorithms.reporting.learning_curves import curve
from algorithms.reporting.style import COLOURS, STYLE
from algorithms.reproduction.claims import BASELINE, MULTI_OBJECTIVE, utility_kind
from algorithms.reproduction.plan import Plan
from algorithms.reproduction.results import TOTAL_UTILITY, Results

DPI = 160
WIDTH = 8.4  # inches that title and note need
LINES = {BASELINE: ("A2C", COLOURS[1]), MULTI_OBJECTIVE: ("MO-A2C", COLOURS[0])}
POLICY = "stochastic"


@dataclass(frozen=True)
class CurveFigure:
    """A figure of learning curves: a column per cell, a row per arm.

    Attributes:
        title: what is shown.
        metric: of the evaluations.
        cells: of the plan.
    """

    title: str
    metric: str
    cells: tuple[str, ...]


_CROSSING = ("intersection_linear", "intersection_nonlinear")
CURVES = {
    4: CurveFigure("OneWaypoint", "utility_esr", ("one_waypoint_linear", "one_waypoint_nonlinear")),
    5: CurveFigure("StaticObstacle", "utility_esr", ("static_obstacle_linear", "static_obstacle_nonlinear")),
    6: CurveFigure("Intersection, both vehicles together", TOTAL_UTILITY, _CROSSING),
    8: CurveFigure("Intersection, the vehicle that turns left (vehicle 0)", "vehicle_0/utility_esr", _CROSSING),
    9: CurveFigure("Intersection, the vehicle that goes straight (vehicle 1)", "vehicle_1/utility_esr", _CROSSING),
}
# Made of a front, by algorithms.reporting.front_plots; the name is that of its picture.
FRONTS = {7: "importance", 10: "reduction"}
FIGURES = tuple(sorted([*CURVES, *FRONTS]))


def file_name(figure: int) -> str:
    """Of a figure's picture."""
    return f"figure_{figure:02}.png"


def draw_curves(figure: int, plan: Plan, results: Results, path: Path) -> bool:
    """Draw a figure of learning curves; whether there was anything to draw.

    Raises:
        OSError: if the file cannot be written.
    """
    wanted = CURVES[figure]
    panels = {(arm, cell) for cell in wanted.cells for arm in results.arms(cell) if _compares(results, cell, arm)}
    cells = [cell for cell in wanted.cells if any(cell == each for _, each in panels)]
    arms = list(dict.fromkeys(arm for cell in cells for arm in results.arms(cell) if (arm, cell) in panels))
    if not panels:
        return False
    with matplotlib.rc_context(STYLE):
        canvas = Figure(figsize=(max(4.7 * len(cells), WIDTH), 3.1 * len(arms) + 1.0))
        axes = canvas.subplots(len(arms), len(cells), squeeze=False)
        for row, arm in zip(axes, arms, strict=True):
            for axis, cell in zip(row, cells, strict=True):
                if (arm, cell) not in panels:
                    axis.set_visible(False)
                    continue
                _panel(axis, results, cell, arm, f"{POLICY}/{wanted.metric}")
                kind = utility_kind(cell).capitalize()
                axis.set_title(f"{kind} utility\n{plan.cells[cell].arms[arm].title}", fontsize=9.5)
        for axis in axes[-1]:
            axis.set_xlabel("environment steps")
        for axis in axes[:, 0]:
            axis.set_ylabel("utility per episode")
        _frame(canvas, f"Figure {figure}. {wanted.title}", _counts(results, panels))
        buffer = BytesIO()
        canvas.savefig(buffer, format="png", dpi=DPI)
    atomic_write(path, buffer.getvalue())
    return True


def _compares(results: Results, cell: str, arm: str) -> bool:
    """Whether an arm compares the two algorithms, as the figures do."""
    return set(LINES) <= set(results.variants(cell, arm)) and len(results.variants(cell, arm)) == len(LINES)


def _panel(axis: Axes, results: Results, cell: str, arm: str, metric: str) -> None:
    """Mean over seeds with its interval, and every seed as a thin line, for which the intervals are an estimate."""
    last = []
    for variant, (_, colour) in LINES.items():
        runs = results.runs(cell, arm, variant)
        for run in runs:
            if metric in run:
                axis.plot(run["step"], run[metric], color=colour, linewidth=0.6, alpha=0.45, zorder=2)
                last.append(run[metric][-max(1, len(run[metric]) // 2) :])
        found = curve(runs, metric)
        if found is None:
            continue
        steps, mean, low, high = found
        axis.plot(steps, mean, color=colour, linewidth=2.1, zorder=4)
        if np.isfinite(low).all():
            axis.fill_between(steps, low, high, color=colour, alpha=0.17, linewidth=0, zorder=3)
    if last:
        _bound(axis, np.concatenate(last))
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    axis.xaxis.set_major_locator(MaxNLocator(5))
    axis.yaxis.set_major_locator(MaxNLocator(6))
    axis.margins(x=0.015)


def _bound(axis: Axes, settled: np.ndarray) -> None:
    """Leave out what lies far below the second half of the training, which would flatten the rest."""
    low, high = np.nanquantile(settled, [0.1, 1.0])
    reach = 0.5 * max(high - low, 0.02 * abs(high))
    bottom, top = axis.get_ylim()
    axis.set_ylim(max(bottom, low - reach), min(top, high + 0.2 * reach))


def _counts(results: Results, panels: set[tuple[str, str]]) -> str:
    counts = {len(results.runs(cell, arm, variant)) for arm, cell in panels for variant in LINES}
    return " to ".join(str(count) for count in dict.fromkeys((min(counts), max(counts))))


def _frame(canvas: Figure, title: str, seeds: str) -> None:
    height = canvas.get_figheight()
    note = (
        f"stochastic policy on unseen scenarios; thin: each of {seeds} seeds; thick: mean with 95% bootstrap interval"
    )
    canvas.text(0.012, 1 - 0.12 / height, title, fontsize=13, fontweight="bold", va="top")
    canvas.text(0.012, 1 - 0.40 / height, note, fontsize=9.5, color="#5B6470", va="top")
    handles = [Line2D([], [], color=colour, linewidth=2.4, label=label) for label, colour in LINES.values()]
    canvas.legend(handles=handles, loc="lower left", bbox_to_anchor=(0.006, 0.0), ncols=len(handles), frameon=False)
    canvas.tight_layout(rect=(0, 0.34 / height, 1, 1 - 0.62 / height), h_pad=1.4, w_pad=1.6)
