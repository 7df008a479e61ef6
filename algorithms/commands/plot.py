"""Draw learning curves: runs that differ in their seed alone become one curve with a 95% interval.

    mo-deepdrive plot runs/mo_a2c_linear runs/a2c_linear --output comparison.png
    mo-deepdrive plot SWEEP --output FILE.png

A folder stands for the runs in it. Of a sweep (a directory with a manifest, made by mo-deepdrive sweep) the best cells
are drawn, ranked by the utility or the hypervolume of their final evaluations; these scores of all runs are drawn
against each key that varies into FILE-cells.png. The collected scores and metrics of the runs are kept for other
programs in SWEEP/collected/ as Parquet files, which are updated here; algorithms/studies/collection.py describes
them.

A run whose files cannot be read is left out with a line on standard error; if nothing can be drawn, the exit code is 2.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from algorithms.runs.cli import check_file, exit_on_error, make_parser, warn
from algorithms.studies.manifest import is_sweep

if TYPE_CHECKING:
    from argparse import Namespace


def parse_arguments(arguments: list[str]) -> Namespace:
    """The options."""
    parser = make_parser(__doc__, "plot")
    parser.add_argument(
        "runs", nargs="+", type=Path, metavar="RUN", help="run directories, or folders that hold some; or one sweep"
    )
    parser.add_argument(
        "--output", default="curves.png", type=Path, metavar="FILE", help="the image file (default: curves.png)"
    )
    return parser.parse_args(arguments)


def main(arguments: list[str]) -> int:
    """Run the command line ``arguments``; the exit code."""
    options = parse_arguments(arguments)

    from algorithms.runs.console import make_console, print_line
    from algorithms.runs.interrupts import sole_purpose

    say = partial(print_line, make_console())
    with exit_on_error(ValueError), sole_purpose("the curves could not be drawn"):
        from algorithms.reporting.curves import FORMATS, describe, load_groups, plot
        from algorithms.reporting.run_records import find_runs
        from algorithms.studies.sweep_plots import plot_sweep

        check_file("--output", options.output, *FORMATS)
        if not any(is_sweep(run) for run in options.runs):
            runs = find_runs(options.runs, warn)
            groups = load_groups(runs, warn)
            plot(groups, options.output)
            for line in (*describe(groups), str(options.output)):
                say(line)
        elif len(options.runs) > 1:
            raise ValueError("a sweep has its own figures: give one sweep, or else runs")
        else:
            plot_sweep(options.runs[0], options.output, say, warn)
    return 0
