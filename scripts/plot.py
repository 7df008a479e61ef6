"""Draw learning curves: runs that differ in their seed alone become one curve with a 95% interval.

    python scripts/plot.py runs/mo_a2c_linear/* runs/a2c_linear/* --output comparison.png
    python scripts/plot.py SWEEP --output FILE.png

Of a sweep (a directory with a manifest, made by scripts/sweep.py) the best cells are drawn, ranked by the utility or
the hypervolume of their final evaluations; these scores of all runs are drawn against each key that varies into
FILE-cells.png. The collected scores and metrics of the runs are kept for other programs in SWEEP/collected/ as Parquet
files, which are updated here; algorithms/sweeps/collection.py describes them.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from algorithms.experiments.cli import warn_of_changes
from algorithms.reporting.learning_curves import describe, load_groups, plot
from algorithms.sweeps.manifest import is_sweep
from algorithms.sweeps.plots import plot_sweep


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """The options of this script."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="run directories, or one sweep")
    parser.add_argument(
        "--output", default="curves.png", type=Path, metavar="FILE", help="the image file (default: curves.png)"
    )
    return parser.parse_args(arguments)


def warn(message: str) -> None:
    """Print a message to standard error."""
    print(message, file=sys.stderr)


def main(arguments: list[str]) -> int:
    """Run the command line ``arguments``; the exit code."""
    options = parse_arguments(arguments)
    try:
        if not any(is_sweep(run) for run in options.runs):
            groups = load_groups(options.runs)
            for run in options.runs:
                warn_of_changes(run, ("config.yaml", "metrics.csv"))
            plot(groups, options.output)
            print(*describe(groups), options.output, sep="\n")
        elif len(options.runs) > 1:
            raise ValueError("a sweep has its own figures: give one sweep, or else runs")
        else:
            plot_sweep(options.runs[0], options.output, print, warn)
    except (ValueError, OSError) as error:
        warn(f"error: {error}")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
