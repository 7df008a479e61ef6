"""Which objectives conflict in each scenario: rank correlations of the returns over the same random drivers.

    python scripts/conflicts.py --output docs/results

The folder gets conflicts.csv and conflicts.png. A negative correlation says that drivers who are better in one
objective are worse in the other (`algorithms.planning.conflicts` describes the drivers). In LeftTurn fixed rules are a
second population.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from result_file import check_least
from rich.console import Console

from algorithms.experiments.cli import make_parser
from algorithms.planning.conflicts import ARRIVALS, find_conflicts, find_rule_conflicts, plot_conflicts, write_conflicts
from algorithms.reporting.wide_tables import print_rows
from mo_deepdrive.evaluation.splits import SPLITS, describe_episodes
from mo_deepdrive.scenarios import SCENARIOS

if TYPE_CHECKING:
    import argparse


def parse_arguments(arguments: list[str] | None) -> argparse.Namespace:
    """The options of this script."""
    parser = make_parser(__doc__)
    parser.add_argument("--scenarios", nargs="+", choices=SCENARIOS, default=list(SCENARIOS), help="default: all")
    parser.add_argument("--drivers", type=int, default=1000, metavar="N", help="drawn (default: %(default)s)")
    parser.add_argument("--rules", type=int, default=200, metavar="N", help="fixed rules drawn (default: %(default)s)")
    parser.add_argument("--episodes", type=int, default=50, metavar="N", help="per driver (default: %(default)s)")
    parser.add_argument("--output", type=Path, metavar="DIR", help="folder of the table and the picture")
    options = parser.parse_args(arguments)
    check_least(parser, options, 1, "drivers", "rules", "episodes")
    if options.output is not None and not options.output.is_dir():
        parser.error(f"--output {options.output} is not a folder")
    return options


def main(arguments: list[str] | None = None) -> int:
    """Run the command line ``arguments``, those of the process if None, and return the exit code."""
    options = parse_arguments(arguments)
    seed = SPLITS["validation"].start
    conflicts = [
        find_conflicts(name, drivers=options.drivers, episodes=options.episodes, seed=seed)
        for name in options.scenarios
    ]
    if "left_turn" in options.scenarios:
        conflicts.append(find_rule_conflicts(rules=options.rules, episodes=options.episodes, seed=seed))
    note = (
        f"Spearman's rank correlation of the mean returns of {options.drivers} random drivers, of whom those count "
        f"that arrive in {ARRIVALS:.0%} of {describe_episodes(options.episodes, seed)}; all objectives maximised"
    )
    if options.output is not None:
        write_conflicts(options.output / "conflicts.csv", conflicts)
        plot_conflicts(options.output / "conflicts.png", conflicts, note)
    for each in conflicts:
        names = each.objectives
        rows = [["", *names[:-1]]]
        rows += [
            [second, *(each.correlations[first, second].text() for first in names[:k])] + [""] * (len(names) - 1 - k)
            for k, second in enumerate(names)
            if k
        ]
        print_rows(Console(), rows, f"{each.population}, {each.drivers} drivers: Spearman's rank correlation", 1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
