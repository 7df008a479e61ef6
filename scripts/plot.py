"""Draw learning curves: runs that differ in their seed alone become one curve with a 95% interval.

    python scripts/plot.py runs/mo_a2c_linear/* runs/a2c_linear/* --output comparison.png
    python scripts/plot.py SWEEP --output FILE.png

Of a sweep (a directory with a manifest, made by scripts/sweep.py) the best cells are drawn, by the utility or the
hypervolume of their final evaluations; and, into FILE-cells.png, these scores of all runs against each key that varies.
What the runs have scored and logged is kept for other programs in SWEEP/collected/ as Parquet files, which are brought
up to date here; algorithms/sweeps/collection.py says what is in them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from algorithms.reporting.learning_curves import Group, Scores, drawn, load_groups, plot, plot_scores
from algorithms.sweeps.collection import Cell, Collection, collect
from algorithms.sweeps.manifest import is_sweep
from algorithms.sweeps.ranking import Ranking, cell_labels, rank, short_names, value_labels, varying_keys

MOST_CURVES = 8  # cells, as many as there are colours


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """The options of this script."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("runs", nargs="+", metavar="RUN", help="directories of runs; or one sweep")
    parser.add_argument("--output", default="curves.png", metavar="FILE", help="the image (default: curves.png)")
    return parser.parse_args(arguments)


def plot_runs(directories: Sequence[str], output: Path) -> None:
    """Draw the curves of runs; say what was drawn.

    Raises:
        ValueError: if a directory is no run, or has nothing to draw; or the image's format is unknown.
        OSError: if the file cannot be written.
    """
    groups = load_groups(directories)
    plot(groups, output)
    say(groups)
    print(output)


def plot_sweep(sweep: Path, output: Path) -> None:
    """Draw the curves of the best cells of a sweep, and the scores of all; say what was drawn.

    Raises:
        ValueError: if it is no sweep or an empty one, no run has any metrics, or the image's format is unknown.
        OSError: if a file cannot be written.
    """
    collection = collect(sweep)
    for missing in collection.remarks:
        print(f"left out: {missing}", file=sys.stderr)
    when, scores = collection.latest_scores()
    settings = rank(collection.cells, scores)
    what = f"{when} {' or '.join(dict.fromkeys(setting.score_name for setting in settings if setting.scores))}"
    groups = curves(collection, settings)
    count = len(collection.cells)
    left = count - len(groups)
    remark = f"the best {len(groups)} of {count} cells, by {what}; {left} left out" if left else ""
    plot(groups, output, remark)
    say(groups)
    print(*([remark] if remark else []), output, sep="\n")
    varied = [each for each in (against_keys(collection, setting) for setting in settings) if each.keys]
    if varied:
        path = output.with_name(f"{output.stem}-cells{output.suffix}")
        plot_scores(varied, path, f"{sweep.resolve().name}: {what}")
        print(path)


def say(groups: Sequence[Group]) -> None:
    """Name what is drawn."""
    for group in groups:
        print(f"{group.label}: {len(group.runs)} seed{'' if len(group.runs) == 1 else 's'}")


def best(settings: Sequence[Ranking]) -> list[Cell]:
    """The best cells: the best of every setting, the second best of every setting, and so on; sorted by setting."""
    places = sorted((place, s) for s, setting in enumerate(settings) for place in range(len(setting.ranked)))
    return [settings[s].cells[place] for s, place in sorted((s, place) for place, s in places[:MOST_CURVES])]


def curves(collection: Collection, settings: Sequence[Ranking]) -> list[Group]:
    """The curves of the best cells: of the runs that have a score, and of several cells the policies that are scored.

    Raises:
        ValueError: if no run has any metrics.
    """
    cells = best(settings)
    names = collection.metrics.collect_schema().names()
    wanted = {name for cell in cells for name in drawn(names, cell.config)}
    if len(cells) > 1:
        scored = tuple(f"eval/{setting.policy}/" for setting in settings if setting.policy)
        wanted = {name for name in wanted if name.startswith(scored)}
    runs = {run for setting in settings for run in setting.scores}
    found = collection.curves([row.id for cell in cells for row in cell.rows if row.id in runs], sorted(wanted))
    labels = cell_labels(cells, varying_keys([cell.keys for cell in collection.cells]))
    groups = [
        Group(text, cell.config, tuple(found[row.id] for row in cell.rows if row.id in found))
        for text, cell in zip(labels, cells, strict=True)
    ]
    return [group for group in groups if group.runs]


def against_keys(collection: Collection, setting: Ranking) -> Scores:
    """The scores of a setting's runs, and the values of each key that varies among them, in the manifest's order."""
    rows = [row for row in collection.rows if row.id in setting.scores]
    keys = varying_keys([row.cell for row in rows])
    names = short_names(keys)
    values = {names[key]: numbers_or_words([row.cell.get(key) for row in rows]) for key in keys}
    return Scores(setting.title, setting.score_name, np.array([setting.scores[row.id] for row in rows]), values)


def numbers_or_words(values: Sequence[Any]) -> NDArray[np.float64] | list[str]:
    """Values of a key: as they are if all are numbers, else in words."""
    if all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values):
        return np.array(values, dtype=np.float64)
    return value_labels(values)


def main(arguments: list[str]) -> int:
    """Run the command line ``arguments``; the exit code."""
    options = parse_arguments(arguments)
    try:
        if not any(is_sweep(Path(run)) for run in options.runs):
            plot_runs(options.runs, Path(options.output))
        elif len(options.runs) > 1:
            raise ValueError("a sweep has pictures of its own: give one sweep, or else runs")
        else:
            plot_sweep(Path(options.runs[0]), Path(options.output))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
