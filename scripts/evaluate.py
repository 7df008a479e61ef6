"""Evaluate the policy of a run: utilities, vector returns, rates and comfort, with 95% intervals; or its front.

    python scripts/evaluate.py runs/mo_a2c_linear/mo_a2c-seed3-20260101-120000 --episodes 1000 --video drive.mp4
    python scripts/evaluate.py --zoo

The zoo's policies are trained already; their names stand for runs.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import Any

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # videos are drawn in memory
os.environ.setdefault("SDL_AUDIODRIVER", "dummy")
sys.path.append(os.getcwd())  # where a user's own utility lives

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from algorithms.common.checkpoints import read_checkpoint
from algorithms.experiments.config import find_environment
from algorithms.experiments.progress_bar import make_console
from algorithms.experiments.run_directory import Run
from algorithms.experiments.training import attempt_film, build, evaluate_front, evaluate_policies, film
from algorithms.reporting.front_report import film_front, report_front
from algorithms.reporting.tables import evaluation_table, write_evaluation
from algorithms.zoo import find, names


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """The options of this script."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("run", nargs="?", metavar="RUN", help="directory of a run, or a name in the zoo")
    what.add_argument("--zoo", action="store_true", help="list the policies of the zoo instead")
    parser.add_argument("--episodes", type=int, metavar="N", help="episodes per policy (default: as in the config)")
    parser.add_argument("--seed", type=int, metavar="S", help="seed of the first episode (default: as in the config)")
    parser.add_argument("--video", metavar="FILE", help="also write an MP4 of the first episodes (four of a front)")
    parser.add_argument("--stochastic", action="store_true", help="film the stochastic policy, not the greedy one")
    parser.add_argument("--output", metavar="DIR", help="also write what train.py writes of it")
    parser.add_argument("--device", default="cpu", metavar="D", help="where the networks live (default: cpu)")
    return parser.parse_args(arguments)


def show_front(
    run: Run, agent: Any, options: argparse.Namespace, console: Console, episodes: int, seed: int, step: int
) -> bool:
    """Evaluate a front anew, write and film what the options ask for; whether there is the video asked for."""
    front = evaluate_front(agent, run.experiment, episodes=episodes, seed=seed)
    directory = None
    if options.output:
        directory = Path(options.output)
        directory.mkdir(exist_ok=True)
    environment = run.experiment.environment
    report_front(
        front,
        console,
        algorithm=run.experiment.algorithm["name"],
        env_id=environment.id,
        env_arguments=environment.arguments,
        reference_point=run.experiment.evaluation.reference_point,
        directory=directory,
        about={"step": step},
    )
    return not options.video or attempt_film(
        lambda: film_front(agent, front, environment.id, environment.arguments, options.video, seed=seed), console
    )


def list_zoo(console: Console) -> None:
    """Print the names of the zoo's policies, and what each was trained on.

    Raises:
        ValueError: if the config of one is not valid.
    """
    table = Table(title="policies of the zoo", title_justify="left", title_style="bold", box=SIMPLE_HEAD)
    table.add_column("name", no_wrap=True)
    for column in ("scenario", "utility", "algorithm"):
        table.add_column(column)
    for name in names():
        experiment = Run.open(find(name), device="cpu").experiment
        scenario = find_environment(experiment.environment.id).kwargs.get("scenario", experiment.environment.id)
        chosen = experiment.utility
        utilities = [] if chosen is None else [chosen.name, *(each.name for each in chosen.vehicles.values())]
        utility = ", ".join(dict.fromkeys(utilities)) or "all: a front"
        table.add_row(name, scenario, utility, experiment.algorithm["name"])
    console.print(table if table.row_count else "the zoo is empty")


def main(arguments: list[str]) -> int:
    """Run the command line ``arguments``; the exit code."""
    options = parse_arguments(arguments)
    console = make_console()
    try:
        if options.zoo:
            list_zoo(console)
            return 0
        run = Run.open(options.run, device=options.device)
        settings = run.experiment.evaluation
        episodes = settings.final_episodes if options.episodes is None else options.episodes
        seed = settings.seed if options.seed is None else options.seed
        if episodes < 1:
            raise ValueError(f"--episodes {episodes} must be at least 1")
        if not 0 <= seed < 2**31:
            raise ValueError(f"--seed {seed} must be between 0 and {2**31 - 1}")
        for path in (Path(each) for each in (options.video, options.output) if each):
            if not path.absolute().parent.is_dir():
                raise ValueError(f"{str(path.absolute().parent)!r} is no directory to write {path.name!r} to")
        agent = build(run.experiment, num_envs=1)
        agent.load(run.checkpoint, policy_only=True)
        step = int(read_checkpoint(run.checkpoint, {})[1]["step"])
        if not run.experiment.known_utility:
            return 0 if show_front(run, agent, options, console, episodes, seed, step) else 1
        evaluations = evaluate_policies(agent, run.experiment, episodes=episodes, seed=seed)
        console.print(
            evaluation_table(evaluations, f"{options.run} at step {step:,}: {episodes} episodes from seed {seed}")
        )
        if options.output:
            directory = Path(options.output)
            directory.mkdir(exist_ok=True)
            write_evaluation(
                directory, evaluations, {"step": step, "episodes": episodes, "seed": seed, "gamma": settings.gamma}
            )
        if options.video and not film(
            agent, run.experiment, options.video, console, seed=seed, greedy=not options.stochastic
        ):
            return 1
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
