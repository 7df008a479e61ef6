"""Evaluate the policy of a run: utilities, vector returns, rates and comfort, with 95% intervals; or its front.

    mo-deepdrive evaluate runs/mo_a2c_linear/mo_a2c-seed3-20260101-120000 --episodes 1000 --video drive.mp4
    mo-deepdrive evaluate --zoo

The name of a policy of the zoo, which is trained already, may be given instead of a run.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from algorithms.runs.cli import (
    INSTALLED,
    add_evaluation_arguments,
    add_trust_argument,
    check_directory,
    evaluation_arguments,
    exit_on_error,
    make_parser,
    refuse_beside,
    warn_of_changes,
)
from algorithms.runs.run_directory import Run

if TYPE_CHECKING:
    from argparse import Namespace


def parse_arguments(arguments: list[str], program: str) -> Namespace:
    """The options."""
    parser = make_parser(__doc__, program, "evaluate")
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("run", nargs="?", metavar="RUN", help="directory of a run, or a name in the zoo")
    source.add_argument("--zoo", action="store_true", help="list the policies of the zoo instead")
    add_evaluation_arguments(parser, video="also write an MP4 of the first episodes (of a front, four policies)")
    parser.add_argument("--stochastic", action="store_true", help="film the stochastic policy, not the greedy one")
    parser.add_argument("--output", metavar="DIR", help="also write the files that a training run ends with")
    add_trust_argument(parser)
    options = parser.parse_args(arguments)
    if options.zoo:
        refuse_beside(parser, options, "--zoo", "episodes", "split", "seed", "video", "stochastic", "output", "trust")
    elif options.video is None:
        refuse_beside(parser, options, "no --video", "stochastic")
    return options


def main(arguments: list[str], program: str = INSTALLED) -> int:
    """Run the command line ``arguments``; returns the exit code."""
    options = parse_arguments(arguments, program)

    from algorithms.runs.console import make_console

    console = make_console()
    with exit_on_error(ValueError, OSError, program=program):
        if options.zoo:
            from algorithms.zoo.listing import zoo_table

            table = zoo_table()
            console.print(table if table.row_count else "the zoo is empty")
            return 0
        from algorithms.runs.agent_report import report_agent
        from algorithms.runs.build import load_policy

        run = Run.open(options.run, trust=options.trust)
        episodes, seed = evaluation_arguments(options, run.experiment)
        check_directory("--output", options.output)
        if options.stochastic and not run.experiment.known_utility:
            raise ValueError("--stochastic has no effect: of a front the greedy policies are filmed")
        final = run.experiment.evaluation.final_seed
        replaces = bool(options.output) and Path(options.output).resolve() == run.path.resolve()
        if replaces and seed != final:
            raise ValueError(
                f"--output {options.output} would replace the final evaluation, which tables and searches read, by "
                f"one of other scenarios (from seed {seed:,} instead of {final:,}); choose another directory"
            )
        warn_of_changes(run.path, ("config.yaml", "checkpoint.safetensors"))
        agent = load_policy(run)
        filmed = report_agent(
            agent,
            run.experiment,
            console,
            episodes=episodes,
            seed=seed,
            title=f"{options.run} at step {agent.step:,}: ",
            directory=Path(options.output) if options.output else None,
            video=Path(options.video) if options.video else None,
            greedy=not options.stochastic,
        )
        if options.output:
            print(f"written: {options.output}")
            if replaces:
                run.record_results()
    return 0 if filmed else 1
