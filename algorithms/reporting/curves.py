"""What runs scored, as figures: learning curves, and final scores against what was varied among the runs.

Everything has the colour of its algorithm. Curves are means over the runs that differ in their seed alone; means have
95% bootstrap intervals from three runs on.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, MaxNLocator, PercentFormatter

from algorithms.reporting.run_records import (
    LEFT_OUT,
    distinct_labels,
    group_by_experiment,
    identifying_settings,
    label_of,
    read_runs,
)
from algorithms.reporting.style import (
    DIM,
    INK,
    MAX_POINTS,
    TRAINING_COLOUR,
    algorithm_colours,
    algorithm_order,
    curve_styles,
    figure_style,
    grid_shape,
    save_figure,
    surround,
    widened,
)
from mo_deepdrive.evaluation.front import LARGEST
from mo_deepdrive.evaluation.metrics import (
    CARDINALITY,
    EXPECTED_UTILITY,
    FRONT,
    GREEDY,
    HYPERVOLUME,
    IGD_PLUS,
    RETURN,
    STEP,
    STOCHASTIC,
    SUCCESS,
    TRAIN,
    UTILITY,
    UTILITY_ESR,
    evaluation_prefix,
    return_of,
    split_name,
    title_of,
)
from mo_deepdrive.evaluation.statistics import MIN_SAMPLES, bootstrap, mean, of_three
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from algorithms.reporting.run_records import ExperimentRecord
    from algorithms.reporting.training_log import Columns

FORMATS = tuple(f".{name}" for name in FigureCanvasBase.get_supported_filetypes())  # of figures
SETTLED = 0.2  # share of the training after which a curve always gets the full height of its axis
CUT_RATIO = 30.0  # how many times larger the whole range must be than the settled one for the start to be cut off
MARKS = 10  # markers per curve, where several curves share a colour
# Of scores against what was varied:
PANEL = (3.3, 3.2)  # in, width and height with its labels
MAX_WORDS = 16  # below a panel; of more, some are not written
MAX_COLUMNS = 4
MAX_VALUES = 12  # of a numeric key that get a mean each; with more, neighbours share one
BINS = 8  # means of a numeric key with more values
MAX_LETTERS = 18  # of a word on an axis
LOGARITHMIC_RATIO = 20.0  # of the largest to the smallest value from which on an axis is logarithmic

# ---------------------------------------------------------------------------------------------------- learning curves


class CurveKind(NamedTuple):
    """A kind of curve: the prefix of its metrics, the name of its utility, and how it is drawn."""

    name: str
    prefix: str
    utility: str
    line: Literal["-", "--"]
    width: float


KINDS = (
    CurveKind("training", TRAIN, UTILITY, "-", 1.1),
    CurveKind("evaluation, greedy", evaluation_prefix(GREEDY), UTILITY_ESR, "-", 2.0),
    CurveKind("evaluation, stochastic", evaluation_prefix(STOCHASTIC), UTILITY_ESR, "--", 1.7),
    CurveKind("front (returns: the best of its policies)", evaluation_prefix(FRONT), UTILITY_ESR, "-", 2.0),
)
INDICATORS = (HYPERVOLUME, CARDINALITY, EXPECTED_UTILITY, IGD_PLUS)  # of fronts, a panel each


class CurveGroup(NamedTuple):
    """The columns of metrics.csv of runs that differ in their seed alone, and the experiment of one of them.

    The label is what distinguishes the group from the others.
    """

    label: str
    experiment: ExperimentRecord
    runs: tuple[Columns, ...]


def refuse(problem: str) -> None:
    """Raise what is said of a run, instead of leaving the run out."""
    raise ValueError(problem.removeprefix(LEFT_OUT))


def load_groups(directories: Sequence[str | Path], warn: Callable[[str], None] = refuse) -> list[CurveGroup]:
    """Read runs and group those that differ in their seed alone, in the order of their algorithms.

    ``warn`` is told which runs cannot be read or have no metrics yet; without it such runs are refused.
    """
    groups = group_by_experiment(read_runs(map(Path, directories), warn, metrics=True))
    if not groups:
        raise ValueError("there is no run whose metrics can be drawn")
    groups.sort(key=lambda members: algorithm_order(members[0].experiment.algorithm.name))
    experiments = [members[0].experiment for members in groups]
    names = [experiment.algorithm.name for experiment in experiments]
    labels = distinct_labels(names, [identifying_settings(experiment) for experiment in experiments])
    return [
        CurveGroup(label, experiment, tuple(run.metrics for run in members))
        for label, experiment, members in zip(labels, experiments, groups, strict=True)
    ]


def curve(runs: Sequence[Columns], name: str) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]] | None:
    """The mean over the runs that have a metric, at the steps of the first one that all of them have reached.

    Returns steps, mean, and the ends of the interval (NaN for fewer than three runs), each (points,); None without any.
    """
    series = []
    for columns in (columns for columns in runs if name in columns):
        known = np.abs(columns[name]) <= LARGEST  # neither NaN nor what an axis cannot show
        if known.any():
            series.append((columns[STEP][known], columns[name][known]))
    if not series:
        return None
    grid = series[0][0]
    first, last = max(steps[0] for steps, _ in series), min(steps[-1] for steps, _ in series)
    grid = grid[(grid >= first) & (grid <= last)]
    if not len(grid):
        return None
    values = np.stack([np.interp(grid, steps, known) for steps, known in series])
    if len(grid) > MAX_POINTS:
        pieces = np.array_split(np.arange(len(grid)), MAX_POINTS)
        values = np.stack([values[:, piece].mean(axis=1) for piece in pieces], axis=1)
        grid = np.array([grid[piece].mean() for piece in pieces])
    low, high = bootstrap(values)
    return grid, values.mean(axis=0), low, high


def plot(groups: Sequence[CurveGroup], path: str | Path, remark: str = "") -> None:
    """Draw utility, arrival rate and the return of every objective against environment steps, a curve per group."""
    panels = curve_panels(groups)
    if not panels:
        raise ValueError("the runs have no metrics to draw yet")
    rows, columns = grid_shape(len(panels))
    with figure_style():
        figure = Figure(figsize=(4.1 * columns, 2.75 * rows + 1.0))  # without pyplot, which may need a display
        axes = figure.subplots(rows, columns, squeeze=False)
        for axis in axes.flat[len(panels) :]:
            axis.set_visible(False)
        for axis, panel in zip(axes.flat, panels, strict=False):
            _draw_panel(axis, groups, panel)
        for axis in axes.flat[max(len(panels) - columns, 0) : len(panels)]:
            axis.set_xlabel("environment steps")
        _frame(figure, groups, remark)
        save_figure(figure, path)


def describe(groups: Sequence[CurveGroup]) -> list[str]:
    """A line per group: its label and the number of its seeds."""
    return [f"{group.label}: {len(group.runs)} seed{'' if len(group.runs) == 1 else 's'}" for group in groups]


class CurvePanel(NamedTuple):
    """What a panel shows: ``names[k]`` is the metric of ``KINDS[k]``, ``groups`` are the indices of groups."""

    title: str
    names: tuple[str, ...]
    groups: tuple[int, ...]


def curve_panels(groups: Sequence[CurveGroup]) -> list[CurvePanel]:
    """The panels that have a curve; scores that cannot be compared, and runs of one vehicle, get their own."""
    present = [{name for columns in group.runs for name in columns} for group in groups]
    several = [any(split_name(name).vehicle for name in names) for names in present]
    panels: list[CurvePanel] = []
    for alike in ([g for g in range(len(groups)) if several[g] is kind] for kind in (False, True)):
        quantities = _quantities(set().union(*(present[g] for g in alike)), [groups[g].experiment for g in alike])
        for heading, names, is_score in quantities:
            tasks: dict[str, list[int]] = {}
            for g in alike:
                if present[g] & set(names):
                    tasks.setdefault(groups[g].experiment.task_key if is_score else "", []).append(g)
            titles = distinct_labels([""] * len(tasks), [groups[g].experiment.task for g, *_ in tasks.values()])
            for title, members in zip(titles, tasks.values(), strict=True):
                text = f"{heading.removesuffix(' per episode')}: {title}" if title else heading
                panels.append(CurvePanel(text, names, tuple(members)))
    return panels


def _quantities(present: set[str], experiments: Sequence[ExperimentRecord]) -> list[tuple[str, tuple[str, ...], bool]]:
    """Title, metric of each of KINDS, and whether it is a score, which is comparable only within a task."""
    ours = any("mo-deepdrive" in experiment.environment.id for experiment in experiments)
    parts = [split_name(name) for name in sorted(present)]
    vehicles = sorted({part.vehicle for part in parts if part.vehicle}) or [""]
    objectives = {part.metric.removeprefix(RETURN) for part in parts if part.metric.startswith(RETURN)}
    ordered = sorted(objectives, key=lambda name: (INDEX.get(name, len(INDEX)), name))
    quantities = []
    for vehicle in vehicles:
        inner = f"{vehicle}/" if vehicle else ""
        prefix = f"{vehicle.replace('_', ' ')}: " if vehicle else ""
        scores = [*((name,) * len(KINDS) for name in INDICATORS), tuple(kind.utility for kind in KINDS)]
        # Our return of the destination is the arrival rate again.
        returns = [return_of(name) for name in ordered if not (ours and name == "destination")]
        rest = [(name,) * len(KINDS) for name in [*([SUCCESS] if ours else []), *returns]]
        for names, is_score in [*((names, True) for names in scores), *((names, False) for names in rest)]:
            metrics = tuple(f"{kind.prefix}{inner}{name}" for kind, name in zip(KINDS, names, strict=True))
            if present & set(metrics):
                text = prefix + title_of(names[0])
                quantities.append((text[0].upper() + text[1:], metrics, is_score))
    together = tuple(kind.prefix + SUCCESS for kind in KINDS)
    if len(vehicles) > 1 and present & set(together):
        quantities.append((f"All vehicles: {title_of(SUCCESS)}", together, False))
    return quantities


def _draw_panel(axis: Axes, groups: Sequence[CurveGroup], panel: CurvePanel) -> None:
    alone = len(groups) == 1
    faint = min(1.0, 4 / len(groups))  # or many bands would hide each other
    styles = curve_styles([group.experiment.algorithm.name for group in groups])
    drawn: list[tuple[NDArray[Any], ...]] = []
    for g, (k, (kind, name)) in product(panel.groups, enumerate(zip(KINDS, panel.names, strict=True))):
        points = curve(groups[g].runs, name) if alone or k > 0 else None  # several without training, to avoid clutter
        if points is None:
            continue
        steps, means, low, high = points
        colour, marker = styles[g]
        marks: dict[str, Any] = {"marker": marker or ("o" if len(steps) < 4 else ""), "markersize": 3.5}
        marks["markevery"] = max(1, len(steps) // MARKS)
        shade = TRAINING_COLOUR if k == 0 else colour
        axis.plot(steps, means, kind.line, color=shade, linewidth=kind.width, zorder=3, **marks)
        if np.isfinite(low).all():
            alpha = faint * (0.16 if alone or k == 1 else 0.07)
            axis.fill_between(steps, low, high, color=shade, alpha=alpha, linewidth=0, zorder=2)
        drawn.append((means[steps >= SETTLED * steps.max()], means, low, high))
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    axis.xaxis.set_major_locator(MaxNLocator(5))
    axis.yaxis.set_major_locator(MaxNLocator(5))
    axis.margins(x=0.015)
    axis.set_title(panel.title)
    if panel.title.lower().endswith(title_of(SUCCESS)):
        axis.set_ylim(-0.03, 1.03)
        axis.yaxis.set_major_formatter(PercentFormatter(1.0))
    elif drawn:
        cut = limit_axis(axis, panel.names[-1], drawn)
        axis.set_title(f"{panel.title} (start cut off)" if cut else panel.title)


def limit_axis(axis: Axes, name: str, drawn: Sequence[tuple[NDArray[Any], ...]]) -> bool:
    """Set the limits of an axis to curves of a metric; whether their start is cut off, which would flatten the rest.

    Of each curve there are the means after its start, all means, and the ends of their intervals.
    """
    settled, means = (np.concatenate([parts[i] for parts in drawn]) for i in (0, 1))
    limits = _limits(name, settled, 0.25)
    cut = bool(np.ptp(means) >= CUT_RATIO * (limits[1] - limits[0]))
    if not cut:
        limits = _limits(name, np.concatenate([part for parts in drawn for part in parts[1:]]), 0.05)
    axis.set_ylim(*limits)
    return cut


def _limits(name: str, values: NDArray[Any], pad: float) -> tuple[float, float]:
    """Limits of an axis around values of a metric, which do not magnify noise."""
    objective = split_name(name).metric.removeprefix(RETURN)
    nominal = OBJECTIVES[INDEX[objective]].scale if objective in INDEX else 0.0
    low, high = widened(np.nanmin(values), np.nanmax(values), max(float(np.nanmax(np.abs(values))), nominal))
    pad *= high - low or 2.0
    return low - pad, high + pad


def _frame(figure: Figure, groups: Sequence[CurveGroup], remark: str) -> None:
    """Add title, notes and legend around the panels."""
    experiment = groups[0].experiment
    alone = len(groups) == 1
    ids = ", ".join(dict.fromkeys(group.experiment.environment.id for group in groups))
    utilities = ", ".join(filter(None, dict.fromkeys(label_of(group.experiment.utility) for group in groups)))
    seeds = sorted({len(group.runs) for group in groups})
    maximised = experiment.environment.arguments.get("cost_sign", "maximise") == "maximise"
    note = (f"utility {utilities}; " if utilities else "") + "undiscounted returns per episode"
    note += ", costs negative" if maximised else ""
    note += f"; {' to '.join(dict.fromkeys(map(str, (seeds[0], seeds[-1]))))} seed{'' if seeds == [1] else 's'}"
    if seeds[-1] >= MIN_SAMPLES:
        note += f", bands: 95% bootstrap interval of the mean{of_three(seeds)}"
    elif seeds[-1] > 1:
        note += f", too few for an interval (n = {seeds[-1]})"
    handles = []
    styles = curve_styles([group.experiment.algorithm.name for group in groups])
    for group, (colour, marker) in zip(groups, styles, strict=True) if not alone else ():
        label = f"{group.label} (n = {len(group.runs)})" if len(group.runs) < MIN_SAMPLES else group.label
        handles.append(Line2D([], [], color=colour, marker=marker, markersize=4.5, linewidth=2.4, label=label))
    present = {name for group in groups for columns in group.runs for name in columns}
    for k, kind in enumerate(KINDS):
        if (alone or k > 0) and any(name.startswith(kind.prefix) for name in present):
            colour = DIM if not alone else TRAINING_COLOUR if k == 0 else styles[0][0]
            handles.append(Line2D([], [], color=colour, linestyle=kind.line, linewidth=kind.width, label=kind.name))
    surround(figure, f"{experiment.algorithm.name} on {ids}" if alone else ids, [remark, note], handles)


# ------------------------------------------------------------------------------------ scores against what was varied


class VariedScores(NamedTuple):
    """Final scores of runs that can be compared, and what was varied among these runs."""

    title: str  # environment and utility
    score: str  # its name
    values: NDArray[np.float64]  # (runs,) scores
    algorithms: tuple[str, ...]  # (runs,) names
    keys: dict[str, NDArray[np.float64] | list[str]]  # of each key that varies (runs,) numbers, or else words


def plot_effects(scores: Sequence[VariedScores], path: str | Path, title: str, remark: str = "") -> None:
    """Draw final scores against every key that varies: a row of panels per comparable scores, a dot per run."""
    notes = [
        "dots: runs; circles: means of the runs that share a value, or have neighbouring ones, with 95% intervals of "
        f"{MIN_SAMPLES} runs or more{of_three([MIN_SAMPLES], 'runs')}",
        remark,
    ]
    colours = algorithm_colours(name for comparable in scores for name in comparable.algorithms)
    rows = [
        (comparable, list(comparable.keys)[first : first + MAX_COLUMNS])
        for comparable in scores
        for first in range(0, len(comparable.keys), MAX_COLUMNS)
    ]
    columns = max(len(keys) for _, keys in rows)
    with figure_style({"text.parse_math": False}):
        figure = Figure(figsize=(PANEL[0] * max(columns, 2), PANEL[1] * len(rows)))
        parts: Any = figure.subfigures(len(rows), 1, squeeze=False)[:, 0]
        for part, (comparable, keys) in zip(parts, rows, strict=True):
            low, high = score_limits(comparable.values)
            outside = int(((comparable.values < low) | (comparable.values > high)).sum())
            beyond = f"; scores of {outside} of {len(comparable.values)} runs are beyond the axes" if outside else ""
            part.suptitle(comparable.title + beyond, x=0.01, ha="left", fontsize=11, fontweight="bold")
            axes = part.subplots(1, columns, squeeze=False, sharey=True)[0]
            dots = [colours[name] for name in comparable.algorithms]
            for axis, key in zip(axes, keys, strict=False):
                _draw_effect(axis, comparable.keys[key], comparable.values, dots)
                axis.set_title(key)
            for axis in axes[len(keys) :]:
                axis.set_visible(False)
            axes[0].set_ylim(low, high)
            axes[0].set_ylabel(comparable.score)
        handles = [Line2D([], [], color=c, marker="o", linestyle="", label=name) for name, c in colours.items()]
        surround(figure, title, notes, handles if len(handles) > 1 else ())
        save_figure(figure, path)


def _draw_effect(
    axis: Axes, values: NDArray[np.float64] | list[str], scores: NDArray[np.float64], colours: Sequence[str]
) -> None:
    """Draw scores (runs,) against the values of a key: words side by side, numbers where they are.

    Each word has a mean, and each of a few numbers; of many numbers neighbours share one.
    """
    if isinstance(values, list):
        words = list(dict.fromkeys(values))
        positions = np.array([words.index(value) for value in values], dtype=np.float64)
        shown = range(0, len(words), -(-len(words) // MAX_WORDS))
        labels = [word if len(word) <= MAX_LETTERS else f"{word[: MAX_LETTERS - 1]}…" for word in words]
        axis.set_xticks(shown, [labels[i] for i in shown], rotation=35, ha="right", rotation_mode="anchor")
        axis.margins(x=0.2)
    else:
        positions = values
        if positions.min() > 0.0 and positions.max() / positions.min() >= LOGARITHMIC_RATIO:
            axis.set_xscale("log")
            axis.xaxis.set_major_formatter("{x:.4g}")
        else:
            axis.xaxis.set_major_locator(MaxNLocator(5))
    distinct = np.unique(positions)
    parts = [np.flatnonzero(positions == position) for position in distinct]
    if not isinstance(values, list) and len(distinct) > MAX_VALUES:
        parts = np.array_split(np.argsort(positions, kind="stable"), BINS)
    axis.scatter(positions, scores, s=12, c=list(colours), alpha=0.4, linewidths=0, zorder=2)
    means = [mean(scores[part]) for part in parts]
    heights = np.array([estimate.value for estimate in means])
    ends = np.array([[m.value if m.low is None else m.low, m.value if m.high is None else m.high] for m in means])
    middles, errors = [np.median(positions[part]) for part in parts], np.abs(ends - heights[:, None]).T
    line = "o" if isinstance(values, list) else "o-"
    style: dict[str, Any] = {"color": INK, "markersize": 4.5, "linewidth": 1.2, "capsize": 3, "zorder": 3}
    axis.errorbar(middles, heights, errors, fmt=line, **style)
    axis.yaxis.set_major_locator(MaxNLocator(5))


def score_limits(scores: NDArray[np.float64]) -> tuple[float, float]:
    """Limits of the axis of scores: around all but those so far from most of them that they would flatten the rest."""
    low, high = np.quantile(scores, [0.05, 0.95])
    reach = high - low or np.ptp(scores)
    near = scores[(scores >= low - reach) & (scores <= high + reach)]
    low, high = widened(near.min(), near.max(), np.abs(near).max())
    pad = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    return float(low - pad), float(high + pad)
