"""Learning curves: one panel per quantity, mean over seeds with 95% bootstrap intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, MaxNLocator, PercentFormatter
from numpy.typing import NDArray

from algorithms.front_views import label
from algorithms.intervals import bootstrap
from algorithms.logging import read_metrics
from algorithms.yaml_files import read_mapping
from mo_deepdrive.objectives import INDEX

Columns = dict[str, NDArray[np.float64]]

SETTLED = 0.2  # part of the training after which a curve is worth the whole height of its axis
WIDE = 30.0  # how much wider the whole range must be for the start to be cut off
# Okabe and Ito's colours, which the colour-blind can tell apart.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F7F7F", "#000000")
MAX_POINTS = 150  # per curve; more are averaged
# Sections and keys of a config that do not change what is learnt.
IRRELEVANT = ("training.seed", "training.device", "training.threads", "logging")
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": "#5B6470",
    "axes.labelcolor": "#3C434C",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E4E7EB",
    "grid.linewidth": 0.8,
    "xtick.color": "#5B6470",
    "ytick.color": "#5B6470",
    "text.color": "#23282F",
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}


@dataclass(frozen=True)
class Kind:
    """A kind of curve: the prefix of its metrics, the name of its utility, and how it is drawn."""

    name: str
    prefix: str
    utility: str
    line: Literal["-", "--"]
    width: float


KINDS = (
    Kind("training", "train/", "utility", "-", 1.1),
    Kind("evaluation, greedy", "eval/greedy/", "utility_esr", "-", 2.0),
    Kind("evaluation, stochastic", "eval/stochastic/", "utility_esr", "--", 1.7),
    Kind("front (returns: the best of its policies)", "eval/front/", "utility_esr", "-", 2.0),
)
# Panels of fronts: titles and metrics.
INDICATORS = (
    ("hypervolume", "hypervolume"),
    ("policies of the front", "cardinality"),
    ("expected utility, 50 weights", "expected_utility"),
    ("IGD+ to the best-known front", "igd_plus"),
)


@dataclass(frozen=True)
class Group:
    """Runs that differ in their seed alone.

    Attributes:
        label: what tells it from the other groups.
        config: of one of the runs.
        runs: the columns of every run's metrics.csv.
    """

    label: str
    config: dict[str, Any]
    runs: tuple[Columns, ...]


def load_groups(directories: Sequence[str | Path]) -> list[Group]:
    """Read runs and group them by everything in their configs but the seed.

    Raises:
        ValueError: if a directory is no run or has no metrics yet, or two runs of a group have the same seed.
    """
    found: dict[str, list[tuple[Path, dict[str, Any], Columns]]] = {}
    for directory in map(Path, directories):
        if not (directory / "config.yaml").is_file():
            raise ValueError(f"{str(directory)!r} is not a run directory: it has no config.yaml")
        config, columns = read_mapping(directory / "config.yaml"), read_metrics(directory / "metrics.csv")
        if not len(columns["step"]):
            raise ValueError(f"run {str(directory)!r} has no metrics yet")
        members = found.setdefault(repr(_relevant(config)), [])
        for other, other_config, _ in members:
            if other_config["training"]["seed"] == config["training"]["seed"]:
                raise ValueError(f"runs {str(other)!r} and {str(directory)!r} are the same seed; give one of them")
        members.append((directory, config, columns))
    groups = list(found.values())
    labels = _labels([members[0][1] for members in groups])
    return [
        Group(label, members[0][1], tuple(columns for _, _, columns in members))
        for label, members in zip(labels, groups, strict=True)
    ]


def _flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flatten(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {prefix + key: value}
    return flat


def _relevant(config: Mapping[str, Any]) -> dict[str, Any]:
    flat = _flatten(config)
    return {key: flat[key] for key in sorted(flat) if key not in IRRELEVANT and key.split(".")[0] not in IRRELEVANT}


def _labels(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """The algorithm's name, and the settings that every config has and that differ where names alone do not do."""
    flat = [_relevant(config) for config in configs]
    names = [each["algorithm.name"] for each in flat]
    shared = set.intersection(*(set(each) for each in flat)) if flat else set()
    differing = sorted(key for key in shared if len({repr(each[key]) for each in flat}) > 1)
    where = [key for key in differing if key in ("environment.id", "utility.name")]
    if len(set(names)) < len(names):
        where = [key for key in differing if key != "algorithm.name"]
    return [
        ", ".join([name, *(f"{key.rpartition('.')[2]} {each[key]}" for key in where[:4])])
        for name, each in zip(names, flat, strict=True)
    ]


def curve(runs: Sequence[Columns], name: str) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]] | None:
    """Steps, mean over the runs that have the metric, and the interval's ends, each (points,); None if none has it.

    Runs are compared at the steps of the first, as far as all of them have come; an interval of one run is NaN.
    """
    series = []
    for columns in runs:
        if name in columns:
            known = np.isfinite(columns[name])
            if known.any():
                series.append((columns["step"][known], columns[name][known]))
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


def plot(groups: Sequence[Group], path: str | Path) -> None:
    """Draw utility, arrival rate and the return of every objective against environment steps, into an image file.

    Raises:
        ValueError: if there is nothing to draw, or the file's ending names no image format.
        OSError: if the file cannot be written.
    """
    panels = _panels(groups)
    if not panels:
        raise ValueError("the runs have no metrics to draw yet")
    columns = min(len(panels), 3 if len(panels) in (3, 5, 6, 9) else 4)
    rows = -(-len(panels) // columns)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(4.1 * columns, 2.75 * rows + 1.0))  # without pyplot, so without a display
        axes = figure.subplots(rows, columns, squeeze=False)
        for i, axis in enumerate(axes.flat):
            if i >= len(panels):
                axis.set_visible(False)
                continue
            _panel(axis, groups, *panels[i])
            if i + columns >= len(panels):
                axis.set_xlabel("environment steps")
        _frame(figure, groups)
        figure.savefig(path, dpi=160)


def _panels(groups: Sequence[Group]) -> list[tuple[str, tuple[str, ...]]]:
    """Titles, and the metric of each kind, of the panels that have a curve."""
    present = {name for group in groups for columns in group.runs for name in columns}
    ours = any("mo-deepdrive" in group.config["environment"]["id"] for group in groups)
    vehicles = sorted({name.split("/")[1] for name in present if name.startswith("train/vehicle_")}) or [""]
    objectives = dict.fromkeys(name.rpartition("return/")[2] for name in sorted(present) if "/return/" in name)
    ordered = sorted(objectives, key=lambda name: (INDEX.get(name, len(INDEX)), name))
    panels = []
    for vehicle in vehicles:
        inner = f"{vehicle}/" if vehicle else ""
        prefix = f"{vehicle.replace('_', ' ')}: " if vehicle else ""
        wanted = [(title, (metric,) * len(KINDS)) for title, metric in INDICATORS]
        wanted.append(("utility per episode", tuple(kind.utility for kind in KINDS)))
        if ours:
            wanted.append(("arrival rate", ("success",) * len(KINDS)))
        wanted += [(_title(name), (f"return/{name}",) * len(KINDS)) for name in ordered]
        for title, names in wanted:
            metrics = tuple(f"{kind.prefix}{inner}{name}" for kind, name in zip(KINDS, names, strict=True))
            if present & set(metrics):
                text = prefix + title
                panels.append((text[0].upper() + text[1:], metrics))
    together = tuple(f"{kind.prefix}success" for kind in KINDS)
    if len(vehicles) > 1 and present & set(together):
        panels.append(("All vehicles: arrival rate", together))
    return panels


def _title(objective: str) -> str:
    return label(objective) if objective in INDEX else objective.replace("_", " ")


def _panel(axis: Axes, groups: Sequence[Group], title: str, names: tuple[str, ...]) -> None:
    alone = len(groups) == 1
    late: list[NDArray[Any]] = []
    every: list[NDArray[Any]] = []
    for g, group in enumerate(groups):
        for k, (kind, name) in enumerate(zip(KINDS, names, strict=True)):
            if not alone and k == 0:
                continue  # several groups: the evaluations alone, or nobody sees anything
            found = curve(group.runs, name)
            if found is None:
                continue
            steps, mean, low, high = found
            every.append(mean)
            late.append(mean[steps >= SETTLED * steps.max()])
            colour = _colour(groups, g, k)
            marker = "o" if len(steps) < 4 else ""
            axis.plot(
                steps, mean, kind.line, color=colour, linewidth=kind.width, marker=marker, markersize=3.5, zorder=3
            )
            if np.isfinite(low).all():
                axis.fill_between(
                    steps, low, high, color=colour, alpha=0.16 if alone or k == 1 else 0.07, linewidth=0, zorder=2
                )
    axis.set_title(title + _cut_off(axis, every, late))
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    axis.xaxis.set_major_locator(MaxNLocator(5))
    axis.yaxis.set_major_locator(MaxNLocator(5))
    axis.margins(x=0.015)
    if title.lower().endswith("arrival rate"):
        axis.set_title(title)
        axis.set_ylim(-0.03, 1.03)
        axis.yaxis.set_major_formatter(PercentFormatter(1.0))


def _cut_off(axis: Axes, every: Sequence[NDArray[Any]], late: Sequence[NDArray[Any]]) -> str:
    """Cut the axis where the first steps would flatten everything that follows; what to add to the title."""
    if not every:
        return ""
    values, settled = np.concatenate(every), np.concatenate(late)
    low, high = np.nanmin(settled), np.nanmax(settled)
    pad = 0.25 * max(high - low, 0.05 * abs(high), 1e-6)
    if np.nanmax(values) - np.nanmin(values) < WIDE * (high - low + 2 * pad):
        return ""
    axis.set_ylim(low - pad, high + pad)
    return " (start cut off)"


def _colour(groups: Sequence[Group], g: int, k: int) -> str:
    if len(groups) > 1:
        return COLOURS[g % len(COLOURS)]
    return ("#9AA3AD", COLOURS[0], COLOURS[1], COLOURS[0])[k]


def _utilities(settings: Mapping[str, Any] | None) -> list[str]:
    """The name of the utility, and of each vehicle's that has another one; nothing where none is known."""
    if settings is None:
        return []
    own = [f"{each['name']} ({vehicle.replace('_', ' ')})" for vehicle, each in settings.get("vehicles", {}).items()]
    return [settings["name"], *own]


def _frame(figure: Figure, groups: Sequence[Group]) -> None:
    """Title, note and legend around the panels."""
    config = groups[0].config
    alone = len(groups) == 1
    ids = dict.fromkeys(group.config["environment"]["id"] for group in groups)
    utilities = dict.fromkeys(name for group in groups for name in _utilities(group.config.get("utility")))
    title = f"{config['algorithm']['name']} on {', '.join(ids)}" if alone else ", ".join(ids)
    seeds = sorted({len(group.runs) for group in groups})
    count = " to ".join(str(n) for n in dict.fromkeys((seeds[0], seeds[-1])))
    note = f"utility {', '.join(utilities)}; " if utilities else ""
    note += "undiscounted returns per episode"
    if config["environment"].get("arguments", {}).get("cost_sign", "maximise") == "maximise":
        note += ", costs negative"
    note += f"; {count} seed{'' if seeds == [1] else 's'}"
    note += ", bands: 95% bootstrap interval of the mean" if seeds[-1] > 1 else ""
    handles = [
        Line2D([], [], color=_colour(groups, g, 1), linewidth=2.4, label=group.label)
        for g, group in enumerate(groups)
        if not alone
    ]
    present = {name for group in groups for columns in group.runs for name in columns}
    for k, kind in enumerate(KINDS):
        if (alone or k > 0) and any(name.startswith(kind.prefix) for name in present):
            colour = _colour(groups, 0, k) if alone else "#5B6470"
            handles.append(Line2D([], [], color=colour, linestyle=kind.line, linewidth=kind.width, label=kind.name))
    height = figure.get_figheight()
    figure.text(0.012, 1 - 0.12 / height, title, fontsize=13, fontweight="bold", va="top")
    figure.text(0.012, 1 - 0.40 / height, note, fontsize=9.5, color="#5B6470", va="top")
    figure.legend(handles=handles, loc="lower left", bbox_to_anchor=(0.006, 0.0), ncols=len(handles), frameon=False)
    figure.tight_layout(rect=(0, 0.34 / height, 1, 1 - 0.62 / height), h_pad=1.4, w_pad=1.6)
