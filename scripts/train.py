"""Train an agent from a YAML file, or go on with a run that was interrupted.

    python scripts/train.py --config configs/one_waypoint/mo_a2c_linear.yaml --seed 3
    python scripts/train.py --config FILE --algorithm.learning_rate=3e-4 --training.total_timesteps=1e6
    python scripts/train.py --resume runs/mo_a2c_linear/mo_a2c-seed3-20260101-120000

Every key of the YAML file is an option of its own: --section.key=value.
"""

from __future__ import annotations

import argparse
import os
import sys

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # videos are drawn in memory
os.environ.setdefault("SDL_AUDIODRIVER", "dummy")
sys.path.append(os.getcwd())  # where a user's own utility lives

from algorithms.agent import Agent
from algorithms.common.checkpoints import read_checkpoint
from algorithms.experiments.config import load_experiment
from algorithms.experiments.progress_bar import make_console
from algorithms.experiments.run_directory import Run, default_directory
from algorithms.experiments.training import Stopped, build, finish, resume, train


def parse_arguments(arguments: list[str]) -> tuple[argparse.Namespace, list[str]]:
    """The options of this script, and the overrides of the experiment."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--config", metavar="FILE", help="the experiment")
    source.add_argument("--resume", metavar="RUN", help="directory of a run to go on with")
    parser.add_argument("--seed", metavar="N", help="short for --training.seed")
    parser.add_argument("--device", metavar="D", help="short for --training.device")
    parser.add_argument("--output", metavar="DIR", help="the run's directory (default: runs/CONFIG/NAME)")
    options, overrides = parser.parse_known_args(arguments)
    overrides += [f"--{key}={value}" for key in ("seed", "device") if (value := getattr(options, key)) is not None]
    return options, overrides


def prepare(options: argparse.Namespace, overrides: list[str]) -> tuple[Run, Agent]:
    """The run that the options ask for, and its agent: a new one, or as the last checkpoint left it.

    Raises:
        ValueError: for anything wrong with the options, the experiment, the directory or the checkpoint.
    """
    if options.resume is None:
        experiment = load_experiment(options.config, overrides)
        agent = build(experiment)
        directory = options.output or default_directory("runs", options.config, experiment)
        return Run.create(experiment, directory), agent
    if overrides or options.output:
        given = [*overrides, *(["--output"] if options.output else [])]
        raise ValueError(f"--resume goes on with the run as it began; it cannot take {' '.join(given)}")
    run = Run.open(options.resume)
    if run.checkpoint.exists():
        read_checkpoint(run.checkpoint, {}, whole=True)  # before anything is written beside a policy of the zoo
    run.lock()
    agent = resume(run)
    for change in run.changed_versions():
        print(f"warning: since the run began, {change}")
    return run, agent


def main(arguments: list[str]) -> int:
    """Run the command line ``arguments``; the exit code."""
    options, overrides = parse_arguments(arguments)
    try:
        run, agent = prepare(options, overrides)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    console = make_console()
    again = f"go on with: python scripts/train.py --resume {run.path}"
    try:
        if run.status.get("state") == "finished":
            print(f"{run.path} is finished; there is nothing to resume")
            return 0
        print(f"run {run.path}", flush=True)
        received = train(run, agent, console, resumed=options.resume is not None)
        if received is not None:
            print(f"interrupted at step {agent.step:,}; {again}")
            return 128 + received
        finish(run, agent, console)
    except Stopped as error:
        print(f"error: {error}\n{again}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"interrupted; {again}", file=sys.stderr)
        return 130
    print(f"finished: {run.path}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
