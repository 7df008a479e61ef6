"""Write a page on which a person chooses a policy of a front by preferences and watches its drive.

    mo-deepdrive explore RUN --output explore.html
    mo-deepdrive explore RUN RUN best-known/one_waypoint_discrete --output explore.html

RUN is a finished run of an algorithm that learns a front, or the name of one in the zoo; or a best-known front, as
best-known/SCENARIO_ACTIONS. All policies of a run are evaluated again, on the episodes of mo-deepdrive choose, which
chooses the same policy for the same preference. The page is one file that needs no network. Of several runs, one that
cannot be read is left out with a line on standard error.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from algorithms.runs.cli import (
    CHOICE_EPISODES,
    CHOICE_SPLIT,
    INSTALLED,
    add_evaluation_arguments,
    add_trust_argument,
    as_called,
    check_file,
    evaluation_arguments,
    exit_on_error,
    make_parser,
    warn_of_changes,
)
from algorithms.runs.run_directory import Run

if TYPE_CHECKING:
    from argparse import Namespace

    from algorithms.reporting.explorer.data import ExplorableFront

UNSET = (CHOICE_EPISODES, CHOICE_SPLIT, None, False)  # episodes, split, seed and trust without options


def parse_arguments(arguments: list[str], program: str) -> Namespace:
    """The options."""
    parser = make_parser(__doc__, program, "explore")
    parser.add_argument(
        "runs", nargs="+", metavar="RUN", help="directory of a finished run, a name in the zoo, or a best-known front"
    )
    parser.add_argument("--output", required=True, metavar="FILE", help="the HTML file")
    add_evaluation_arguments(parser, default_episodes=CHOICE_EPISODES, default_split=CHOICE_SPLIT)
    add_trust_argument(parser)
    return parser.parse_args(arguments)


def main(arguments: list[str], program: str = INSTALLED) -> int:
    """Run the command line ``arguments``; returns the exit code."""
    options = parse_arguments(arguments, program)

    from algorithms.reporting.explorer.data import BEST_KNOWN, explorable_best_known
    from algorithms.reporting.explorer.page import write_page
    from algorithms.reporting.run_records import LEFT_OUT
    from algorithms.runs.accessories import sole_purpose

    with exit_on_error(ValueError, program=program), sole_purpose("the page could not be written"):
        check_file("--output", options.output, ".html")
        of_runs = options.episodes, options.split, options.seed, options.trust
        if all(name.startswith(BEST_KNOWN) for name in options.runs) and of_runs != UNSET:
            raise ValueError("--episodes, --split, --seed and --trust have no effect on best-known fronts")
        fronts: dict[str, ExplorableFront] = {}
        for name in options.runs:
            try:
                fronts[name] = (
                    explorable_best_known(name.removeprefix(BEST_KNOWN))
                    if name.startswith(BEST_KNOWN)
                    else _explorable_run(name, options, program)
                )
            except ValueError as error:
                if len(options.runs) == 1 or not Path(name).is_dir():
                    raise
                print(as_called(f"{LEFT_OUT}{error}", program), file=sys.stderr)
        if not fronts:
            raise ValueError("none of the runs has a front that can be read")
        write_page([*fronts.values()], options.output, f"Explorer of fronts: {', '.join(fronts)}")
    print(f"written: {options.output}")
    return 0


def _explorable_run(name: str, options: Namespace, program: str) -> ExplorableFront:
    """The front of a run, with new episodes.

    Raises:
        ValueError: if it has no front, or its files do not fit this version.
    """
    from algorithms.runs.build import load_policy
    from algorithms.runs.front_explorer import explorable

    run = Run.open(name, trust=options.trust)
    if run.experiment.known_utility:
        raise ValueError(f"{name!r} learnt one policy, not a front: mo-deepdrive evaluate shows it")
    episodes, _ = evaluation_arguments(options, run.experiment)
    warn_of_changes(run.path, ("config.yaml", "checkpoint.safetensors", "front.csv", "evaluation.json"))
    split = options.split or CHOICE_SPLIT
    front = explorable(run, load_policy(run), name, episodes=episodes, split=split, seed=options.seed)
    return replace(front, command=as_called(front.command, program))
