"""One network for all preferences beside one learner per preference: conditioned MO-PPO and MO-PPO, as many steps each.

    python scripts/conditioned_specialists.py --config one_waypoint/conditioned_drawn --seeds 0 1 2 --output results.csv

A specialist, MO-PPO with the settings that both algorithms have, is trained for each of a few linear preferences from
the distribution of training, without its emphasis, with the first of the seeds; the config's network is trained with
each of them. All drive
the same episodes of the test split by their greedy policies; the table has the expected utility of the discounted
return in scales, and a network's share of the specialists' mean. A preference for which standing still is best has
utility 0.
"""

from __future__ import annotations

import math
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
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from algorithms.evaluation.episodes import Evaluation
    from algorithms.experiments.config import Experiment

PREFERENCES_SEED = 1  # of the preferences; those of the front have another
CONFIGS = ("one_waypoint/conditioned_drawn", "static_obstacle/conditioned_drawn", "left_turn/conditioned")


@dataclass(frozen=True)
class Result:
    """One preference under one network.

    Attributes:
        config: of the network.
        seed: of the network.
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
    # The past does not matter to a linear utility, and with accrued_gamma = 1 late decisions count as much as early
    # ones, as they do for the network.
    past = {"accrued_gamma": 1.0, "observe_accrued": False, "observe_discount": False}
    values["algorithm"] = {**shared, **past, "name": "mo_ppo"}
    values["utility"] = {"name": "linear", "arguments": {"weights": weights.tolist()}}
    return make_experiment(values)


@dataclass(frozen=True)
class Score:
    """What a policy achieves under a preference.

    Attributes:
        utility: expected utility of the discounted return, in scales.
        arrivals: share of the episodes.
        seconds: CPU time of the training.
    """

    utility: float
    arrivals: float
    seconds: float


def compare(
    config: str, seeds: Sequence[int], count: int, episodes: int, steps: int | None = None
) -> Iterator[list[Result]]:
    """Train ``count`` specialists with the first seed, and the network with each seed, in this process.

    Yields:
        The results of a network, a preference each, as soon as they are known.

    Raises:
        ValueError: if the config's algorithm is another, or it has no linear utilities or several vehicles.
    """
    torch.set_num_threads(1)
    changed = [] if steps is None else [f"--training.total_timesteps={steps}"]
    experiments = [load_experiment(config, [f"--seed={seed}", *changed]) for seed in seeds]
    agent = build(experiments[0])
    if not isinstance(agent, ConditionedMOPPO) or agent.env.vehicles > 1 or agent.preferences.used != [LINEAR]:
        raise ValueError(
            f"config {config!r} must be of conditioned_mo_ppo, with one vehicle and linear utilities alone"
        )
    conditions = agent.preferences.draw(count, np.random.default_rng(PREFERENCES_SEED), emphasis=False)
    scales, env = agent.scales, evaluation_env(experiments[0], episodes)
    common: dict[str, Any] = {"episodes": episodes, "seed": SPLITS["test"].start, "gamma": agent.accrued_discount}

    def score(weights: NDArray[np.float32], found: Evaluation, seconds: float) -> Score:
        utility = float(weights @ (found.discounted[:, 0].mean(axis=0) / scales))
        return Score(utility, float(found.succeeded[:, 0].mean()), seconds)

    def trained(experiment: Experiment) -> tuple[Any, float]:
        learner = build(experiment)
        started = process_time()
        learner.train(experiment.training.total_timesteps)
        return learner, process_time() - started

    specialists = []
    for weights in conditions:
        learner, seconds = trained(specialist_experiment(experiments[0], weights.astype(np.float64) / scales))
        specialists.append(score(weights, evaluate(learner, env, greedy=True, **common), seconds))
    for seed, experiment in zip(seeds, experiments, strict=True):
        network, seconds = trained(experiment)
        found = [
            score(weights, each, seconds)
            for weights, each in zip(conditions, network.evaluate_policies(conditions, env, **common), strict=True)
        ]
        yield [
            Result(
                config=config,
                seed=seed,
                steps=network.step,
                weights=" ".join(f"{weight:.3f}" for weight in weights),
                conditioned=own.utility,
                specialist=special.utility,
                arrivals=own.arrivals,
                specialist_arrivals=special.arrivals,
                seconds=special.seconds,
            )
            for weights, own, special in zip(conditions, found, specialists, strict=True)
        ]
    env.close()


def shares(results: Sequence[Result]) -> dict[int, float]:
    """Of every network, by its seed, its share of the specialists' mean utility; NaN where that is not positive."""
    found = {}
    for seed in dict.fromkeys(each.seed for each in results):
        mine = [each for each in results if each.seed == seed]
        conditioned, specialist = (sum(getattr(each, name) for each in mine) for name in ("conditioned", "specialist"))
        found[seed] = conditioned / specialist if specialist > 0.0 else math.nan
    return found


def table(results: Sequence[Result]) -> Table:
    """One row per preference, with the means over the networks, and their shares of the specialists' mean."""
    shown = Table("weights", "one network", "specialist", "arrivals", "specialist's", "CPU seconds")
    for weights in dict.fromkeys(each.weights for each in results):
        mine = [each for each in results if each.weights == weights]
        conditioned, arrivals = (
            np.mean([getattr(each, name) for each in mine]) for name in ("conditioned", "arrivals")
        )
        numbers = f"{conditioned:.4f}", f"{mine[0].specialist:.4f}", f"{arrivals:.1%}"
        shown.add_row(weights, *numbers, f"{mine[0].specialist_arrivals:.1%}", f"{mine[0].seconds:.0f}")
    each_share = ", ".join(f"{share:.1%} (seed {seed})" for seed, share in shares(results).items())
    shown.caption = f"shares of the specialists' mean: {each_share}"
    return shown


def write_results(path: Path, results: Sequence[Result]) -> None:
    """Write one row per network and preference as CSV."""
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
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="of the networks (default: 0)")
    parser.add_argument("--preferences", type=int, default=8, help="number of specialists (default: 8)")
    parser.add_argument("--episodes", type=int, default=1000, help="of every policy (default: 1000)")
    parser.add_argument("--steps", type=int, help="of every run, instead of the config's")
    parser.add_argument("--output", type=Path, help="also write every network and preference to this CSV file")
    arguments = parser.parse_args(argv)
    for name, most in (("preferences", 1000), ("episodes", len(SPLITS["test"])), ("steps", None)):
        value = getattr(arguments, name)
        if value is not None and not 1 <= value <= (most or value):
            parser.error(f"--{name} {value} must be {'at least 1' if most is None else f'between 1 and {most}'}")
    if arguments.output is not None and not arguments.output.parent.is_dir():
        parser.error(f"--output {arguments.output}: there is no folder {arguments.output.parent}")
    with exit_on_error(ValueError, OSError):
        found: list[Result] = []
        settings = arguments.preferences, arguments.episodes, arguments.steps
        for results in compare(arguments.config, arguments.seeds, *settings):
            found += results
            if arguments.output is not None:
                write_results(arguments.output, found)
        Console().print(table(found))


if __name__ == "__main__":
    main()
