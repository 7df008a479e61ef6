"""What fixed rules achieve in LeftTurn: a driver that goes at once, or waits for a gap in the oncoming traffic.

    python scripts/left_turn_rules.py --output docs/results
    python scripts/left_turn_rules.py runs/left_turn/* --output docs/results
    python scripts/left_turn_rules.py --gaps 0 3 5 --episodes 100 --gif docs/images/left_turn.gif

The folder gets left_turn_rules.csv and left_turn_rules.png. The rules see what an agent observes
(`algorithms.driving.left_turn_rules`); their parameters were chosen on the validation split. Learnt policies are
scored on the same episodes, and compared with the rule of the highest `left_turn_linear` episode by episode.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from rich.console import Console

from algorithms.experiments.cli import add_trust_argument, check_file, make_parser
from algorithms.experiments.run_directory import Run
from algorithms.planning.rules_report import (
    compare_with_best_rule,
    film_rules,
    plot_scores,
    rows,
    score_rules,
    score_runs,
    write_scores,
)
from algorithms.reporting.wide_tables import print_rows
from mo_deepdrive.config import ActionType, Traffic
from mo_deepdrive.evaluation.splits import SPLITS, describe_episodes

if TYPE_CHECKING:
    import argparse


def parse_arguments(arguments: list[str] | None) -> argparse.Namespace:
    """The options of this script."""
    parser = make_parser(__doc__)
    parser.add_argument("runs", nargs="*", metavar="RUN", help="learnt policies: run directories or names in the zoo")
    gaps = [float(gap) for gap in range(9)]
    parser.add_argument("--gaps", type=float, nargs="+", default=gaps, metavar="S", help="gaps in s (default: 0 to 8)")
    parser.add_argument("--episodes", type=int, default=2000, metavar="N", help="per driver (default: %(default)s)")
    parser.add_argument("--split", choices=SPLITS, default="test", help="scenario seeds (default: %(default)s)")
    parser.add_argument("--traffic", choices=get_args(Traffic), default="default", help="flow (default: %(default)s)")
    parser.add_argument(
        "--actions", choices=get_args(ActionType), default="discrete", help="action type (default: %(default)s)"
    )
    parser.add_argument("--output", type=Path, metavar="DIR", help="folder of the table and the picture")
    parser.add_argument("--gif", type=Path, metavar="FILE", help="film the rules on one scenario, side by side")
    parser.add_argument(
        "--gif-seed", type=int, default=2_000_029, metavar="S", help="of that scenario (default: %(default)s)"
    )
    add_trust_argument(parser)
    options = parser.parse_args(arguments)
    if options.output is not None and not options.output.is_dir():
        parser.error(f"--output {options.output} is not a folder")
    return options


def main(arguments: list[str] | None = None) -> int:
    """Run the command line ``arguments``, those of the process if None, and return the exit code."""
    options = parse_arguments(arguments)
    try:
        if options.gif is not None:
            check_file("--gif", options.gif)
        runs = [Run.open(path, device="cpu", trust=options.trust) for path in options.runs]
        scores = score_rules(
            options.gaps,
            episodes=options.episodes,
            split=options.split,
            traffic=options.traffic,
            actions=options.actions,
        )
        learnt = score_runs(runs, episodes=options.episodes, split=options.split, traffic=options.traffic)
        scores = compare_with_best_rule([*scores, *learnt])
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    episodes = describe_episodes(options.episodes, SPLITS[options.split].start)
    note = f"{episodes}, {options.traffic} traffic, {options.actions} actions"
    if options.output is not None:
        write_scores(options.output / "left_turn_rules.csv", scores)
        plot_scores(options.output / "left_turn_rules.png", scores, note)
    if options.gif is not None:
        film_rules(options.gif, options.gaps, options.gif_seed, traffic=options.traffic, actions=options.actions)
    print_rows(Console(), rows(scores), f"LeftTurn: {note}", 1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
