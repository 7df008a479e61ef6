"""Pictures of runs: learning curves, one panel per quantity; final scores, one panel per key that was varied.

Means are over seeds, or over runs, and have 95% bootstrap intervals.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, LogLocator, MaxNLocator, PercentFormatter
from numpy.typing import NDArray

from algorithms.common.metrics_file import read_metrics
from algorithms.common.yaml_io import read_mapping
from algorithms.evaluation.statistics import Estimate, bootstrap, mean
from algorithms.reporting.front_view import label
from mo_deepdrive.objectives import INDEX

Columns = dict[str, NDArray[np.float64]]

SETTLED = 0.2  # part of the training after which a curve is worth the whole height of its axis
WIDE = 30.0  # how much wider the whole range must be for the start to be cut off
# Okabe and Ito's colours, which the colour-blind can tell apart.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F7F7F", "#000000")
MAX_POINTS = 150  # per curve; more are averaged
DPI = 160
LINE = 0.19  # in, height of a line of text
# Of the picture of final scores (in): a panel, what is left of the first, between two, and above and below a row.
PANEL_WIDTH, PANEL_HEIGHT, LEFT, GAP, HEAD, FOOT, SLANTED_FOOT = 3.1, 2.1, 0.95, 0.22, 0.62, 0.42, 1.05
MOST_COLUMNS = 4
MOST_PLACES = 12  # numbers that have a mean each; of more, neighbours share one
BINS = 8  # then
LONGEST = 18  # letters of a word on an axis
SPREAD = 20.0  # ratio of numbers that are drawn on a logarithmic axis
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
            raise ValueError(
                f"{str(directory)!r} is not a run directory, which has a config.yaml, nor a sweep, which has a "
                "manifest.jsonl"
            )
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


def plot(groups: Sequence[Group], path: str | Path, remark: str = "") -> None:
    """Draw utility, arrival rate and the return of every objective against environment steps, into an image file.

    Args:
        groups: a curve each.
        path: the file.
        remark: what else the picture should say.

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
            _panel(axis, groups, panels[i])
            if i + columns >= len(panels):
                axis.set_xlabel("environment steps")
        _frame(figure, groups, remark)
        figure.savefig(path, dpi=DPI)


@dataclass(frozen=True)
class Panel:
    """What a panel shows: the metric of each of KINDS, of some of the groups (their places)."""

    title: str
    names: tuple[str, ...]
    groups: tuple[int, ...]


def _panels(groups: Sequence[Group]) -> list[Panel]:
    """The panels that have a curve; scores that cannot be compared are apart."""
    present = [{name for columns in group.runs for name in columns} for group in groups]
    panels: list[Panel] = []
    for title, names, is_score in _quantities(set().union(*present), [group.config for group in groups]):
        tasks: dict[tuple[str, ...], list[int]] = {}
        for g, group in enumerate(groups):
            if present[g] & set(names):
                tasks.setdefault(_task(group.config) if is_score else (), []).append(g)
        for task, members in tasks.items():
            apart = [part for i, part in enumerate(task) if len({each[i] for each in tasks}) > 1]
            text = f"{title.removesuffix(' per episode')}: {', '.join(apart)}" if apart else title
            panels.append(Panel(text, names, tuple(members)))
    return panels


def _task(config: Mapping[str, Any]) -> tuple[str, ...]:
    """What a score is of: environment and utility."""
    return config["environment"]["id"], ", ".join(_utilities(config.get("utility")))


def drawn(names: Sequence[str], config: Mapping[str, Any]) -> list[str]:
    """Those of some metrics that :func:`plot` draws of runs with ``config``."""
    wanted = {name for _, metrics, _ in _quantities(set(names), [config]) for name in metrics}
    return [name for name in names if name in wanted]


def _quantities(present: set[str], configs: Sequence[Mapping[str, Any]]) -> list[tuple[str, tuple[str, ...], bool]]:
    """Of the metrics that are present, what is drawn: titles, the metric of each of KINDS, and whether it is a score,
    which other environments and utilities measure in another way."""
    ours = any("mo-deepdrive" in config["environment"]["id"] for config in configs)
    vehicles = sorted({part for name in present for part in name.split("/") if part.startswith("vehicle_")}) or [""]
    objectives = dict.fromkeys(name.rpartition("return/")[2] for name in sorted(present) if "/return/" in name)
    ordered = sorted(objectives, key=lambda name: (INDEX.get(name, len(INDEX)), name))
    found = []
    for vehicle in vehicles:
        inner = f"{vehicle}/" if vehicle else ""
        prefix = f"{vehicle.replace('_', ' ')}: " if vehicle else ""
        wanted = [(title, (metric,) * len(KINDS), True) for title, metric in INDICATORS]
        wanted.append(("utility per episode", tuple(kind.utility for kind in KINDS), True))
        if ours:
            wanted.append(("arrival rate", ("success",) * len(KINDS), False))
        wanted += [(_title(name), (f"return/{name}",) * len(KINDS), False) for name in ordered]
        for title, names, is_score in wanted:
            metrics = tuple(f"{kind.prefix}{inner}{name}" for kind, name in zip(KINDS, names, strict=True))
            if present & set(metrics):
                text = prefix + title
                found.append((text[0].upper() + text[1:], metrics, is_score))
    together = tuple(f"{kind.prefix}success" for kind in KINDS)
    if len(vehicles) > 1 and present & set(together):
        found.append(("All vehicles: arrival rate", together, False))
    return found


def _title(objective: str) -> str:
    return label(objective) if objective in INDEX else objective.replace("_", " ")


def _panel(axis: Axes, groups: Sequence[Group], panel: Panel) -> None:
    alone = len(groups) == 1
    faint = min(1.0, 4 / len(groups))  # many bands would hide each other
    late: list[NDArray[Any]] = []
    every: list[NDArray[Any]] = []
    for g in panel.groups:
        for k, (kind, name) in enumerate(zip(KINDS, panel.names, strict=True)):
            if not alone and k == 0:
                continue  # several groups: the evaluations alone, or nobody sees anything
            found = curve(groups[g].runs, name)
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
                alpha = faint * (0.16 if alone or k == 1 else 0.07)
                axis.fill_between(steps, low, high, color=colour, alpha=alpha, linewidth=0, zorder=2)
    axis.set_title(panel.title + _cut_off(axis, every, late))
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    axis.xaxis.set_major_locator(MaxNLocator(5))
    axis.yaxis.set_major_locator(MaxNLocator(5))
    axis.margins(x=0.015)
    if panel.title.lower().endswith("arrival rate"):
        axis.set_title(panel.title)
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


def _frame(figure: Figure, groups: Sequence[Group], remark: str) -> None:
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
    notes = [remark, note] if remark else [note]
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
    _surround(figure, title, notes, handles)


def _surround(figure: Figure, title: str, notes: Sequence[str], handles: Sequence[Line2D]) -> None:
    """Title and notes above the panels, the legend below them; what does not fit into a line makes the picture higher.

    Args:
        figure: with its panels.
        title: a line.
        notes: lines.
        handles: of the legend.
    """
    widths = np.array([_inches(str(handle.get_label())) + 0.62 for handle in handles])
    columns = len(handles)
    while columns > 1 and sum(part.max() for part in np.array_split(widths, columns)) > figure.get_figwidth():
        columns -= 1
    lines = -(-len(handles) // columns)
    height = figure.get_figheight() + LINE * (lines - 1 + len(notes) - 1)
    figure.set_figheight(height)
    figure.text(0.012, 1 - 0.12 / height, title, fontsize=13, fontweight="bold", va="top")
    figure.text(0.012, 1 - 0.40 / height, "\n".join(notes), fontsize=9.5, color="#5B6470", va="top")
    figure.legend(handles=handles, loc="lower left", bbox_to_anchor=(0.006, 0.0), ncols=columns, frameon=False)
    above, below = 0.62 + LINE * (len(notes) - 1), 0.34 + LINE * (lines - 1)
    figure.tight_layout(rect=(0, below / height, 1, 1 - above / height), h_pad=1.4, w_pad=1.6)


def _inches(text: str) -> float:
    """About the width of a text in the usual size."""
    return 0.078 * len(text)


@dataclass(frozen=True)
class Scores:
    """Final scores of runs that can be compared, and what was varied among these runs.

    Attributes:
        title: environment and utility.
        what: the name of the score.
        values: (runs,).
        keys: by the name of each key that varies, the value that each run had: (runs,) numbers, or else words.
    """

    title: str
    what: str
    values: NDArray[np.float64]
    keys: dict[str, NDArray[np.float64] | list[str]]


def plot_scores(scores: Sequence[Scores], path: str | Path, title: str, remark: str = "") -> None:
    """Draw final scores against every key that varies: a panel per key, a dot per run, the mean per value.

    Scores that cannot be compared are in rows of their own.

    Args:
        scores: at least one, each with at least one key.
        path: an image file.
        title: of the picture.
        remark: what else the picture should say.

    Raises:
        ValueError: if the file's ending names no image format.
        OSError: if the file cannot be written.
    """
    notes = ["dots: runs; circles: means of the runs that share a value, or have neighbouring ones, with 95% intervals"]
    notes += [remark] if remark else []
    rows: list[tuple[Scores, str, list[tuple[str, Effect]], tuple[float, float]]] = []
    for s, each in enumerate(scores):
        effects = [(key, _effect(values, each.values)) for key, values in each.keys.items()]
        limits = _limits(each.values, [effect for _, effect in effects])
        count = -(-len(effects) // MOST_COLUMNS)
        size = -(-len(effects) // count)
        for first in range(0, len(effects), size):
            rows.append((each, COLOURS[s % len(COLOURS)], effects[first : first + size], limits))
    heads = [HEAD if r == 0 or rows[r - 1][0] is not row[0] else 0.3 for r, row in enumerate(rows)]
    feet = [SLANTED_FOOT if any(effect.slanted for _, effect in effects) else FOOT for _, _, effects, _ in rows]
    widest = max(len(effects) for _, _, effects, _ in rows)
    texts = [1.3 * _inches(text) for text in [title, *(each.title for each in scores)]]  # larger, and bold
    width = max(LEFT + widest * (PANEL_WIDTH + GAP), max(*texts, *map(_inches, notes)) + 0.3)
    above = 0.42 + LINE * len(notes)
    height = above + sum(heads) + sum(feet) + PANEL_HEIGHT * len(rows)
    with matplotlib.rc_context({**STYLE, "text.parse_math": False}):
        figure = Figure(figsize=(width, height))

        def write(y: float, text: str, **style: Any) -> None:
            figure.text(0.12 / width, y / height, text, va="top", **style)

        write(height - 0.12, title, fontsize=13, fontweight="bold")
        write(height - 0.40, "\n".join(notes), color="#5B6470")
        y = height - above
        for (each, colour, effects, limits), head, foot in zip(rows, heads, feet, strict=True):
            if head == HEAD:
                write(y - 0.1, each.title, fontsize=11, fontweight="bold", color=colour)
            y -= head + PANEL_HEIGHT
            for k, (key, effect) in enumerate(effects):
                left = LEFT + k * (PANEL_WIDTH + GAP)
                axis = figure.add_axes((left / width, y / height, PANEL_WIDTH / width, PANEL_HEIGHT / height))
                _draw_effect(axis, effect, each.values, colour, limits)
                axis.set_title(key)
                axis.tick_params(left=k == 0, labelleft=k == 0)
                if k == 0:
                    axis.set_ylabel(each.what)
            y -= foot
        figure.savefig(path, dpi=DPI)


def _effect(values: NDArray[np.float64] | list[str], scores: NDArray[np.float64]) -> Effect:
    return _of_words(values, scores) if isinstance(values, list) else _of_numbers(values, scores)


@dataclass(frozen=True)
class Effect:
    """What a panel shows of a key.

    Attributes:
        at: (runs,) where each run is on the axis.
        parts: the runs (their places) that share a mean.
        means: of the parts.
        ends: of the axis.
        ticks: places on the axis, and what to write there.
        slanted: whether that is too long to be level.
        jitter: by how much runs are drawn beside their places, so as not to hide each other.
        line: between the means.
    """

    at: NDArray[np.float64]
    parts: list[NDArray[np.intp]]
    means: list[Estimate]
    ends: tuple[float, float]
    ticks: dict[float, str]
    slanted: bool
    jitter: float
    line: Literal["-", ""]


def _of_words(words: Sequence[str], scores: NDArray[np.float64]) -> Effect:
    known = list(dict.fromkeys(words))
    at = np.array([known.index(word) for word in words], dtype=np.float64)
    parts = [np.flatnonzero(at == i) for i in range(len(known))]
    written = [word if len(word) <= LONGEST else f"{word[: LONGEST - 1]}…" for word in known]
    ticks = {float(i): word for i, word in enumerate(written)}
    slanted = len(_thinned(ticks, len(known))) < len(known)
    if slanted:
        every = math.ceil(len(known) * LINE / PANEL_WIDTH)
        ticks = {place: word for place, word in ticks.items() if place % every == 0}
    means = [mean(scores[part]) for part in parts]
    return Effect(at, parts, means, (-0.5, len(known) - 0.5), ticks, slanted, 0.12, "")


def _of_numbers(numbers: NDArray[np.float64], scores: NDArray[np.float64]) -> Effect:
    logarithmic = _is_logarithmic(np.unique(numbers))
    at = np.log10(numbers) if logarithmic else numbers
    places = np.unique(at)
    many = len(places) > MOST_PLACES
    parts = np.array_split(np.argsort(at, kind="stable"), BINS) if many else [np.flatnonzero(at == p) for p in places]
    extent = np.ptp(places)
    return Effect(
        at,
        parts,
        [mean(scores[part]) for part in parts],
        (places[0] - 0.06 * extent, places[-1] + 0.06 * extent),
        _thinned(_number_ticks(places, logarithmic), extent),
        False,
        0.0 if many else 0.015 * extent,
        "-",
    )


def _draw_effect(
    axis: Axes, effect: Effect, scores: NDArray[np.float64], colour: str, limits: tuple[float, float]
) -> None:
    aside = np.random.default_rng(0).uniform(-effect.jitter, effect.jitter, len(scores))
    values = np.array([each.value for each in effect.means])
    axis.plot(effect.at + aside, scores, "o", color=colour, alpha=0.3, markersize=3.5, markeredgewidth=0, zorder=2)
    axis.errorbar(
        [effect.at[part].mean() for part in effect.parts],
        values,
        np.transpose([_beyond(each) for each in effect.means]),
        fmt=f"o{effect.line}",
        color=STYLE["text.color"],
        markersize=4.5,
        linewidth=1.2,
        capsize=3,
        zorder=3,
    )
    turned: dict[str, Any] = {"rotation": 35, "ha": "right", "rotation_mode": "anchor"} if effect.slanted else {}
    axis.set_xticks(list(effect.ticks), list(effect.ticks.values()), **turned)
    axis.set_xlim(*effect.ends)
    axis.set_ylim(*limits)
    axis.yaxis.set_major_locator(MaxNLocator(5))
    below, above = (scores < limits[0], values < limits[0]), (scores > limits[1], values > limits[1])
    for (runs, means), where, y, side in ((below, "below", 0.02, "bottom"), (above, "above", 0.98, "top")):
        counts = [(int(runs.sum()), "run"), (int(means.sum()), "mean")]
        beyond = [f"{count} {what}{'' if count == 1 else 's'}" for count, what in counts if count]
        if beyond:
            text = f"{' and '.join(beyond)} {where}"
            behind = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}
            style: dict[str, Any] = {"fontsize": 8, "color": "#5B6470", "bbox": behind, "zorder": 4}
            axis.text(0.99, y, text, transform=axis.transAxes, ha="right", va=side, **style)


def _beyond(mean: Estimate) -> tuple[float, float]:
    """How far the interval reaches below and above the value."""
    if mean.low is None or mean.high is None:
        return 0.0, 0.0
    return mean.value - mean.low, mean.high - mean.value


def _limits(scores: NDArray[np.float64], effects: Sequence[Effect]) -> tuple[float, float]:
    """Of the axis of scores: around all, but for those that lie so far from most that they would flatten the rest."""
    means = [mean for effect in effects for mean in effect.means]
    ends = [end for mean in means for end in (mean.low, mean.value, mean.high) if end is not None]
    low, high = np.quantile(scores, [0.05, 0.95])
    reach = high - low or np.ptp(scores)
    every = np.array([*scores, *ends])
    near = every[(every >= low - reach) & (every <= high + reach)]
    low, high = near.min(), near.max()
    pad = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    return float(low - pad), float(high + pad)


def _is_logarithmic(places: NDArray[np.float64]) -> bool:
    """Whether numbers, sorted, spread over orders of magnitude, or grow by factors rather than by steps."""
    if places[0] <= 0.0:
        return False
    steps, factors = np.diff(places), np.diff(np.log(places))
    few = 3 <= len(places) <= MOST_PLACES
    grows = few and np.std(factors) / np.mean(factors) < np.std(steps) / np.mean(steps)
    return bool(places[-1] / places[0] >= SPREAD or grows)


def _number_ticks(places: NDArray[np.float64], logarithmic: bool) -> dict[float, str]:
    """The places where there are few, else round numbers."""
    if len(places) > MOST_PLACES:
        low, high = places[0], places[-1]
        if logarithmic:
            wide = high - low > 2.0
            found = LogLocator(subs=(1.0,) if wide else (1.0, 3.0)).tick_values(10.0**low, 10.0**high)
            places = np.log10(found)
        else:
            places = np.asarray(MaxNLocator(5).tick_values(low, high))
        places = places[(places >= low) & (places <= high)]
    engineering = EngFormatter(sep="")

    def text(number: float) -> str:
        return engineering(number) if abs(number) >= 10_000 else f"{number:.4g}"

    return {float(place): text(10.0**place if logarithmic else place) for place in places}


def _thinned(ticks: Mapping[float, str], extent: float) -> dict[float, str]:
    """The ticks without those whose texts would touch the one before."""
    kept: dict[float, str] = {}
    end = -np.inf
    for place, text in ticks.items():
        middle, half = place / extent * PANEL_WIDTH, _inches(text) / 2
        if middle - half > end:
            kept[place] = text
            end = middle + half + 0.06
    return kept
