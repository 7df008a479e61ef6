"""Train another library's algorithm from a YAML file, into a run like those of train.py.

    python scripts/peers.py --list
    python scripts/peers.py --config configs/peers/pcn.yaml --seed 3
    python scripts/peers.py --config FILE --algorithm.name=morl_baselines.lcn --training.total_timesteps=1e5

Every key of the YAML file is an option of its own: --section.key=value. Peers keep no checkpoints: a run that is
interrupted cannot go on.
"""

from __future__ import annotations

import argparse
import os
import random
import sys

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # videos are drawn in memory
os.environ.setdefault("SDL_AUDIODRIVER", "dummy")
sys.path.append(os.getcwd())  # where a user's own utility lives

import numpy as np
import torch
from rich.box import SIMPLE_HEAD
from rich.table import Table

from algorithms.experiments.config import Experiment, load_experiment
from algorithms.experiments.progress_bar import make_console
from algorithms.experiments.run_directory import Run, default_directory
from algorithms.peers import PEERS
from algorithms.peers.running import prepare, run_peer
from mo_deepdrive.config import nearest


def parse_arguments(arguments: list[str]) -> tuple[argparse.Namespace, list[str]]:
    """The options of this script, and the overrides of the experiment."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--config", metavar="FILE", help="the experiment")
    source.add_argument("--list", action="store_true", help="what there is, what it needs and whether it can run here")
    parser.add_argument("--seed", metavar="N", help="short for --training.seed")
    parser.add_argument("--device", metavar="D", help="short for --training.device")
    parser.add_argument("--output", metavar="DIR", help="the run's directory (default: runs/CONFIG/NAME)")
    options, overrides = parser.parse_known_args(arguments)
    overrides += [f"--{key}={value}" for key in ("seed", "device") if (value := getattr(options, key)) is not None]
    return options, overrides


def overview() -> Table:
    """One row per peer."""
    table = Table(box=SIMPLE_HEAD)
    table.add_column("name", no_wrap=True)
    for column in ("learns", "actions", "objectives", "runs here"):
        table.add_column(column)
    for name, peer in PEERS.items():
        objectives = "any" if peer.objectives is None else "{} to {}".format(*peer.objectives)
        reason = peer.unavailable_reason()
        table.add_row(
            name,
            "a known utility" if peer.known_utility else "a front",
            ", ".join(peer.actions),
            objectives,
            "yes" if reason is None else f"no: {reason}".replace("[", r"\["),
        )
    return table


def seed_everything(seed: int) -> None:
    """Seed the global generators: the libraries draw from them whatever seed they are given."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    torch.manual_seed(seed)


def load(options: argparse.Namespace, overrides: list[str]) -> Experiment:
    """The experiment that the options ask for, checked as far as it can be without training.

    Raises:
        ValueError: for anything wrong with it.
    """
    experiment = load_experiment(options.config, overrides)
    name = experiment.algorithm["name"]
    if name not in PEERS:
        raise ValueError(f"algorithm.name = {name!r} is not another library's; use train.py, or {nearest(name, PEERS)}")
    prepare(experiment, lambda step, metrics: None)
    return experiment


def main(arguments: list[str]) -> int:
    """Run the command line ``arguments``; the exit code."""
    options, overrides = parse_arguments(arguments)
    console = make_console()
    if options.list:
        console.print(overview())
        return 0
    try:
        experiment = load(options, overrides)
        run = Run.create(experiment, options.output or default_directory("runs", options.config, experiment))
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"run {run.path}", flush=True)
    torch.set_num_threads(experiment.training.threads)
    seed_everything(experiment.training.seed)
    try:
        run_peer(run, console)
    except KeyboardInterrupt:
        run.set_status("interrupted", 0)
        print("interrupted; other libraries' algorithms cannot go on from here", file=sys.stderr)
        return 130
    except BaseException:
        run.set_status("failed", 0)
        raise
    print(f"finished: {run.path}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
