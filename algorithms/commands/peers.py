"""Train another library's algorithm from a YAML file, into a run like those of train.

    mo-deepdrive peers --list
    mo-deepdrive peers --config peers/pcn --seed 3
    mo-deepdrive peers --config FILE --algorithm.name=morl_baselines.lcn --training.total_timesteps=1e5

Every key of the YAML file is an option, --section.key=value; mo-deepdrive keys lists them. Peers write no
checkpoints: a run that is interrupted cannot be resumed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from algorithms.runs.cli import (
    INSTALLED,
    add_training_arguments,
    exit_on_error,
    make_parser,
    new_runs,
    parse_training_arguments,
    refuse_beside,
)
from algorithms.runs.config import check_effects, check_loggers, load_experiment
from mo_deepdrive.support.names import nearest

if TYPE_CHECKING:
    from argparse import Namespace

    from algorithms.runs.config import Experiment


# Keys of an experiment by which this package's own training goes.
UNUSED = (
    *("training.seeds", "training.compiled", "training.share_policy", "evaluation.interval", "evaluation.episodes"),
    *("logging.interval", "logging.checkpoint_interval"),
)


def parse_arguments(arguments: list[str], program: str) -> tuple[Namespace, list[str]]:
    """The options, and the overrides of the experiment."""
    parser = make_parser(__doc__, program, "peers")
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--config", metavar="FILE", help="YAML file of the experiment, or the name of a shipped one")
    source.add_argument("--list", action="store_true", help="list the peers, their requirements and whether they run")
    add_training_arguments(parser)
    options, overrides = parse_training_arguments(parser, arguments)
    if options.list:
        refuse_beside(parser, options, "--list", "output")
        if overrides:
            parser.error(f"{overrides[0]} has no effect beside --list")
    return options, overrides


def load_peer_experiment(path: str, overrides: list[str]) -> Experiment:
    """The experiment of a YAML file, with everything checked that can be checked without training.

    Raises:
        ValueError: if it is not valid, or its algorithm is not another library's.
    """
    from algorithms.peers import PEERS
    from algorithms.peers.running import prepare

    experiment = load_experiment(path, overrides)
    name = experiment.algorithm.name
    if name not in PEERS:
        raise ValueError(
            f"algorithm.name = {name!r} is not another library's; use mo-deepdrive train, or {nearest(name, PEERS)}"
        )
    check_effects(experiment, UNUSED, f"algorithm {name!r} is trained by another library")
    prepare(experiment, lambda _step, _metrics: None)
    return experiment


def main(arguments: list[str], program: str = INSTALLED) -> int:
    """Run the command line ``arguments``; returns the exit code."""
    options, overrides = parse_arguments(arguments, program)

    from algorithms.peers.listing import peers_table
    from algorithms.peers.running import run_peer
    from algorithms.runs.console import make_console

    console = make_console()
    if options.list:
        console.print(peers_table())
        return 0
    with exit_on_error(ValueError, program=program):
        experiment = load_peer_experiment(options.config, overrides)
        check_loggers(experiment)
        (run,) = new_runs(options, [experiment])
    print(f"run {run.path}", flush=True)
    with exit_on_error(hint="runs of other libraries' algorithms cannot be resumed"):
        try:
            run_peer(run, console)
        except BaseException as error:
            failed = not isinstance(error, KeyboardInterrupt)
            run.set_status("failed" if failed else "interrupted", 0, str(error) if failed else None)
            raise
    print(f"finished: {run.path}")
    return 0
