"""The figures of a sweep: learning curves of its best cells, and the scores of all runs against each key."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from algorithms.reporting.curves import CurveGroup, VariedScores, describe, plot, plot_effects
from algorithms.studies.collection import Collection, collect
from algorithms.studies.sweep_tables import Ranking, cell_labels, rank, short_names, value_labels, varying_keys
from mo_deepdrive.evaluation.metrics import EVALUATION, STEP

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

MAX_CURVES = 8  # cells, as many as there are markers


def plot_sweep(sweep: Path, output: Path, print_line: Callable[[str], None], warn: Callable[[str], None]) -> None:
    """Draw the best cells of a sweep, and into ``OUTPUT-cells`` the scores of all runs against each key that varies."""
    collection = collect(sweep, warn)
    when, scores = collection.latest_scores()
    rankings = rank(collection.cells, scores)
    score = f"{when} {' or '.join(dict.fromkeys(ranking.score_name for ranking in rankings if ranking.scores))}"
    groups = best_curves(collection, rankings)
    count = len(collection.cells)
    left_out = count - len(groups)
    remark = f"the best {len(groups)} of {count} cells, by {score}; {left_out} left out" if left_out else ""
    plot(groups, output, remark)
    for line in [*describe(groups), *([remark] if remark else []), str(output)]:
        print_line(line)
    if varied := [effects for ranking in rankings if (effects := varied_scores(collection, ranking)).keys]:
        path = output.with_name(f"{output.stem}-cells{output.suffix}")
        plot_effects(varied, path, f"{sweep.resolve().name}: {score}")
        print_line(str(path))


def best_curves(collection: Collection, rankings: Sequence[Ranking]) -> list[CurveGroup]:
    """The curves of the best cells, of those runs that have a score; with several cells of evaluations alone.

    These are the best of every ranking, then the second best of every ranking, and so on, in the order of the rankings.
    """
    places = sorted((place, r) for r, ranking in enumerate(rankings) for place in range(len(ranking.ranked)))
    cells = [rankings[r].cells[place] for r, place in sorted((r, place) for place, r in places[:MAX_CURVES])]
    names = [name for name in collection.metrics.columns if name not in ("run", STEP)]
    wanted = names if len(cells) == 1 else [name for name in names if name.startswith(EVALUATION)]
    runs = {run for ranking in rankings for run in ranking.scores}
    labels = cell_labels(cells, varying_keys([cell.keys for cell in collection.cells]))
    groups = []
    for label, cell in zip(labels, cells, strict=True):
        columns = (collection.columns_of(row.id, sorted(wanted)) for row in cell.rows if row.id in runs)
        if logged := tuple(of_run for of_run in columns if len(of_run[STEP])):
            groups.append(CurveGroup(label, cell.experiment, logged))
    return groups


def varied_scores(collection: Collection, ranking: Ranking) -> VariedScores:
    """The scores of a ranking's runs, and the values of each key that varies among them, in the manifest's order."""
    rows = [row for row in collection.rows if row.id in ranking.scores]
    algorithms = {row.id: cell.experiment.algorithm.name for cell in ranking.cells for row in cell.rows}
    values = {}
    for key, name in short_names(varying_keys([row.cell for row in rows])).items():
        given = [row.cell.get(key) for row in rows]
        numbers = all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in given)
        values[name] = np.array(given, dtype=np.float64) if numbers else value_labels(given)
    scores = np.array([ranking.scores[row.id] for row in rows])
    return VariedScores(ranking.title, ranking.score_name, scores, tuple(algorithms[row.id] for row in rows), values)
