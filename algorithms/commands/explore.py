"""Write a page on which a person chooses a policy of a front by preferences and watches its drive.

    mo-deepdrive explore RUN --output explore.html
    mo-deepdrive explore RUN RUN best-known/one_waypoint_discrete --output explore.html

RUN is a finished run of an algorithm that learns a front, or the name of one in the zoo; or a best-known front, as
best-known/SCENARIO_ACTIONS. All policies of a run are evaluated again, on the episodes of mo-deepdrive choose, which
chooses the same policy for the same preference. The page is one file that needs no network. Of several runs, one that
cannot be read is left out with a line on standard error.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from algorithms.runs import cli
from algorithms.runs.run_directory import Run

if TYPE_CHECKING:
    from algorithms.reporting.page.data import ExplorableFront

UNSET = (cli.CHOICE_EPISODES, cli.CHOICE_SPLIT, None, False)  # episodes, split, seed and trust without options


def explore(options: cli.Options) -> int:
    """Write the page."""
    from algorithms.reporting.page.data import BEST_KNOWN
    from algorithms.reporting.page.page import write_page
    from algorithms.reporting.run_records import LEFT_OUT
    from algorithms.runs.interrupts import never_fatal

    with never_fatal("the page could not be written"):
        cli.check_file("--output", options.output, ".html")
        of_runs = options.episodes, options.split, options.seed, options.trust
        if all(name.startswith(BEST_KNOWN) for name in options.runs) and of_runs != UNSET:
            raise ValueError("--episodes, --split, --seed and --trust have no effect on best-known fronts")
        fronts: dict[str, ExplorableFront] = {}
        for name in options.runs:
            try:
                fronts[name] = _explorable(name, options)
            except ValueError as error:
                if len(options.runs) == 1 or not Path(name).is_dir():
                    raise
                cli.warn(f"{LEFT_OUT}{error}")
        if not fronts:
            raise ValueError("none of the runs has a front that can be read")
        write_page([*fronts.values()], options.output, f"Explorer of fronts: {', '.join(fronts)}")
    print(f"written: {options.output}")
    return 0


def _explorable(name: str, options: cli.Options) -> ExplorableFront:
    """The front of a run, with new episodes, or a best-known one."""
    from algorithms.reporting.page.data import BEST_KNOWN, explorable_best_known
    from algorithms.runs.build import load_policy
    from algorithms.runs.report import explorable

    if name.startswith(BEST_KNOWN):
        return explorable_best_known(name.removeprefix(BEST_KNOWN))
    run = Run.open(name, trust=options.trust)
    cli.check_front(run, name)
    episodes, _ = cli.evaluation_arguments(options, run.experiment)
    split = options.split or cli.CHOICE_SPLIT
    return explorable(run, load_policy(run), name, episodes=episodes, split=split, seed=options.seed)


OPTIONS = (
    cli.option("runs", "RUN", "directory of a finished run, a name in the zoo, or a best-known front", nargs="+"),
    cli.option("--output", "FILE", "the HTML file", required=True),
    *cli.evaluation_options(cli.CHOICE_EPISODES, cli.CHOICE_SPLIT),
    cli.TRUST,
)
main = cli.Command("explore", __doc__, OPTIONS, explore, errors_of_input=(ValueError,))
