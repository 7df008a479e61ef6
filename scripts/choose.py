"""Choose a policy of a front: the one that a preference selects, driven anew, with its expected returns.

    python scripts/choose.py RUN --weights distance=1 jerk=0.01
    python scripts/choose.py RUN --utility one_waypoint_nonlinear --video drive.mp4
    python scripts/choose.py RUN --target distance=14 g_force=-6

RUN is a finished run of an algorithm that learns a front, or the name of one in the zoo. All of its policies are
evaluated anew. --weights takes the greatest weighted sum of returns (objectives that are not named weigh nothing),
--utility the greatest expected utility, --target the policy that falls least short of what is named, in nominal scales
of the objectives.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # videos are drawn in memory
os.environ.setdefault("SDL_AUDIODRIVER", "dummy")
sys.path.append(os.getcwd())  # where a user's own utility lives

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from algorithms.common.yaml_io import read_value
from algorithms.evaluation.evaluate import Evaluation
from algorithms.evaluation.front import Front
from algorithms.evaluation.statistics import Estimate, mean, rate
from algorithms.experiments.progress_bar import make_console
from algorithms.experiments.run_directory import Run
from algorithms.experiments.training import attempt_film, build, evaluate_policies_of
from algorithms.reporting.front_report import film_front
from mo_deepdrive.config import nearest
from mo_deepdrive.utilities import make_utility

RUNNERS_UP = 4

# From returns (K, E, d) of K policies to what each is worth (K,), and the name of that.
Worth = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """The options of this script."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("run", metavar="RUN", help="directory of a finished run, or a name in the zoo")
    preference = parser.add_mutually_exclusive_group(required=True)
    preference.add_argument(
        "--weights", nargs="+", metavar="OBJECTIVE=W", help="how much a unit of each return is worth"
    )
    preference.add_argument("--utility", metavar="NAME", help="a utility by name, or package.module:function")
    preference.add_argument("--target", nargs="+", metavar="OBJECTIVE=R", help="undiscounted returns wished for")
    parser.add_argument("--arguments", default="{}", metavar="YAML", help="of the utility, such as '{weights: [1, 2]}'")
    parser.add_argument("--episodes", type=int, default=20, metavar="N", help="of every policy (default: 20)")
    parser.add_argument("--seed", type=int, metavar="S", help="seed of the first episode (default: as in the config)")
    parser.add_argument("--video", metavar="FILE", help="also film the chosen policy")
    return parser.parse_args(arguments)


def named_numbers(option: str, pairs: list[str], objectives: tuple[str, ...]) -> dict[str, float]:
    """``["distance=1", "jerk=0.1"]`` as a mapping.

    Raises:
        ValueError: naming the pair that is no finite number for a known objective, or that stands twice.
    """
    numbers: dict[str, float] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if name not in objectives:
            raise ValueError(f"{option} {pair!r}: {name!r} is no objective; {nearest(name, objectives)}")
        try:
            number = float(text)
        except ValueError:
            number = np.nan
        if not equals or not np.isfinite(number):
            raise ValueError(f"{option} {pair!r} must be of the form {name}=NUMBER")
        if name in numbers:
            raise ValueError(f"{option} names {name!r} twice")
        numbers[name] = number
    return numbers


def preference(options: argparse.Namespace, objectives: tuple[str, ...], scales: NDArray[Any]) -> tuple[str, Worth]:
    """The name of what is maximised, and how it is computed.

    Raises:
        ValueError: for unknown objectives or utilities, or numbers that make no sense.
    """
    if options.arguments != "{}" and options.utility is None:
        raise ValueError("--arguments belong to a --utility")
    if options.utility is not None:
        arguments = read_value(options.arguments)
        if not isinstance(arguments, dict):
            raise ValueError(f"--arguments {options.arguments!r} must be a mapping")
        utility = make_utility(options.utility, objectives, **arguments)
        return f"expected {options.utility}", lambda returns: np.asarray(utility(returns)).mean(axis=1)
    if options.weights is not None:
        weights = named_numbers("--weights", options.weights, objectives)
        if min(weights.values()) < 0.0:
            raise ValueError(
                f"--weights {' '.join(options.weights)}: returns are maximised, so weights are not negative"
            )
        w = np.array([weights.get(name, 0.0) for name in objectives])
        return "weighted sum", lambda returns: (returns @ w).mean(axis=1)
    target = named_numbers("--target", options.target, objectives)
    wanted = np.array([target.get(name, -np.inf) for name in objectives])

    def closeness(returns: NDArray[np.float64]) -> NDArray[np.float64]:
        missing = np.maximum(wanted - returns.mean(axis=1), 0.0) / scales
        return -np.linalg.norm(missing, axis=1)

    return "minus the distance to the target", closeness


def best(values: NDArray[np.float64], returns: NDArray[np.float64], scales: NDArray[Any]) -> NDArray[np.intp]:
    """Policies, best first; of equal ones those with the greater sum of mean returns (K, d) in ``scales``."""
    # Equal up to rounding errors, of whatever size the values are.
    largest = float(np.abs(values).max())
    worth = np.round(values / largest, 9) if largest > 0.0 else values
    return np.lexsort((-(returns / scales).sum(axis=1), -worth))


def show(
    console: Console, front: Front, evaluations: list[Evaluation], worth: NDArray[Any], order: Any, what: str
) -> None:
    """Print the chosen policy with intervals, and the runners-up beside it."""
    chosen, *others = order[: RUNNERS_UP + 1].tolist()
    table = Table(
        title=f"{len(front)} policies by {what}; {len(evaluations[0].returns)} episodes each, 95% intervals",
        title_justify="left",
        title_style="bold",
        box=SIMPLE_HEAD,
    )
    table.add_column("", no_wrap=True)
    table.add_column(f"policy {chosen}: chosen", justify="right", no_wrap=True)
    for k in others:
        table.add_column(f"policy {k}", justify="right", no_wrap=True)
    rows = [(what, [Estimate(float(worth[k])) for k in (chosen, *others)])]
    for i, objective in enumerate(front.objectives):
        rows.append((objective, [mean(evaluations[k].returns[:, 0, i]) for k in (chosen, *others)]))
    if np.isfinite(front.success).all():
        rows.append(("arrivals", [rate(evaluations[k].succeeded[:, 0]) for k in (chosen, *others)]))
    rows.append(("decisions", [mean(evaluations[k].lengths[:, 0].astype(np.float64)) for k in (chosen, *others)]))
    for name, (first, *rest) in rows:
        table.add_row(name, first.text().replace("[", r"\["), *(f"{each.value:.4g}" for each in rest))
    console.print(table)


def main(arguments: list[str]) -> int:
    """Run the command line ``arguments``; the exit code."""
    options = parse_arguments(arguments)
    console = make_console()
    try:
        run = Run.open(options.run, device="cpu")
        experiment = run.experiment
        if experiment.known_utility:
            raise ValueError(f"{options.run!r} learnt one policy, not a front: scripts/evaluate.py shows it")
        seed = experiment.evaluation.seed if options.seed is None else options.seed
        if options.episodes < 1:
            raise ValueError(f"--episodes {options.episodes} must be at least 1")
        if not 0 <= seed < 2**31:
            raise ValueError(f"--seed {seed} must be between 0 and {2**31 - 1}")
        if options.video and not Path(options.video).absolute().parent.is_dir():
            raise ValueError(
                f"--video {options.video!r}: {str(Path(options.video).absolute().parent)!r} is no directory"
            )
        agent = build(experiment, num_envs=1)
        front = Front.read(run.path)
        scales = np.asarray(agent.scales, dtype=np.float64)
        what, worth_of = preference(options, front.objectives, scales)
        agent.load(run.checkpoint, policy_only=True)
        evaluations = evaluate_policies_of(agent, front, experiment, episodes=options.episodes, seed=seed)
        returns = np.stack([each.returns[:, 0] for each in evaluations])
        worth = worth_of(returns)
        order = best(worth, returns.mean(axis=1), scales)
        show(console, front, evaluations, worth, order, what)
        console.print(f"policy {order[0]} of {run.path / 'front.csv'}")
        if options.video and not attempt_film(
            lambda: film_front(
                agent,
                front,
                experiment.environment.id,
                experiment.environment.arguments,
                options.video,
                seed=seed,
                policies=order[:1],
            ),
            console,
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
