"""One network for all preferences beside one learner per preference: conditioned MO-PPO and MO-PPO, as many steps each.

    python scripts/conditioned_specialists.py --config one_waypoint/conditioned_drawn --seed 0 --output specialists.csv

The config's network is trained once. Then a specialist, MO-PPO with the settings that both algorithms have, is trained
for each of a few linear preferences from the distribution of training. All drive the same episodes of the test split by
their greedy policies; the table has the expected utility of the discounted return in scales. A preference for which
standing still is best has utility 0.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from algorithms.common.atomic_io import atomic_write, csv_bytes
from algorithms.common.preferences import LINEAR
from algorithms.conditioned_mo_ppo import ConditionedMOPPO
from algorithms.evaluation.episodes import evaluate
from algorithms.evaluation.splits import SPLITS
from algorithms.experiments.build import build
from algorithms.experiments.cli import exit_on_error, make_parser
from algorithms.experiments.config import load_experiment, make_experiment
from algorithms.experiments.policy_evaluation import evaluation_env
from algorithms.mo_ppo import MOPPOConfig

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from algorithms.experiments.config import Experiment

PREFERENCES_SEED = 1  # of the preferences; those of the front have another
CONFIGS = ("one_waypoint/conditioned_drawn", "left_turn/conditioned")


@dataclass(frozen=True)
class Result:
    """One preference.

    Attributes:
        config: of the network.
        seed: of all runs.
        steps: environment steps of each run.
        weights: of the objectives, in units of their scales.
        conditioned: expected utility under the network.
        specialist: expected utility under the learner of this preference.
        arrivals: share of the episodes in which the network arrives.
        specialist_arrivals: that of the specialist.
        seconds: CPU time of the specialist's training.
    """

    config: str
    seed: int
    steps: int
    weights: str
    conditioned: float
    specialist: float
    arrivals: float
    specialist_arrivals: float
    seconds: float


def specialist_experiment(experiment: Experiment, weights: NDArray[np.float64]) -> Experiment:
    """MO-PPO for the linear utility of ``weights`` (d,) of returns, with what its settings share with the network's."""
    values: dict[str, Any] = experiment.to_dict()
    shared = {key: value for key, value in experiment.algorithm.items() if key in MOPPOConfig.model_fields}
    # The past does not matter to a linear utility.
    values["algorithm"] = {**shared, "name": "mo_ppo", "observe_accrued": False, "observe_discount": False}
    values["utility"] = {"name": "linear", "arguments": {"weights": weights.tolist()}}
    return make_experiment(values)


def compare(config: str, seed: int, count: int, episodes: int, steps: int | None = None) -> list[Result]:
    """Train the network and ``count`` specialists in this process.

    Raises:
        ValueError: if the config's algorithm is another, or it has no linear utilities or several vehicles.
    """
    torch.set_num_threads(1)
    changed = [] if steps is None else [f"--training.total_timesteps={steps}"]
    experiment = load_experiment(config, [f"--seed={seed}", *changed])
    agent = build(experiment)
    if not isinstance(agent, ConditionedMOPPO) or agent.env.vehicles > 1 or agent.preferences.used != [LINEAR]:
        raise ValueError(
            f"config {config!r} must be of conditioned_mo_ppo, with one vehicle and linear utilities alone"
        )
    agent.train(experiment.training.total_timesteps)
    conditions = agent.preferences.draw(count, np.random.default_rng(PREFERENCES_SEED))
    env = evaluation_env(experiment, episodes)
    common: dict[str, Any] = {"episodes": episodes, "seed": SPLITS["test"].start, "gamma": agent.accrued_discount}
    results = []
    for weights, found in zip(conditions, agent.evaluate_policies(conditions, env, **common), strict=True):
        specialist = build(specialist_experiment(experiment, weights.astype(np.float64) / agent.scales))
        started = process_time()
        specialist.train(experiment.training.total_timesteps)
        seconds = process_time() - started
        own = evaluate(specialist, env, greedy=True, **common)
        utilities = [float(weights @ (each.discounted[:, 0].mean(axis=0) / agent.scales)) for each in (found, own)]
        arrivals = [float(each.succeeded[:, 0].mean()) for each in (found, own)]
        shown = " ".join(f"{weight:.3f}" for weight in weights)
        results.append(
            Result(
                config=config,
                seed=seed,
                steps=agent.step,
                weights=shown,
                conditioned=utilities[0],
                specialist=utilities[1],
                arrivals=arrivals[0],
                specialist_arrivals=arrivals[1],
                seconds=seconds,
            )
        )
    env.close()
    return results


def table(results: Sequence[Result]) -> Table:
    """One row per preference, and the means."""
    shown = Table("weights", "one network", "specialist", "arrivals", "specialist's", "CPU seconds")
    for each in results:
        numbers = f"{each.conditioned:.4f}", f"{each.specialist:.4f}", f"{each.arrivals:.1%}"
        shown.add_row(each.weights, *numbers, f"{each.specialist_arrivals:.1%}", f"{each.seconds:.0f}")
    conditioned, specialist = (np.mean([getattr(r, name) for r in results]) for name in ("conditioned", "specialist"))
    shown.add_row("mean", f"{conditioned:.4f}", f"{specialist:.4f}")
    if specialist > 0.0:
        shown.caption = f"the network has {conditioned / specialist:.1%} of the specialists' mean"
    return shown


def write_results(path: Path, results: Sequence[Result]) -> None:
    """Write one row per preference as CSV."""
    rows = [[each.name for each in fields(Result)]]
    for result in results:
        cells = asdict(result)
        cells |= {name: f"{cells[name]:.4f}" for name in ("conditioned", "specialist")}
        cells |= {name: f"{cells[name]:.3f}" for name in ("arrivals", "specialist_arrivals")}
        rows.append([*(cells | {"seconds": f"{result.seconds:.0f}"}).values()])
    atomic_write(path, csv_bytes(rows))


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = make_parser(__doc__)
    parser.add_argument("--config", default=CONFIGS[0], help=f"of the network (default: {CONFIGS[0]})")
    parser.add_argument("--seed", type=int, default=0, help="of all runs (default: 0)")
    parser.add_argument("--preferences", type=int, default=8, help="number of specialists (default: 8)")
    parser.add_argument("--episodes", type=int, default=1000, help="of every policy (default: 1000)")
    parser.add_argument("--steps", type=int, help="of every run, instead of the config's")
    parser.add_argument("--output", type=Path, help="also write every preference to this CSV file")
    arguments = parser.parse_args(argv)
    for name, most in (("preferences", 1000), ("episodes", len(SPLITS["test"])), ("steps", None)):
        value = getattr(arguments, name)
        if value is not None and not 1 <= value <= (most or value):
            parser.error(f"--{name} {value} must be {'at least 1' if most is None else f'between 1 and {most}'}")
    if arguments.output is not None and not arguments.output.parent.is_dir():
        parser.error(f"--output {arguments.output}: there is no folder {arguments.output.parent}")
    with exit_on_error(ValueError, OSError):
        found = compare(arguments.config, arguments.seed, arguments.preferences, arguments.episodes, arguments.steps)
        Console().print(table(found))
        if arguments.output is not None:
            write_results(arguments.output, found)


if __name__ == "__main__":
    main()
