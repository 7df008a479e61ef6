"""Reproduce the paper's figures and claims: train the missing runs, judge the claims, draw the figures.

    mo-deepdrive reproduce --all                 # everything; in a checkout into docs/results and the zoo
    mo-deepdrive reproduce --figure 4            # figure 4
    mo-deepdrive reproduce --claim 2 --seeds 3   # claim 2, with three seeds
    mo-deepdrive reproduce --quick               # everything in minutes: fewer seeds, shorter training
    mo-deepdrive reproduce --redraw              # judge and draw existing results, without training

Run the same command again to resume: finished runs are skipped, interrupted ones continue from their checkpoints.
"""

from __future__ import annotations

from pathlib import Path

from algorithms.runs.cli import Command, Options, check_at_least, check_directory, flag, one_of, option
from algorithms.studies import CLAIM_NUMBERS, FIGURES

OPTIONS = (
    one_of(
        flag("--all", "everything (the default)"),
        option("--figure", "N", "a figure of the paper: 4 to 10", type=int, choices=FIGURES),
        option("--claim", "N", "a claim of the paper: 1 to 6", type=int, choices=CLAIM_NUMBERS),
    ),
    option("--seeds", "N", "number of runs of each variant (default: the plan's)", type=int),
    flag("--quick", "use fewer seeds and shorter training"),
    flag("--redraw", "judge and draw the results in --output, without training"),
    option("--runs", "DIR", "run directories (default: runs/reproduce[-quick])", type=Path),
    option("--output", "DIR", "output folder (default: RUNS/results; in a checkout docs/results for --all)", type=Path),
    option("--workers", "N", "maximum number of concurrent runs (default: limited by the cores)", type=int),
    option("--plan", "FILE", "the study to train (default: %(default)s)", default="studies/paper"),
)


def run(options: Options) -> int:
    """Run the reproduction that the options ask for."""
    from algorithms.runs.console import make_console
    from algorithms.studies.paper import load_paper
    from algorithms.studies.paper_report import reproduce

    check_at_least(options, 1, "seeds", "workers")
    for name in ("runs", "output"):
        check_directory(f"--{name}", getattr(options, name))
    if options.redraw and (options.quick or options.seeds is not None or options.workers is not None):
        raise ValueError("--redraw does not train; it cannot be combined with --quick, --seeds or --workers")
    return reproduce(load_paper(options.plan), options, make_console())


main = Command("reproduce", __doc__, OPTIONS, run)
