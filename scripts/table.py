"""Final scores over seeds, of runs or of a sweep.

    python scripts/table.py RUN... [--output FILE.csv]
    python scripts/table.py SWEEP [--sort METRIC] [--top N] [--output FILE.csv]

Runs (or folders that hold runs) that differ in their seed alone are in one row: the mean over seeds of the final
evaluation with a 95% bootstrap interval, and the interquartile mean of the utility. With several vehicles there is a
row for each and one for all together (success: all arrived). Fronts have their indicators instead. Rows that differ in
the algorithm alone are compared: the difference of the mean utilities (hypervolumes) with its interval, and the p-value
of a two-sided Mann-Whitney test.

A sweep (a directory with a manifest, made by scripts/sweep.py) has a row per cell, or per trial of a search, the best
first; cells with another environment or utility are in separate tables. The terminal shows the best cells, the policy
by which they are sorted, and as many columns as fit; the CSV has everything. With several vehicles the row of all
together has the sum of their utilities. Cells that differ in the algorithm alone are compared by the same policy. The
collected scores and metrics of the runs are kept for other programs in SWEEP/collected/ as Parquet files, which are
updated here; algorithms/sweeps/collection.py describes them.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from algorithms.common.atomic_io import atomic_write, csv_bytes
from algorithms.evaluation.front import EVALUATION_FILE
from algorithms.experiments.progress_bar import make_console
from algorithms.experiments.run_files import changed_files
from algorithms.reporting.seed_tables import Rows, find_runs, print_runs
from algorithms.sweeps.manifest import is_sweep
from algorithms.sweeps.tables import print_sweep

TOP = 20


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """The options of this script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "runs", nargs="+", type=Path, metavar="RUN", help="run directories, or folders that hold some; or one sweep"
    )
    parser.add_argument("--output", type=Path, metavar="FILE", help="also write both tables as CSV")
    parser.add_argument(
        "--sort",
        metavar="METRIC",
        help="of a sweep: metric to sort by, such as greedy/success (default: the utility, or the hypervolume)",
    )
    parser.add_argument("--top", type=int, metavar="N", help=f"of a sweep: rows on the terminal (default: {TOP})")
    return parser.parse_args(arguments)


def warn(message: str) -> None:
    """Print a message to standard error."""
    print(message, file=sys.stderr)


def intact_runs(paths: list[Path]) -> list[Path]:
    """The runs among and below ``paths``, with a warning instead of those whose config or final evaluation has changed.

    Raises:
        ValueError: as :func:`algorithms.reporting.seed_tables.find_runs`.
    """
    runs = []
    for run in find_runs(paths):
        problems = changed_files(run, ["config.yaml", EVALUATION_FILE])
        if problems:
            warn(f"left out: {run}: {'; '.join(problems)}")
        else:
            runs.append(run)
    return runs


def print_tables(options: argparse.Namespace) -> list[Rows]:
    """Print the tables that the options ask for; returns whole tables, for a sweep only if they are to be written.

    Raises:
        ValueError: for options that do not fit together, or if there is nothing to show.
    """
    console = make_console()
    if not any(is_sweep(path) for path in options.runs):
        if options.sort is not None or options.top is not None:
            raise ValueError("--sort and --top are for a sweep, a directory with a manifest.jsonl")
        return print_runs(intact_runs(options.runs), console, warn)
    if len(options.runs) > 1:
        raise ValueError("a sweep has its own table: give one sweep, or else runs")
    if options.top is not None and options.top < 1:
        raise ValueError(f"--top {options.top} must be at least 1")
    whole = options.output is not None
    return print_sweep(options.runs[0], console, warn, metric=options.sort, top=options.top or TOP, whole=whole)


def main(arguments: list[str]) -> int:
    """Run the command line ``arguments``; the exit code."""
    options = parse_arguments(arguments)
    try:
        tables = print_tables(options)
        if options.output is not None:
            atomic_write(options.output, csv_bytes([*tables[0], [], *tables[1]]))
    except (ValueError, OSError) as error:
        warn(f"error: {error}")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
