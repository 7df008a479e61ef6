"""Train another library's algorithm from a YAML file, into a run like those of train.

    mo-deepdrive peers --list
    mo-deepdrive peers --config peers/pcn --seed 3
    mo-deepdrive peers --config FILE --algorithm.name=morl_baselines.lcn --training.total_timesteps=1e5

Every key of the YAML file is an option, --section.key=value; mo-deepdrive keys lists them. --seed is short for
--training.seed. Peers write no checkpoints: a run that is interrupted cannot be resumed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from algorithms.runs import cli
from algorithms.runs.config import check_effects, check_loggers, load_experiment
from mo_deepdrive.support.names import nearest

if TYPE_CHECKING:
    from rich.table import Table

    from algorithms.runs.config import Experiment


# Keys of an experiment by which this package's own training goes.
UNUSED = (
    *("training.seeds", "training.compiled", "training.share_policy", "evaluation.interval", "evaluation.episodes"),
    *("logging.interval", "logging.checkpoint_interval"),
)


def load_peer_experiment(path: str, overrides: list[str]) -> Experiment:
    """The experiment of a YAML file, with everything checked that can be checked without training."""
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
    check_loggers(experiment)
    return experiment


def peers_table() -> Table:
    """What each peer learns, the actions and numbers of objectives it takes, whether it can run here, or why not."""
    from algorithms.peers import PEERS
    from algorithms.reporting.tables import make_table

    rows = [["name", "learns", "actions", "objectives", "runs here"]]
    reasons = {name: peer.unavailable_reason() for name, peer in PEERS.items()}
    for name, peer in PEERS.items():
        learns = "a known utility" if peer.known_utility else "a front"
        objectives = "any" if peer.objectives is None else "{} to {}".format(*peer.objectives)
        runs_here = "yes" if reasons[name] is None else "no"
        rows.append([name, learns, ", ".join(peer.actions), objectives, runs_here])
    lines = [f"no: {reason}" for reason in dict.fromkeys(reasons.values()) if reason is not None]
    return make_table(rows, 5, unbroken=(0,), caption="\n".join(lines))


def train_peer(options: cli.Options) -> int:
    """Train and evaluate a peer, or list those that there are."""
    from algorithms.peers.running import run_peer
    from algorithms.runs.console import make_console

    console = make_console()
    with cli.exit_on_error(ValueError, OSError):
        if options.list:
            if given := [*(["--output"] if options.output else []), *options.overrides]:
                raise ValueError(f"{given[0]} has no effect beside --list")
            console.print(peers_table())
            return 0
        experiment = load_peer_experiment(options.config, options.overrides)
        (run,) = cli.new_runs(options, [experiment])
    print(f"run {run.path}", flush=True)
    with cli.exit_on_error(hint="runs of other libraries' algorithms cannot be resumed"):
        try:
            run_peer(run, console)
        except BaseException as error:
            failed = not isinstance(error, KeyboardInterrupt)
            run.set_status("failed" if failed else "interrupted", 0, str(error) if failed else None)
            raise
    print(f"finished: {run.path}")
    return 0


LIST = cli.flag("--list", "list the peers, their requirements and whether they run")
main = cli.Command(
    "peers",
    __doc__,
    (cli.one_of(cli.CONFIG, LIST, required=True), cli.RUN_OUTPUT),
    train_peer,
    takes_keys=True,
    errors_of_input=(),  # in training they are errors of the program
)
