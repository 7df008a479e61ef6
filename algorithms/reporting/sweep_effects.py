"""Final scores of runs against what was varied among them: one panel per key.

Runs have the colours of their algorithms. Means are over runs and have 95% bootstrap intervals from three runs on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, FuncFormatter, MaxNLocator
from scipy.stats import gmean

from algorithms.reporting.style import DIM, INK, algorithm_colours, figure_style, save_figure, surround, widened
from mo_deepdrive.evaluation.statistics import MIN_SAMPLES, Estimate, mean, of_three

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

PANEL = (3.3, 3.2)  # in, width and height with its labels
PANEL_LETTERS = 46  # that fit side by side below a panel; labels with more are slanted
PANEL_LINES = 16  # slanted labels that fit
MAX_COLUMNS = 4
MAX_VALUES = 12  # of a numeric key that get a mean each; with more, neighbours share one
BINS = 8  # means of a numeric key with more values
MAX_LETTERS = 18  # of a word on an axis
LOGARITHMIC_RATIO = 20.0  # of the largest to the smallest value from which on an axis is logarithmic


@dataclass(frozen=True)
class VariedScores:
    """Final scores of runs that can be compared, and what was varied among these runs.

    Attributes:
        title: environment and utility.
        score: name of the score.
        values: (runs,) scores.
        algorithms: (runs,) names of the algorithms.
        keys: the values that the runs had of each key that varies, by its name: (runs,) numbers, or else words.
    """

    title: str
    score: str
    values: NDArray[np.float64]
    algorithms: tuple[str, ...]
    keys: dict[str, NDArray[np.float64] | list[str]]


def plot_effects(scores: Sequence[VariedScores], path: str | Path, title: str, remark: str = "") -> None:
    """Draw final scores against every key that varies: a panel per key, a dot per run, the mean per value.

    Scores that cannot be compared are drawn in separate rows.

    Args:
        scores: at least one, each with at least one key.
        path: the image file.
        title: of the figure.
        remark: an additional line below the title.

    Raises:
        ValueError: if the file's suffix is not an image format.
        OSError: if the file cannot be written.
    """
    notes = [
        "dots: runs; circles: means of the runs that share a value, or have neighbouring ones, with 95% intervals of "
        f"{MIN_SAMPLES} runs or more{of_three([MIN_SAMPLES], 'runs')}"
    ]
    notes += [remark] if remark else []
    colours = algorithm_colours(name for each in scores for name in each.algorithms)
    rows: list[tuple[VariedScores, list[tuple[str, KeyEffect]], tuple[float, float]]] = []
    for each in scores:
        effects = [(key, _effect(values, each.values)) for key, values in each.keys.items()]
        limits = score_limits(each.values, [effect for _, effect in effects])
        count = -(-len(effects) // MAX_COLUMNS)
        size = -(-len(effects) // count)
        rows += [(each, effects[first : first + size], limits) for first in range(0, len(effects), size)]
    columns = max(len(effects) for _, effects, _ in rows)
    with figure_style({"text.parse_math": False}):
        figure = Figure(figsize=(PANEL[0] * max(columns, 2), PANEL[1] * len(rows)))
        parts: Any = figure.subfigures(len(rows), 1, squeeze=False)[:, 0]
        for r, (part, (each, effects, limits)) in enumerate(zip(parts, rows, strict=True)):
            if r == 0 or rows[r - 1][0] is not each:
                part.suptitle(each.title, x=0.01, ha="left", fontsize=11, fontweight="bold")
            for k, axis in enumerate(part.subplots(1, columns, squeeze=False, sharey=True)[0]):
                if k >= len(effects):
                    axis.set_visible(False)
                    continue
                key, effect = effects[k]
                _draw_effect(axis, effect, each.values, [colours[name] for name in each.algorithms], limits)
                axis.set_title(key)
                if k == 0:
                    axis.set_ylabel(each.score)
        handles = [
            Line2D([], [], color=colour, marker="o", linestyle="", label=name) for name, colour in colours.items()
        ]
        surround(figure, title, notes, handles if len(handles) > 1 else ())
        save_figure(figure, path)


def _effect(values: NDArray[np.float64] | list[str], scores: NDArray[np.float64]) -> KeyEffect:
    return effect_of_words(values, scores) if isinstance(values, list) else effect_of_numbers(values, scores)


@dataclass(frozen=True)
class KeyEffect:
    """What a panel shows of a key.

    Attributes:
        positions: (runs,) of the runs on the axis.
        parts: the indices of the runs that share each mean.
        means: of the parts.
        ticks: positions on the axis and their labels; None where Matplotlib chooses round numbers.
        line: line style between the means.
        logarithmic: whether the axis is.
    """

    positions: NDArray[np.float64]
    parts: list[NDArray[np.intp]]
    means: list[Estimate]
    ticks: dict[float, str] | None
    line: Literal["-", ""]
    logarithmic: bool = False

    @property
    def slanted(self) -> bool:
        """Whether the labels are too long to be horizontal."""
        texts = list((self.ticks or {}).values())
        return bool(texts) and len(texts) * max(len(text) + 1 for text in texts) > PANEL_LETTERS


def effect_of_words(words: Sequence[str], scores: NDArray[np.float64]) -> KeyEffect:
    """The effect of a key whose values are words, on ``scores`` (runs,): a mean per word."""
    known = list(dict.fromkeys(words))
    positions = np.array([known.index(word) for word in words], dtype=np.float64)
    parts = [np.flatnonzero(positions == i) for i in range(len(known))]
    labels = [word if len(word) <= MAX_LETTERS else f"{word[: MAX_LETTERS - 1]}…" for word in known]
    every = math.ceil(len(known) / PANEL_LINES)
    ticks = {float(i): labels[i] for i in range(0, len(known), every)}
    return KeyEffect(positions, parts, [mean(scores[part]) for part in parts], ticks, "")


def effect_of_numbers(numbers: NDArray[np.float64], scores: NDArray[np.float64]) -> KeyEffect:
    """The effect of a key with ``numbers`` (runs,) on ``scores`` (runs,): a mean per number or per bin of them."""
    distinct = np.unique(numbers)
    parts, ticks = np.array_split(np.argsort(numbers, kind="stable"), BINS), None
    if len(distinct) <= MAX_VALUES:
        parts = [np.flatnonzero(numbers == each) for each in distinct]
        ticks = {float(each): _text_of(each) for each in distinct}
    means = [mean(scores[part]) for part in parts]
    return KeyEffect(numbers, parts, means, ticks, "-", is_logarithmic(distinct))


def _text_of(number: float, _position: int = 0) -> str:
    return EngFormatter(sep="")(number) if abs(number) >= 10_000 else f"{number:.4g}"


def _draw_effect(
    axis: Axes, effect: KeyEffect, scores: NDArray[np.float64], colours: Sequence[str], limits: tuple[float, float]
) -> None:
    middle, positions = (gmean if effect.logarithmic else np.mean), effect.positions
    if effect.ticks is not None:  # shifted a little, or runs would hide each other
        shifts = np.random.default_rng(0).uniform(-0.02, 0.02, len(scores))
        low, high = positions.min(), positions.max()
        positions = positions * (high / low) ** shifts if effect.logarithmic else positions + (high - low) * shifts
    values = np.array([each.value for each in effect.means])
    if effect.logarithmic:
        axis.set_xscale("log")
        axis.xaxis.set_major_formatter(FuncFormatter(_text_of))
    axis.scatter(positions, scores, s=12, c=list(colours), alpha=0.4, linewidths=0, zorder=2)
    axis.errorbar(
        [middle(effect.positions[part]) for part in effect.parts],
        values,
        np.transpose([_errors(each) for each in effect.means]),
        fmt=f"o{effect.line}",
        color=INK,
        markersize=4.5,
        linewidth=1.2,
        capsize=3,
        zorder=3,
    )
    turned: dict[str, Any] = {"rotation": 35, "ha": "right", "rotation_mode": "anchor"} if effect.slanted else {}
    if effect.ticks is not None:
        axis.set_xticks(list(effect.ticks), list(effect.ticks.values()), **turned)
        axis.minorticks_off()
    elif not effect.logarithmic:
        axis.xaxis.set_major_locator(MaxNLocator(5))
    axis.margins(x=0.06 if effect.line else 0.2)
    axis.set_ylim(*limits)
    axis.yaxis.set_major_locator(MaxNLocator(5))
    below, above = (scores < limits[0], values < limits[0]), (scores > limits[1], values > limits[1])
    for (runs, means), where, y, side in ((below, "below", 0.02, "bottom"), (above, "above", 0.98, "top")):
        counts = [(int(runs.sum()), "run"), (int(means.sum()), "mean")]
        outside = [f"{count} {what}{'' if count == 1 else 's'}" for count, what in counts if count]
        if outside:
            text = f"{' and '.join(outside)} {where}"
            box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}
            style: dict[str, Any] = {"fontsize": 8, "color": DIM, "bbox": box, "zorder": 4}
            axis.text(0.99, y, text, transform=axis.transAxes, ha="right", va=side, **style)


def _errors(mean: Estimate) -> tuple[float, float]:
    """Lengths of the interval below and above the value; 0 without an interval."""
    if mean.low is None or mean.high is None:
        return 0.0, 0.0
    return mean.value - mean.low, mean.high - mean.value


def score_limits(scores: NDArray[np.float64], effects: Sequence[KeyEffect]) -> tuple[float, float]:
    """Limits of the axis of scores: around all but those so far from most of them that they would flatten the rest."""
    means = [mean for effect in effects for mean in effect.means]
    ends = [end for mean in means for end in (mean.low, mean.value, mean.high) if end is not None]
    low, high = np.quantile(scores, [0.05, 0.95])
    reach = high - low or np.ptp(scores)
    every = np.array([*scores, *ends])
    near = every[(every >= low - reach) & (every <= high + reach)]
    low, high = widened(near.min(), near.max(), np.abs(near).max())
    pad = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    return float(low - pad), float(high + pad)


def is_logarithmic(values: NDArray[np.float64]) -> bool:
    """Whether sorted ``values`` span orders of magnitude, or grow by factors rather than by steps."""
    if values[0] <= 0.0:
        return False
    steps, factors = np.diff(values), np.diff(np.log(values))
    few = 3 <= len(values) <= MAX_VALUES
    grows = few and np.std(factors) / np.mean(factors) < np.std(steps) / np.mean(steps)
    return bool(values[-1] / values[0] >= LOGARITHMIC_RATIO or grows)
