"""Fronts of conditioned MO-PPO beside the best-known fronts, from the shipped configs.

    python scripts/conditioned_comparison.py --only one_waypoint/conditioned --seeds 0 1 2 --output conditioned.csv

Every run is measured by its greedy policies in new episodes; docs/results/conditioned.md explains the table.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from algorithms.common.atomic_io import atomic_write, csv_bytes
from algorithms.evaluation.front import best_known_front, indicators
from algorithms.evaluation.metrics import EXPECTED_UTILITY, HYPERVOLUME
from algorithms.experiments.build import build
from algorithms.experiments.cli import make_parser
from algorithms.experiments.config import load_experiment
from algorithms.experiments.policy_evaluation import evaluate_front, evaluation_env

if TYPE_CHECKING:
    from collections.abc import Sequence

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
        seed: of the run.
        steps: environment steps.
        hypervolume: of the front, divided by that of the best-known front.
        expected_utility: over 50 weights, divided likewise.
        policies: number of non-dominated ones.
        seconds: CPU time of the training.
    """

    config: str
    seed: int
    steps: int
    hypervolume: float
    expected_utility: float
    policies: int
    seconds: float


def learn(config: str, seed: int, steps: int | None = None) -> Result:
    """Train one run in this process and measure its front.

    Raises:
        ValueError: if the config has no best-known front, or its best-known front has no hypervolume.
    """
    torch.set_num_threads(1)
    changed = [] if steps is None else [f"--training.total_timesteps={steps}"]
    experiment = load_experiment(config, [f"--seed={seed}", *changed])
    agent = build(experiment)
    started = process_time()
    agent.train(experiment.training.total_timesteps)
    seconds = process_time() - started
    front = evaluate_front(agent, experiment, episodes=1, seed=experiment.evaluation.final_seed)
    env = evaluation_env(experiment, 1)
    try:
        best = best_known_front(env, experiment.evaluation.gamma)
    finally:
        env.close()
    if best is None:
        raise ValueError(f"config {config!r}: no best-known front is shipped for its environment")
    found, known = (
        indicators(points, reference_point=experiment.evaluation.reference_point, scales=agent.env.objective_scales)
        for points in (front.discounted, best)
    )
    shares = {name: found[name] / known[name] for name in (HYPERVOLUME, EXPECTED_UTILITY)}
    return Result(config, seed, agent.step, shares[HYPERVOLUME], shares[EXPECTED_UTILITY], len(front), seconds)


def rows(results: Sequence[Result]) -> list[list[str]]:
    """The table: mean and range over the seeds, one row per config."""
    table = []
    for config in dict.fromkeys(each.config for each in results):
        mine = [each for each in results if each.config == config]
        cells = []
        for name in ("hypervolume", "expected_utility"):
            values = np.array([getattr(each, name) for each in mine])
            cells.append(f"{values.mean():.1%} ({values.min():.1%} to {values.max():.1%})")
        seconds = np.mean([each.seconds for each in mine])
        table.append([config, str(len(mine)), f"{mine[0].steps:,}", *cells, f"{seconds:.0f}"])
    return table


def write_results(path: Path, results: Sequence[Result]) -> None:
    """Write one row per run as CSV, atomically."""
    rows = [[each.name for each in fields(Result)]]
    for result in results:
        cells = asdict(result)
        cells |= {name: f"{cells[name]:.4f}" for name in ("hypervolume", "expected_utility")}
        cells["seconds"] = f"{result.seconds:.0f}"
        rows.append([str(cell) for cell in cells.values()])
    atomic_write(path, csv_bytes(rows))


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = make_parser(__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(10)), help="default: 0 to 9")
    parser.add_argument("--only", nargs="+", choices=CONFIGS, default=list(CONFIGS), help="configs; default: all")
    parser.add_argument("--steps", type=int, help="of every run, instead of the config's")
    parser.add_argument("--output", type=Path, help="also write every run to this CSV file")
    arguments = parser.parse_args(argv)
    if arguments.steps is not None and arguments.steps < 1:
        parser.error(f"--steps {arguments.steps} must be at least 1")
    if arguments.output is not None and not arguments.output.parent.is_dir():
        parser.error(f"--output {arguments.output}: there is no folder {arguments.output.parent}")
    results: list[Result] = []
    for config in arguments.only:
        for seed in arguments.seeds:
            results.append(learn(config, seed, arguments.steps))
            if arguments.output is not None:
                write_results(arguments.output, results)
    table = Table("config", "seeds", "steps", "hypervolume", "expected utility", "CPU seconds")
    for row in rows(results):
        table.add_row(*row)
    Console().print(table)


if __name__ == "__main__":
    main()
