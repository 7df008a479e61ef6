"""Final scores over seeds, of runs or of a sweep.

    mo-deepdrive table RUN... [--output FILE] [--columns METRIC...]
    mo-deepdrive table SWEEP [--sort METRIC] [--top N] [--output FILE]

Runs (or folders that hold runs) that differ in their seed alone are in one row: the mean over seeds of the final
evaluation with a 95% bootstrap interval, and the interquartile mean of the utility. With several vehicles there is a
row for each and one for all together (success: all arrived). Fronts have their indicators instead. Rows that differ in
the algorithm alone are compared: the difference of the mean utilities (hypervolumes) with its interval, and the p-value
of a two-sided Mann-Whitney test. Where two configurations are alone, rows have the differences of all columns, second
minus first. Columns that do not fit the terminal follow in further tables.

A sweep (a directory with a manifest, made by mo-deepdrive sweep) has its cells, or the trials of a search, the best
first; cells with another environment or utility are in separate tables. The terminal shows the best cells and as many
columns as fit, and names the others; files have everything. With several vehicles the row of all together has the sum
of their utilities. Cells that differ in the algorithm alone are compared; where their numbers of steps differ, too, the
row has both. SWEEP/collected/ keeps the scores and metrics of the runs for other programs (docs/scale.md).

The ending of FILE is the format: .csv (a row per metric with the columns mean, low, high and n, the number of seeds;
also of the returns of every objective), .tex (booktabs) or .md, which have names as people write them. Comparisons are
in FILE-differences. A run whose files cannot be read is left out with a line on standard error; if nothing can be
shown, the exit code is 2.
"""

from __future__ import annotations

from pathlib import Path

from algorithms.runs import cli
from algorithms.runs.run_directory import changed_files, diverged, read_status

TOP = 20


def intact_runs(paths: list[Path]) -> list[Path]:
    """The runs among and below ``paths``; with a warning instead of those that have changed or are not finished."""
    from algorithms.reporting.run_records import LEFT_OUT, find_runs
    from mo_deepdrive.evaluation.front import EVALUATION_FILE

    runs = []
    for run in find_runs(paths, cli.warn):
        problems = changed_files(run, ["config.yaml", EVALUATION_FILE]) or diverged(run)
        if not problems and read_status(run).get("state", "finished") != "finished":
            problems = ["its training is not finished"]
        if problems:
            cli.warn(f"{LEFT_OUT}{run}: {'; '.join(problems)}")
        else:
            runs.append(run)
    return runs


def print_tables(options: cli.Options) -> int:
    """Print the tables of runs or of a sweep, and write them."""
    from algorithms.reporting.tables import FORMATS, print_runs, write_tables
    from algorithms.runs.console import make_console
    from algorithms.studies.manifest import is_sweep
    from algorithms.studies.sweep_tables import print_sweep

    cli.check_file("--output", options.output, *FORMATS)
    console, columns = make_console(), options.columns
    if not any(is_sweep(path) for path in options.runs):
        if options.sort is not None or options.top is not None:
            raise ValueError("--sort and --top are for a sweep, a directory with a manifest.jsonl")
        scores = compared = print_runs(intact_runs(options.runs), console, cli.warn, columns)
    elif len(options.runs) > 1:
        raise ValueError("a sweep has its own table: give one sweep, or else runs")
    elif options.top is not None and options.top < 1:
        raise ValueError(f"--top {options.top} must be at least 1")
    else:
        scores, compared = print_sweep(
            options.runs[0], console, cli.warn, metric=options.sort, top=options.top or TOP, columns=columns
        )
    if options.output is not None:
        written = write_tables(options.output, scores, compared, columns)
        print(f"written: {', '.join(map(str, written))}")
    return 0


COLUMNS = "such as utility_esr success return/g_force suite/score (default: those of every table; all in a .csv)"
SORT = "of a sweep: metric to sort by, such as greedy/success (default: the utility, or the hypervolume)"
OPTIONS = (
    cli.RUNS,
    cli.option("--output", "FILE", "also write them as .csv, .tex or .md", type=Path),
    cli.many("--columns", "METRIC", COLUMNS),
    cli.option("--sort", "METRIC", SORT),
    cli.option("--top", "N", f"of a sweep: rows on the terminal (default: {TOP})", type=int),
)
main = cli.Command("table", __doc__, OPTIONS, print_tables)
