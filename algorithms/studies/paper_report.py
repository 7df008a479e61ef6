"""The report of the reproduction: verdicts, tables and figures 4 to 10 of the paper."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, MaxNLocator

from algorithms.reporting.curves import curve
from algorithms.reporting.explorer.plots import draw_front
from algorithms.reporting.style import ALGORITHM_COLOURS, figure_style, save_figure, surround, widened
from algorithms.reporting.tables import markdown, print_rows
from algorithms.studies.paper import CLAIMS, FRONT_LEARNER, LABELS, percent, shown
from mo_deepdrive.evaluation import metrics
from mo_deepdrive.evaluation.front import Front
from mo_deepdrive.evaluation.metrics import STEP, STOCHASTIC, SUCCESS, UTILITY_ESR
from mo_deepdrive.evaluation.statistics import MIN_SAMPLES, iqm, iqm_difference, probability_of_improvement
from mo_deepdrive.support.atomic_io import atomic_write

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray
    from rich.console import Console

    from algorithms.reporting.tables import Rows
    from algorithms.studies.paper import Claim, PaperResults, TaskResults

REPORT_FILE = "reproduction.md"
QUICK = "A quick reproduction checks the pipeline. It trains too little for verdicts."
EFFECT = ("difference from the first", "P(higher)")
COLLAPSED = 0.5  # a run of PCN has collapsed if its hypervolume is below this part of the median

# Figures of learning curves, a column per task (with a linear and a non-linear utility) and a row per protocol: their
# title, what tasks begin with, and their metric.
CURVE_FIGURES = {
    4: ("OneWaypoint", "one_waypoint", UTILITY_ESR),
    5: ("StaticObstacle", "static_obstacle", UTILITY_ESR),
    6: ("Intersection, both vehicles together", "intersection", metrics.TOTAL_UTILITY_ESR),
    8: ("Intersection, the vehicle that turns left (vehicle 0)", "intersection", f"vehicle_0/{UTILITY_ESR}"),
    9: ("Intersection, the vehicle that goes straight (vehicle 1)", "intersection", f"vehicle_1/{UTILITY_ESR}"),
}
# Drawn from a front by algorithms.reporting.explorer.plots, as the figure with this name.
FRONT_FIGURES = {7: "importance", 10: "reduction"}
MIN_WIDTH = 8.4  # inches, for the title and the note below it


def write_report(
    results: PaperResults, directory: Path, figures: Sequence[int], *, how: str, quick: bool = False
) -> list[Path]:
    """Write the results, the report, which quotes the command ``how``, and figures; the paths of the latter."""
    results.write(directory)
    pictures: dict[int, list[Path]] = {}
    for number in figures:
        path = directory / f"figure_{number:02}.png"
        draws_fronts = number in FRONT_FIGURES
        pictures[number] = _draw_fronts(number, path) if draws_fronts else _draw_curves(number, results, path)
    atomic_write(directory / REPORT_FILE, _document(results, pictures, how, quick).encode())
    return [directory / REPORT_FILE, *(path for paths in pictures.values() for path in paths)]


# ----------------------------------------------------------------------------------------------------------- figures


def _draw_curves(number: int, results: PaperResults, path: Path) -> list[Path]:
    """Draw a figure of learning curves into a path; returns it, or nothing if there are no results."""
    title, scenario, metric = CURVE_FIGURES[number]
    panels = {
        (protocol, task): of_task
        for task in (f"{scenario}_linear", f"{scenario}_nonlinear")
        for protocol, of_task in results.tasks.get(task, {}).items()
        if of_task.labels.keys() == LABELS.keys()
    }
    if not panels:
        return []
    protocols, tasks = (list(dict.fromkeys(place[i] for place in panels)) for i in (0, 1))
    with figure_style():
        figure = Figure(figsize=(max(4.7 * len(tasks), MIN_WIDTH), 2.9 * len(protocols)))
        axes = figure.subplots(len(protocols), len(tasks), squeeze=False)
        for row, protocol in zip(axes, protocols, strict=True):
            for axis, task in zip(row, tasks, strict=True):
                panel = panels.get((protocol, task))
                axis.set_visible(panel is not None)
                if panel is not None:
                    _draw_panel(axis, panel, f"{STOCHASTIC}/{metric}")
        for axis in axes[-1]:
            axis.set_xlabel("environment steps")
        for axis in axes[:, 0]:
            axis.set_ylabel(metrics.title_of(UTILITY_ESR))
        seeds = sorted({len(panel.learning_curves(name)) for panel in panels.values() for name in LABELS})
        count = " to ".join(map(str, dict.fromkeys((seeds[0], seeds[-1]))))
        note = f"{STOCHASTIC} policy on unseen scenarios; thin: each of {count} seeds; thick: mean"
        enough = seeds[-1] >= MIN_SAMPLES
        note += " with 95% bootstrap interval" if enough else f", too few for an interval (n = {count})"
        handles = [Line2D([], [], color=ALGORITHM_COLOURS[key], linewidth=2.4, label=LABELS[key]) for key in LABELS]
        surround(figure, f"Figure {number}. {title}", [note], handles)
        save_figure(figure, path)
    return [path]


def _draw_panel(axis: Axes, results: TaskResults, metric: str) -> None:
    """Draw the mean over seeds with its interval, and every seed as a thin line."""
    settled = []  # of the second half of training
    for learner in LABELS:
        colour, runs = ALGORITHM_COLOURS[learner], results.learning_curves(learner)
        for run in (run for run in runs if metric in run):
            axis.plot(run[STEP], run[metric], color=colour, linewidth=0.6, alpha=0.45, zorder=2)
            settled.append(run[metric][-max(1, len(run[metric]) // 2) :])
        averaged = curve(runs, metric)
        if averaged is None:
            continue
        steps, mean, low, high = averaged
        axis.plot(steps, mean, color=colour, linewidth=2.1, zorder=4)
        if np.isfinite(low).all():
            axis.fill_between(steps, low, high, color=colour, alpha=0.17, linewidth=0, zorder=3)
    if settled:  # values far below these would flatten the curves, and are cut off
        values = np.concatenate(settled)
        low, high = np.nanquantile(values, [0.1, 1.0])
        reach = 0.5 * (high - low)
        bottom, top = axis.get_ylim()
        limits = max(bottom, low - reach), min(top, high + 0.2 * reach)
        axis.set_ylim(*widened(*limits, float(np.nanmax(np.abs(values)))))
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    axis.xaxis.set_major_locator(MaxNLocator(5))
    axis.yaxis.set_major_locator(MaxNLocator(6))
    axis.margins(x=0.015)
    axis.set_title(f"{results.titles[0].rpartition(', ')[2].capitalize()}\n{results.titles[1]}", fontsize=9.5)


def _draw_fronts(number: int, path: Path) -> list[Path]:
    """Draw a figure of every front beside a path; returns the files."""
    paths = []
    for folder in sorted(path.parent.glob("front_*/")):
        paths.append(path.with_stem(f"{path.stem}_{folder.name.removeprefix('front_')}"))
        with tempfile.TemporaryDirectory() as scratch:
            draw_front(Front.read(folder), scratch, title=f"Figure {number}. PCN on OneWaypoint")
            atomic_write(paths[-1], (Path(scratch) / f"{FRONT_FIGURES[number]}.png").read_bytes())
    return paths


# ----------------------------------------------------------------------------------------------------------- tables


def claim_table(claim: Claim, results: PaperResults, *, quick: bool = False) -> Rows:
    """What decides a claim, and the verdicts: a row per criterion, a column per protocol."""
    answers = {True: "yes", False: "no", None: "inconclusive"}
    judged = claim.verdicts(results)
    rows = [["criterion", *(results.tasks[claim.tasks[0]][protocol].titles[1] for protocol in judged)]]
    for checks in zip(*(verdict.checks for verdict in judged.values()), strict=True):
        rows.append([checks[0].criterion, *(f"{answers[check.passed]}: {check.measured}" for check in checks)])
    return [*rows, ["verdict", *("not judged" if quick else verdict.text for verdict in judged.values())]]


def verdict_table(results: PaperResults, *, quick: bool = False) -> str:
    """The verdicts as Markdown: a row per claim and protocol."""
    rows = [["claim", "protocol", "verdict"]]
    for claim in CLAIMS:
        name = f"{claim.number}. {claim.statement}"
        protocols, *_, verdicts = claim_table(claim, results, quick=quick)
        for protocol, verdict in zip(protocols[1:], verdicts[1:], strict=True):
            rows.append([name, protocol, f"**{verdict}**"])
            name = ""
    return _table(rows, 2)


def print_verdicts(results: PaperResults, console: Console, *, quick: bool = False) -> None:
    """Print the verdicts: a table per claim."""
    for claim in CLAIMS:
        if claim.verdicts(results):
            print_rows(console, claim_table(claim, results, quick=quick), f"{claim.number}. {claim.statement}", 1)


def _task_section(protocols: Mapping[str, TaskResults]) -> str:
    """The title of a task, and its scores: a row per protocol and learner, the others compared with the first one."""
    rows: list[dict[str, str]] = []
    for results in protocols.values():
        scores = {learner: results.values(learner, results.score.metric) for learner in results.labels}
        first, *_ = scores.values()
        for learner, values in scores.items():
            protocol = results.titles[1] if values is first else ""
            row = {"protocol": protocol, "algorithm": results.labels[learner], "seeds": str(len(values))}
            row["steps"] = f"{results.steps:,}"
            if results.is_front:
                rows.append(row | _front_scores(results, values))
                continue
            effect = shown(iqm_difference(values, first)), probability_of_improvement(values, first).text()
            row |= _driving_scores(results, learner, values)
            rows.append(row | dict(zip(EFFECT, ("", "") if values is first else effect, strict=True)))
    table = _table([[*rows[0]], *([*row.values()] for row in rows)], 2)
    return f"{next(iter(protocols.values())).titles[0]}\n\n{table}"


def _driving_scores(results: TaskResults, learner: str, utilities: NDArray[np.float64]) -> dict[str, str]:
    distance = metrics.vehicle_prefix(0, results.vehicles) + metrics.return_of("distance")
    return {
        "utility (ESR)": shown(iqm(utilities)),
        "success rate": percent(iqm(results.values(learner, SUCCESS))),
        "collisions": percent(iqm(results.values(learner, metrics.end_by(metrics.COLLISION)))),
        "progress (m)": shown(iqm(results.values(learner, distance))),
    }


def _front_scores(results: TaskResults, volumes: NDArray[np.float64]) -> dict[str, str]:
    names = metrics.CARDINALITY, metrics.LOWEST_DISTANCE, metrics.HIGHEST_DISTANCE
    count, lowest, highest = (iqm(results.values(FRONT_LEARNER, name)) for name in names)
    return {
        "hypervolume": iqm(volumes).text(),
        "collapsed runs": f"{(volumes < COLLAPSED * np.median(volumes)).sum()} of {len(volumes)}",
        "non-dominated policies": count.text(),
        "progress of the policies (m)": f"{lowest.value:.2g} to {highest.value:.3g}",
    }


def _table(rows: Rows, labels: int) -> str:
    """A table of Markdown; in one of a single row, all labels would be what the rows share."""
    return markdown(rows, labels if len(rows) > 2 else 0, "").strip()


def _document(results: PaperResults, pictures: Mapping[int, Sequence[Path]], how: str, quick: bool) -> str:
    """The whole report as Markdown."""
    runs = results.scores.unique(["task", "learner", "seed"])
    parts = [
        "# Reproduction of the paper's figures and claims",
        f"Written by `{how}`: {len(runs)} runs, {runs['cpu_seconds'].sum() / 3600:.1f} hours on one core, seeds "
        f"{min(runs['seed'])} to {max(runs['seed'])}. Background: [reproduction](../reproduction.md).",
        "Scores are interquartile means over seeds of the utility (ESR) of the policy that samples its actions; at the "
        "intersection, of the sum of both vehicles' utilities. The scores of every run, also of greedy policies, are "
        "in reproduction_scores.csv.",
        "Intervals (95%, bootstrap) are over seeds. P(higher) is the probability that a run scores higher than one of "
        f"the first algorithm. A run of PCN has collapsed if its hypervolume is below {COLLAPSED:.0%} of the median.",
        *([f"**{QUICK}**"] if quick else []),
        "## Verdicts",
        verdict_table(results, quick=quick),
    ]
    unclaimed, drawn = dict(results.tasks), set[Path]()
    for claim in CLAIMS:
        unclaimed = {task: protocols for task, protocols in unclaimed.items() if task not in claim.tasks}
        if not claim.verdicts(results):
            continue
        parts += [f"## Claim {claim.number}", _table(claim_table(claim, results, quick=quick), 1)]
        parts += [f"### {_task_section(results.tasks[task])}" for task in claim.tasks]
        for number in claim.figures:
            new = [path for path in pictures.get(number, []) if path not in drawn]  # claims share figures
            parts += [f"![Figure {number}]({path.name})" for path in new]
            drawn |= {*new}
    parts += [f"## {_task_section(protocols)}" for protocols in unclaimed.values()]
    return "\n\n".join(parts) + "\n"
