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
from typing import TYPE_CHECKING

from algorithms.runs.cli import check_directory, exit_on_error, make_parser
from algorithms.studies import CLAIM_NUMBERS, FIGURES

if TYPE_CHECKING:
    from argparse import Namespace


def parse_arguments(arguments: list[str]) -> Namespace:
    """The options."""
    parser = make_parser(__doc__, "reproduce")
    part = parser.add_mutually_exclusive_group()
    part.add_argument("--all", action="store_true", help="everything (the default)")
    part.add_argument("--figure", type=int, choices=FIGURES, metavar="N", help="a figure of the paper: 4 to 10")
    part.add_argument("--claim", type=int, choices=CLAIM_NUMBERS, metavar="N", help="a claim of the paper: 1 to 6")
    parser.add_argument("--seeds", type=int, metavar="N", help="number of runs of each variant (default: the plan's)")
    parser.add_argument("--quick", action="store_true", help="use fewer seeds and shorter training")
    parser.add_argument(
        "--redraw", action="store_true", help="judge and draw the results in --output, without training"
    )
    parser.add_argument("--runs", type=Path, metavar="DIR", help="run directories (default: runs/reproduce[-quick])")
    where = "output folder (default: RUNS/results; in a checkout docs/results for --all)"
    parser.add_argument("--output", type=Path, metavar="DIR", help=where)
    workers = "maximum number of concurrent runs (default: limited by the cores)"
    parser.add_argument("--workers", type=int, metavar="N", help=workers)
    plan = "the study to train (default: %(default)s)"
    parser.add_argument("--plan", default="studies/paper", metavar="FILE", help=plan)
    return parser.parse_args(arguments)


def check_options(options: Namespace) -> None:
    """Check the options before any work."""
    for name in ("seeds", "workers"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise ValueError(f"--{name} {value} must be at least 1")
    for name in ("runs", "output"):
        check_directory(f"--{name}", getattr(options, name))
    if options.redraw and (options.quick or options.seeds is not None or options.workers is not None):
        raise ValueError("--redraw does not train; it cannot be combined with --quick, --seeds or --workers")


def main(arguments: list[str]) -> int:
    """Run the command line ``arguments`` and return the exit code."""
    options = parse_arguments(arguments)

    from algorithms.runs.console import make_console
    from algorithms.studies.paper import Reproduction, load_paper

    with exit_on_error(ValueError, OSError):
        check_options(options)
        given = {name: value for name, value in vars(options).items() if name not in ("all", "plan")}
        return Reproduction(load_paper(options.plan), **given).run(make_console())
