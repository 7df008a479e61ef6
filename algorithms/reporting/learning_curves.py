"""Learning curves: one panel per metric, one curve per group of runs that differ in their seed alone.

Curves are means over seeds, in the colour of their algorithm, and have 95% bootstrap intervals from three seeds on.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

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
    read_runs,
)
from algorithms.reporting.style import (
    DIM,
    MAX_POINTS,
    TRAINING_COLOUR,
    algorithm_order,
    curve_styles,
    figure_style,
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
from mo_deepdrive.evaluation.statistics import MIN_SAMPLES, bootstrap, of_three
from mo_deepdrive.world.objectives import INDEX, OBJECTIVES

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from algorithms.reporting.run_records import ExperimentRecord, UtilityRecord
    from algorithms.reporting.training_log import Columns

SETTLED = 0.2  # share of the training after which a curve always gets the full height of its axis
CUT_RATIO = 30.0  # how many times larger the whole range must be than the settled one for the start to be cut off
FORMATS = tuple(f".{name}" for name in FigureCanvasBase.get_supported_filetypes())  # of figures
MARKS = 10  # markers per curve, where several curves share a colour


@dataclass(frozen=True)
class CurveKind:
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


@dataclass(frozen=True)
class CurveGroup:
    """The metrics of runs that differ in their seed alone.

    Attributes:
        label: what distinguishes the group from the others.
        experiment: that of one of the runs.
        runs: the columns of every run's metrics.csv.
    """

    label: str
    experiment: ExperimentRecord
    runs: tuple[Columns, ...]


def load_groups(directories: Sequence[str | Path], warn: Callable[[str], None] | None = None) -> list[CurveGroup]:
    """Read runs and group those that differ in their seed alone (:mod:`algorithms.reporting.run_records`).

    Groups are in the order of their algorithms, those of one algorithm in the order given.

    Args:
        directories: of the runs.
        warn: called with a line about every run that is left out because it cannot be read or has no metrics yet; None
            to refuse it.

    Raises:
        ValueError: if a run is refused, none is left, or two runs of a group have the same seed.
    """

    def refuse(problem: str) -> None:
        raise ValueError(problem.removeprefix(LEFT_OUT))

    tell = warn or refuse
    runs = []
    for run in read_runs(map(Path, directories), tell, metrics=True):
        if len(run.metrics[STEP]):
            runs.append(run)
        else:
            tell(f"{LEFT_OUT}run {str(run.path)!r} has no metrics yet")
    if not runs:
        raise ValueError("there is no run whose metrics can be drawn")
    groups = group_by_experiment(runs)
    groups.sort(key=lambda members: algorithm_order(members[0].experiment.algorithm.name))
    labels = _labels([members[0].experiment for members in groups])
    return [
        CurveGroup(label, members[0].experiment, tuple(run.metrics for run in members))
        for label, members in zip(labels, groups, strict=True)
    ]


def _labels(experiments: Sequence[ExperimentRecord]) -> list[str]:
    """The algorithm's name; where names repeat, also the settings that all experiments have and that differ."""
    flat = [identifying_settings(experiment) for experiment in experiments]
    names = [experiment.algorithm.name for experiment in experiments]
    shared = set.intersection(*(set(each) for each in flat)) if flat else set()
    differing = sorted(key for key in shared if len({repr(each[key]) for each in flat}) > 1)
    named = [key for key in differing if key in ("environment.id", "utility.name")]
    if len(set(names)) < len(names):
        named = [key for key in differing if key != "algorithm.name"]
    return [
        ", ".join([name, *(f"{key.rpartition('.')[2]} {each[key]}" for key in named[:4])])
        for name, each in zip(names, flat, strict=True)
    ]


def curve(runs: Sequence[Columns], name: str) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]] | None:
    """The mean over runs of a metric, at the steps of the first run up to the last step that all of them have reached.

    Args:
        runs: columns of metrics.csv; those without the metric are ignored, as are values above 1e100.
        name: of the metric.

    Returns:
        Steps, mean, and lower and upper end of the interval (NaN for fewer than three runs), each (points,); None if no
        run has the metric.
    """
    series = []
    for columns in runs:
        if name in columns:
            known = np.abs(columns[name]) <= LARGEST  # neither NaN nor what an axis cannot show
            if known.any():
                series.append((columns[STEP][known], columns[name][known]))
    if not series:
        return None
    first = max(steps[0] for steps, _ in series)
    last = min(steps[-1] for steps, _ in series)
    grid = series[0][0]
    grid = grid[(grid >= first) & (grid <= last)]
    if not len(grid):
        return None
    values = np.stack([np.interp(grid, steps, each) for steps, each in series])
    if len(grid) > MAX_POINTS:
        pieces = np.array_split(np.arange(len(grid)), MAX_POINTS)
        values = np.stack([values[:, piece].mean(axis=1) for piece in pieces], axis=1)
        grid = np.array([grid[piece].mean() for piece in pieces])
    low, high = bootstrap(values)
    return grid, values.mean(axis=0), low, high


def plot(groups: Sequence[CurveGroup], path: str | Path, remark: str = "") -> None:
    """Draw utility, arrival rate and the return of every objective against environment steps, into an image file.

    Args:
        groups: one curve each.
        path: the image file.
        remark: an additional line below the title.

    Raises:
        ValueError: if there is nothing to draw, or the file's suffix is not an image format.
        OSError: if the file cannot be written.
    """
    panels = curve_panels(groups)
    if not panels:
        raise ValueError("the runs have no metrics to draw yet")
    columns = min(len(panels), 3 if len(panels) in (3, 5, 6, 9) else 4)
    rows = -(-len(panels) // columns)
    with figure_style():
        figure = Figure(figsize=(4.1 * columns, 2.75 * rows + 1.0))  # without pyplot, which may need a display
        axes = figure.subplots(rows, columns, squeeze=False)
        for i, axis in enumerate(axes.flat):
            if i >= len(panels):
                axis.set_visible(False)
                continue
            _draw_panel(axis, groups, panels[i])
            if i + columns >= len(panels):
                axis.set_xlabel("environment steps")
        _frame(figure, groups, remark)
        save_figure(figure, path)


def describe(groups: Sequence[CurveGroup]) -> list[str]:
    """A line per group: its label and the number of its seeds."""
    return [f"{group.label}: {len(group.runs)} seed{'' if len(group.runs) == 1 else 's'}" for group in groups]


def _label(group: CurveGroup) -> str:
    """The label of a group in the legend, which says so if it has too few seeds for a band."""
    return f"{group.label} (n = {len(group.runs)})" if len(group.runs) < MIN_SAMPLES else group.label


@dataclass(frozen=True)
class CurvePanel:
    """What a panel shows: ``names[k]`` is the metric of ``KINDS[k]``, ``groups`` are the indices of groups."""

    title: str
    names: tuple[str, ...]
    groups: tuple[int, ...]


def curve_panels(groups: Sequence[CurveGroup]) -> list[CurvePanel]:
    """The panels that have a curve; scores that cannot be compared get separate panels.

    So do runs with one vehicle, which their metrics do not name, and runs with several.
    """
    present = [{name for columns in group.runs for name in columns} for group in groups]
    several = [any(split_name(name).vehicle for name in names) for names in present]
    panels: list[CurvePanel] = []
    for alike in ([g for g in range(len(groups)) if several[g] is kind] for kind in (False, True)):
        found = _quantities(set().union(*(present[g] for g in alike)), [groups[g].experiment for g in alike])
        for heading, names, is_score in found:
            tasks: dict[str, list[int]] = {}
            for g in alike:
                if present[g] & set(names):
                    tasks.setdefault(groups[g].experiment.task_key if is_score else "", []).append(g)
            titles = _task_titles([groups[members[0]].experiment for members in tasks.values()])
            for title, members in zip(titles, tasks.values(), strict=True):
                text = f"{heading.removesuffix(' per episode')}: {title}" if title else heading
                panels.append(CurvePanel(text, names, tuple(members)))
    return panels


def _task_titles(experiments: Sequence[ExperimentRecord]) -> list[str]:
    """What distinguishes each of some tasks from the others; empty for a single one."""
    tasks = [experiment.task for experiment in experiments]
    labels = {
        "environment": [experiment.environment.id for experiment in experiments],
        "utility": [", ".join(_utilities(experiment.utility)) for experiment in experiments],
        "evaluation": [""] * len(tasks),
    }
    parts = [distinct_labels(texts, [task[name] for task in tasks]) for name, texts in labels.items()]
    differing = [texts for texts in parts if len(set(texts)) > 1]
    return [", ".join(filter(None, (texts[i] for texts in differing))) for i in range(len(tasks))]


def drawn(names: Sequence[str], experiment: ExperimentRecord) -> list[str]:
    """Those of the metrics ``names`` that :func:`plot` may draw for runs of ``experiment``."""
    # Runs with one vehicle and with several may be given together, and it does not tell which these are.
    of_one = {name for name in names if not split_name(name).vehicle}
    quantities = [*_quantities(of_one, [experiment]), *_quantities(set(names), [experiment])]
    wanted = {name for _, metrics, _ in quantities for name in metrics}
    return [name for name in names if name in wanted]


def _quantities(present: set[str], experiments: Sequence[ExperimentRecord]) -> list[tuple[str, tuple[str, ...], bool]]:
    """What is drawn of the metrics that are ``present``.

    Returns:
        Title, the metric of each of KINDS, and whether it is a score, which is comparable only within the same
        environment and utility.
    """
    ours = any("mo-deepdrive" in experiment.environment.id for experiment in experiments)
    parts = [split_name(name) for name in sorted(present)]
    vehicles = sorted({part.vehicle for part in parts if part.vehicle}) or [""]
    objectives = {part.metric.removeprefix(RETURN) for part in parts if part.metric.startswith(RETURN)}
    ordered = sorted(objectives, key=lambda name: (INDEX.get(name, len(INDEX)), name))
    found = []
    for vehicle in vehicles:
        inner = f"{vehicle}/" if vehicle else ""
        prefix = f"{vehicle.replace('_', ' ')}: " if vehicle else ""
        wanted = [((name,) * len(KINDS), True) for name in INDICATORS]
        wanted.append((tuple(kind.utility for kind in KINDS), True))
        if ours:
            wanted.append(((SUCCESS,) * len(KINDS), False))
        # Our return of the destination is the arrival rate again.
        wanted += [((return_of(name),) * len(KINDS), False) for name in ordered if not (ours and name == "destination")]
        for names, is_score in wanted:
            metrics = tuple(f"{kind.prefix}{inner}{name}" for kind, name in zip(KINDS, names, strict=True))
            if present & set(metrics):
                text = prefix + title_of(names[0])
                found.append((text[0].upper() + text[1:], metrics, is_score))
    together = tuple(kind.prefix + SUCCESS for kind in KINDS)
    if len(vehicles) > 1 and present & set(together):
        found.append((f"All vehicles: {title_of(SUCCESS)}", together, False))
    return found


def _draw_panel(axis: Axes, groups: Sequence[CurveGroup], panel: CurvePanel) -> None:
    alone = len(groups) == 1
    faint = min(1.0, 4 / len(groups))  # or many bands would hide each other
    late: list[NDArray[Any]] = []
    every: list[NDArray[Any]] = []
    bands: list[NDArray[Any]] = []
    styles = _styles(groups)
    for g in panel.groups:
        colour, marker = styles[g]
        for k, (kind, name) in enumerate(zip(KINDS, panel.names, strict=True)):
            if not alone and k == 0:
                continue  # with several groups only evaluations, to avoid clutter
            found = curve(groups[g].runs, name)
            if found is None:
                continue
            steps, mean, low, high = found
            every.append(mean)
            late.append(mean[steps >= SETTLED * steps.max()])
            shade = TRAINING_COLOUR if k == 0 else colour
            axis.plot(
                steps,
                mean,
                kind.line,
                color=shade,
                linewidth=kind.width,
                marker=marker or ("o" if len(steps) < 4 else ""),
                markevery=max(1, len(steps) // MARKS),
                markersize=3.5,
                zorder=3,
            )
            if np.isfinite(low).all():
                alpha = faint * (0.16 if alone or k == 1 else 0.07)
                axis.fill_between(steps, low, high, color=shade, alpha=alpha, linewidth=0, zorder=2)
                bands += [low, high]
    axis.set_title(panel.title + _limit_y_axis(axis, every, late, bands, panel.names[-1]))
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    axis.xaxis.set_major_locator(MaxNLocator(5))
    axis.yaxis.set_major_locator(MaxNLocator(5))
    axis.margins(x=0.015)
    if panel.title.lower().endswith(title_of(SUCCESS)):
        axis.set_title(panel.title)
        axis.set_ylim(-0.03, 1.03)
        axis.yaxis.set_major_formatter(PercentFormatter(1.0))


def _limit_y_axis(
    axis: Axes,
    every: Sequence[NDArray[Any]],
    late: Sequence[NDArray[Any]],
    bands: Sequence[NDArray[Any]],
    name: str,
) -> str:
    """Limit the axis to the settled values if the first steps would flatten them, and never to noise.

    Returns:
        A suffix for the title.
    """
    if not every:
        return ""
    values, settled = np.concatenate(every), np.concatenate(late)
    low, high = np.nanmin(settled), np.nanmax(settled)
    low, high = widened(low, high, quantity_scale(name, settled))
    pad = 0.25 * max(high - low, 1e-6)
    if np.nanmax(values) - np.nanmin(values) >= CUT_RATIO * (high - low + 2 * pad):
        axis.set_ylim(low - pad, high + pad)
        return " (start cut off)"
    drawn = np.concatenate([values, *bands])
    low, high = widened(np.nanmin(drawn), np.nanmax(drawn), quantity_scale(name, drawn))
    pad = 0.05 * (high - low) or 0.5
    axis.set_ylim(low - pad, high + pad)
    return ""


def quantity_scale(name: str, values: NDArray[Any]) -> float:
    """The magnitude of a metric: the largest of its ``values``; of a return at least the objective's nominal scale."""
    objective = split_name(name).metric.removeprefix(RETURN)
    nominal = OBJECTIVES[INDEX[objective]].scale if objective in INDEX else 0.0
    return max(float(np.nanmax(np.abs(values))), nominal)


def _styles(groups: Sequence[CurveGroup]) -> list[tuple[str, str]]:
    """Colour and marker of each group."""
    return curve_styles([group.experiment.algorithm.name for group in groups])


def _utilities(utility: UtilityRecord | None) -> list[str]:
    """The name of the utility and those of vehicles with another one; empty if no utility is known."""
    if utility is None:
        return []
    return [utility.name, *(f"{each.name} ({v.replace('_', ' ')})" for v, each in utility.vehicles.items())]


def _frame(figure: Figure, groups: Sequence[CurveGroup], remark: str) -> None:
    """Add title, notes and legend around the panels."""
    experiment = groups[0].experiment
    alone = len(groups) == 1
    ids = dict.fromkeys(group.experiment.environment.id for group in groups)
    utilities = dict.fromkeys(name for group in groups for name in _utilities(group.experiment.utility))
    heading = f"{experiment.algorithm.name} on {', '.join(ids)}" if alone else ", ".join(ids)
    seeds = sorted({len(group.runs) for group in groups})
    count = " to ".join(str(n) for n in dict.fromkeys((seeds[0], seeds[-1])))
    note = f"utility {', '.join(utilities)}; " if utilities else ""
    note += "undiscounted returns per episode"
    if experiment.environment.arguments.get("cost_sign", "maximise") == "maximise":
        note += ", costs negative"
    note += f"; {count} seed{'' if seeds == [1] else 's'}"
    if seeds[-1] >= MIN_SAMPLES:
        note += f", bands: 95% bootstrap interval of the mean{of_three(seeds)}"
    elif seeds[-1] > 1:
        note += f", too few for an interval (n = {seeds[-1]})"
    notes = [remark, note] if remark else [note]
    handles = [
        Line2D([], [], color=colour, marker=marker, markersize=4.5, linewidth=2.4, label=_label(group))
        for group, (colour, marker) in zip(groups, _styles(groups), strict=True)
        if not alone
    ]
    present = {name for group in groups for columns in group.runs for name in columns}
    for k, kind in enumerate(KINDS):
        if (alone or k > 0) and any(name.startswith(kind.prefix) for name in present):
            colour = DIM if not alone else TRAINING_COLOUR if k == 0 else _styles(groups)[0][0]
            handles.append(Line2D([], [], color=colour, linestyle=kind.line, linewidth=kind.width, label=kind.name))
    surround(figure, heading, notes, handles)
