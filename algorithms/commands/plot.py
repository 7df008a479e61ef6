"""Draw learning curves: runs that differ in their seed alone become one curve with a 95% interval.

    mo-deepdrive plot runs/mo_a2c_linear runs/a2c_linear --output comparison.png
    mo-deepdrive plot SWEEP --output FILE.png

A folder stands for the runs in it. Of a sweep (a directory with a manifest, made by mo-deepdrive sweep) the best cells
are drawn, ranked by the utility or the hypervolume of their final evaluations; these scores of all runs are drawn
against each key that varies into FILE-cells.png. SWEEP/collected/ keeps the scores and metrics of the runs for other
programs (docs/scale.md).

A run whose files cannot be read is left out with a line on standard error; if nothing can be drawn, the exit code is 2.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from algorithms.runs import cli


def draw(options: cli.Options) -> int:
    """Draw the curves, and say what each of them is."""
    from algorithms.runs.console import make_console, print_line
    from algorithms.runs.interrupts import never_fatal

    say = partial(print_line, make_console())
    with never_fatal("the curves could not be drawn"):
        from algorithms.reporting.curves import FORMATS, describe, load_groups, plot
        from algorithms.reporting.run_records import find_runs
        from algorithms.studies.manifest import is_sweep
        from algorithms.studies.sweep_tables import plot_sweep

        cli.check_file("--output", options.output, *FORMATS)
        if not any(is_sweep(run) for run in options.runs):
            groups = load_groups(find_runs(options.runs, cli.warn), cli.warn)
            plot(groups, options.output)
            for line in (*describe(groups), str(options.output)):
                say(line)
        elif len(options.runs) > 1:
            raise ValueError("a sweep has its own figures: give one sweep, or else runs")
        else:
            plot_sweep(options.runs[0], options.output, say, cli.warn)
    return 0


OUTPUT = cli.option("--output", "FILE", "the image file (default: curves.png)", default="curves.png", type=Path)
main = cli.Command("plot", __doc__, (cli.RUNS, OUTPUT), draw, errors_of_input=(ValueError,))
