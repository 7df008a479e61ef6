"""How many random StaticObstacle scenarios can be solved at all: an upper bound for the success of every policy.

    python scripts/ceiling.py --scenarios 200 --seed 3000000 --output ceiling.csv

Scenario i is the one that ``reset(seed=seed + i)`` draws. It is searched best first in the simulation itself
(`algorithms.planning.solvability`); solutions are replayed in the public environment.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from result_file import check_folder, check_least
from rich.console import Console
from rich.progress import track
from rich.table import Table

from algorithms.experiments.cli import make_parser
from algorithms.planning.best_first_search import LETTERS
from algorithms.planning.solvability import ScenarioOutcome, describe_geometry, solve_scenarios, write_outcomes
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.evaluation.statistics import rate

if TYPE_CHECKING:
    import argparse


def parse_arguments(arguments: list[str] | None) -> argparse.Namespace:
    """The options of this script."""
    parser = make_parser("The share of StaticObstacle scenarios that can be solved at all.")
    parser.add_argument("--scenarios", type=int, default=200, help="number of scenarios (default: %(default)s)")
    parser.add_argument(
        "--seed", type=int, default=SPLITS["test"].start, help="scenario i has seed + i (default: %(default)s)"
    )
    parser.add_argument("--output", type=Path, help="CSV: scenario, solved, decisions, actions (letters, a for 0)")
    parser.add_argument("--beam", type=int, default=4096, help="states simulated at a time (default: %(default)s)")
    options = parser.parse_args(arguments)
    for name, least in (("scenarios", 1), ("seed", 0), ("beam", len(LETTERS))):
        check_least(parser, options, least, name)
    check_folder(parser, options.output)
    return options


def print_tables(outcomes: list[ScenarioOutcome], console: Console) -> None:
    """Print the share of solved scenarios, and those that were not solved."""
    lengths = [len(outcome.actions) for outcome in outcomes if outcome.solved]
    share = rate(np.array([outcome.solved for outcome in outcomes]))
    table = Table("quantity", "value", title="StaticObstacle: what can be solved")
    table.add_row("scenarios", str(len(outcomes)))
    table.add_row("solved", f"{len(lengths)} ({share.value:.2%})")
    table.add_row("95% interval (Wilson)", f"{share.low:.2%} to {share.high:.2%}")
    table.add_row("mean decisions of the solutions found", f"{np.mean(lengths):.1f}" if lengths else "-")
    console.print(table)
    columns = ("scenario", "gap (m)", "bicycle from", "to", "destination", "nodes kept", "exhausted")
    table = Table(*columns, title="Not solved: m ahead of the nose, m to its left")
    for i, outcome in enumerate(outcomes):
        if not outcome.solved:
            exhausted = "yes" if outcome.exhausted else "no"
            table.add_row(str(i), *describe_geometry(outcome.start), str(outcome.nodes), exhausted)
    if table.row_count:
        console.print(table)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line ``arguments``; those of the process if None."""
    options = parse_arguments(arguments)
    seeds = range(options.seed, options.seed + options.scenarios)
    progress = track(seeds, "searching", console=Console(stderr=True), transient=True)
    outcomes = solve_scenarios(progress, options.beam)
    if options.output is not None:
        write_outcomes(options.output, outcomes)
    print_tables(outcomes, Console(width=120))


if __name__ == "__main__":
    main()
