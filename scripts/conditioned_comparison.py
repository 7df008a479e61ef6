"""Fronts of conditioned MO-PPO beside the best-known fronts, from the shipped configs.

    python scripts/conditioned_comparison.py --only one_waypoint/conditioned --seeds 0 1 2 --output conditioned.csv
    python scripts/conditioned_comparison.py --only one_waypoint/conditioned --change algorithm.switching=0.03

Every run is measured by its greedy policies in new episodes; docs/lab/conditioned.md explains the table.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Annotated

import numpy as np
import torch
from result_file import check_folder, read_results, write_results
from rich.console import Console
from rich.table import Table

from algorithms.experiments.build import build
from algorithms.experiments.cli import exit_on_error, make_parser
from algorithms.experiments.config import load_experiment
from algorithms.experiments.policy_evaluation import evaluate_front, evaluation_env
from mo_deepdrive.evaluation.env_adapter import EnvAdapter
from mo_deepdrive.evaluation.front import best_known_front, indicators
from mo_deepdrive.evaluation.metrics import EXPECTED_UTILITY, HYPERVOLUME

if TYPE_CHECKING:
    from collections.abc import Sequence

    from algorithms.experiments.config import Experiment

CONFIGS = (
    "one_waypoint/conditioned",
    "one_waypoint/conditioned_continuous",
    "static_obstacle/conditioned",
    "static_obstacle/conditioned_continuous",
)


@dataclass(frozen=True)
class Result:
    """One run.

    Attributes:
        config: one of :data:`CONFIGS`.
        changed: settings other than the config's, ``KEY=VALUE`` with spaces between.
        seed: of the run.
        steps: environment steps.
        hypervolume: of the front, divided by that of the best-known front.
        expected_utility: over 50 weights, divided likewise.
        policies: number of non-dominated ones.
        seconds: CPU time of the training.
    """

    config: str
    changed: str
    seed: int
    steps: int
    hypervolume: Annotated[float, ".4f"]
    expected_utility: Annotated[float, ".4f"]
    policies: int
    seconds: Annotated[float, ".0f"]


def best_known_indicators(experiment: Experiment) -> dict[str, float]:
    """Those of the best-known front for the environment of ``experiment``.

    Raises:
        ValueError: if none is shipped.
    """
    env = evaluation_env(experiment, 1)
    try:
        best = best_known_front(env, experiment.evaluation.gamma)
        scales = EnvAdapter(env).objective_scales
    finally:
        env.close()
    if best is None:
        raise ValueError(f"environment {experiment.environment}: no best-known front is shipped for it")
    return indicators(best, reference_point=experiment.evaluation.reference_point, scales=scales)


def learn(config: str, changes: Sequence[str], seed: int) -> Result:
    """Train one run in this process and measure its front.

    Raises:
        ValueError: if a change is not a setting of the config, or the environment has no best-known front.
    """
    torch.set_num_threads(1)
    experiment = load_experiment(config, [f"--seed={seed}", *(f"--{change}" for change in changes)])
    known = best_known_indicators(experiment)
    agent = build(experiment)
    started = process_time()
    agent.train(experiment.training.total_timesteps)
    seconds = process_time() - started
    front = evaluate_front(agent, experiment, episodes=1, seed=experiment.evaluation.final_seed)
    found = indicators(
        front.discounted,
        reference_point=experiment.evaluation.reference_point,
        scales=agent.env.objective_scales,
    )
    return Result(
        config=config,
        changed=" ".join(changes),
        seed=seed,
        steps=experiment.training.total_timesteps,
        hypervolume=found[HYPERVOLUME] / known[HYPERVOLUME],
        expected_utility=found[EXPECTED_UTILITY] / known[EXPECTED_UTILITY],
        policies=len(front),
        seconds=seconds,
    )


def rows(results: Sequence[Result]) -> list[list[str]]:
    """The table: mean and range over the seeds, one row per config and changes."""
    table = []
    for config, changed, steps in dict.fromkeys((each.config, each.changed, each.steps) for each in results):
        mine = [each for each in results if (each.config, each.changed, each.steps) == (config, changed, steps)]
        cells = []
        for name in ("hypervolume", "expected_utility"):
            values = np.array([getattr(each, name) for each in mine])
            cells.append(f"{values.mean():.1%} ({values.min():.1%} to {values.max():.1%})")
        seconds = np.mean([each.seconds for each in mine])
        table.append([config, changed, str(len(mine)), f"{steps:,}", *cells, f"{seconds:.0f}"])
    return table


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = make_parser(__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(10)), help="default: 0 to 9")
    parser.add_argument("--only", nargs="+", choices=CONFIGS, default=list(CONFIGS), help="configs; default: all")
    parser.add_argument(
        "--change", nargs="+", default=[], metavar="KEY=VALUE", help="settings other than the config's, of every run"
    )
    parser.add_argument("--output", type=Path, help="CSV file of every run, continued if it exists")
    arguments = parser.parse_args(argv)
    check_folder(parser, arguments.output)
    changed = " ".join(arguments.change)
    with exit_on_error(ValueError, OSError):
        results = read_results(arguments.output, Result)
        done = {(each.config, each.changed, each.seed) for each in results}
        for config, seed in product(arguments.only, arguments.seeds):
            if (config, changed, seed) not in done:
                results.append(learn(config, arguments.change, seed))
                write_results(arguments.output, results)
    table = Table("config", "changed", "seeds", "steps", "hypervolume", "expected utility", "CPU seconds")
    for row in rows(results):
        table.add_row(*row)
    Console().print(table)


if __name__ == "__main__":
    main()
