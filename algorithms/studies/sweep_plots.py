"""The figures of a sweep: learning curves of its best cells, and the scores of all runs against each key."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.reporting.curves import CurveGroup, VariedScores, describe, plot, plot_effects
from algorithms.studies.collection import Cell, Collection, collect
from algorithms.studies.sweep_tables import Ranking, cell_labels, rank, short_names, value_labels, varying_keys
from mo_deepdrive.evaluation.metrics import EVALUATION, STEP

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

MAX_CURVES = 8  # cells, as many as there are markers


def plot_sweep(sweep: Path, output: Path, print_line: Callable[[str], None], warn: Callable[[str], None]) -> None:
    """Draw the curves of the best cells of a sweep, and into ``OUTPUT-cells`` the scores of all runs against each key.

    Args:
        sweep: its directory.
        output: the image file of the curves.
        print_line: called with every line that describes what was drawn.
        warn: called with a message about everything that is left out.
    """
    collection = collect(sweep)
    collection.report_problems(warn)
    when, scores = collection.latest_scores()
    rankings = rank(collection.cells, scores)
    what = f"{when} {' or '.join(dict.fromkeys(ranking.score_name for ranking in rankings if ranking.scores))}"
    groups = best_curves(collection, rankings)
    count = len(collection.cells)
    left_out = count - len(groups)
    remark = f"the best {len(groups)} of {count} cells, by {what}; {left_out} left out" if left_out else ""
    plot(groups, output, remark)
    for line in [*describe(groups), *([remark] if remark else []), str(output)]:
        print_line(line)
    varied = [each for each in (varied_scores(collection, ranking) for ranking in rankings) if each.keys]
    if varied:
        path = output.with_name(f"{output.stem}-cells{output.suffix}")
        plot_effects(varied, path, f"{sweep.resolve().name}: {what}")
        print_line(str(path))


def best_cells(rankings: Sequence[Ranking]) -> list[Cell]:
    """The best cells: the best of every ranking, then the second best of every ranking, and so on, up to MAX_CURVES.

    They are returned by ranking.
    """
    places = sorted((place, r) for r, ranking in enumerate(rankings) for place in range(len(ranking.ranked)))
    return [rankings[r].cells[place] for r, place in sorted((r, place) for place, r in places[:MAX_CURVES])]


def best_curves(collection: Collection, rankings: Sequence[Ranking]) -> list[CurveGroup]:
    """The curves of the best cells, of those runs that have a score; with several cells of evaluations alone."""
    cells = best_cells(rankings)
    names = [name for name in collection.metrics.columns if name not in ("run", STEP)]
    wanted = names if len(cells) == 1 else [name for name in names if name.startswith(EVALUATION)]
    runs = {run for ranking in rankings for run in ranking.scores}
    found = collection.curves([row.id for cell in cells for row in cell.rows if row.id in runs], sorted(wanted))
    labels = cell_labels(cells, varying_keys([cell.keys for cell in collection.cells]))
    groups = [
        CurveGroup(text, cell.experiment, tuple(found[row.id] for row in cell.rows if row.id in found))
        for text, cell in zip(labels, cells, strict=True)
    ]
    return [group for group in groups if group.runs]


def varied_scores(collection: Collection, ranking: Ranking) -> VariedScores:
    """The scores of a ranking's runs, and the values of each key that varies among them, in the manifest's order."""
    rows = [row for row in collection.rows if row.id in ranking.scores]
    keys = varying_keys([row.cell for row in rows])
    names = short_names(keys)
    values = {names[key]: _numbers_or_words([row.cell.get(key) for row in rows]) for key in keys}
    algorithms = {row.id: cell.experiment.algorithm.name for cell in ranking.cells for row in cell.rows}
    return VariedScores(
        ranking.title,
        ranking.score_name,
        np.array([ranking.scores[row.id] for row in rows]),
        tuple(algorithms[row.id] for row in rows),
        values,
    )


def _numbers_or_words(values: Sequence[Any]) -> NDArray[np.float64] | list[str]:
    """Values of a key: as they are if all are numbers, else as value_labels."""
    if all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values):
        return np.array(values, dtype=np.float64)
    return value_labels(values)
