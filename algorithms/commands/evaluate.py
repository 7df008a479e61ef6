"""Evaluate the policy of a run: utilities, vector returns, rates and comfort, with 95% intervals; or its front.

    mo-deepdrive evaluate runs/mo_a2c_linear/mo_a2c-seed3-20260101-120000 --episodes 1000 --video drive.mp4

The name of a policy of the zoo, which is trained already, may be given instead of a run; mo-deepdrive zoo lists them.
"""

from __future__ import annotations

from pathlib import Path

from algorithms.runs import cli
from algorithms.runs.run_directory import Run


def evaluate(options: cli.Options) -> int:
    """Evaluate a run, print the numbers, and write files and a video if asked to."""
    from algorithms.runs.build import load_policy
    from algorithms.runs.console import make_console
    from algorithms.runs.report import report_agent

    run = Run.open(options.run, trust=options.trust)
    episodes, seed = cli.evaluation_arguments(options, run.experiment)
    cli.check_directory("--output", options.output)
    if options.stochastic and options.video is None:
        raise ValueError("--stochastic has no effect beside no --video")
    if options.stochastic and not run.experiment.known_utility:
        raise ValueError("--stochastic has no effect: of a front the greedy policies are filmed")
    final = run.experiment.evaluation.final_seed
    replaces = bool(options.output) and Path(options.output).resolve() == run.path.resolve()
    if replaces and seed != final:
        raise ValueError(
            f"--output {options.output} would replace the final evaluation, which tables and searches read, by one of "
            f"other scenarios (from seed {seed:,} instead of {final:,}); choose another directory"
        )
    agent = load_policy(run)
    filmed = report_agent(
        agent,
        run.experiment,
        make_console(),
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
    return 0 if filmed else cli.FAILED


OPTIONS = (
    cli.RUN,
    *cli.evaluation_options(),
    cli.option("--video", "FILE", "also write an MP4 of the first episodes (of a front, four policies)"),
    cli.flag("--stochastic", "film the stochastic policy, not the greedy one"),
    cli.option("--output", "DIR", "also write the files that a training run ends with"),
    cli.TRUST,
)
main = cli.Command("evaluate", __doc__, OPTIONS, evaluate)
