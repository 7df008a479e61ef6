"""One network for all preferences beside one learner per preference: conditioned MO-PPO and MO-PPO, as many steps each.

    python scripts/conditioned_specialists.py --config one_waypoint/conditioned_drawn --seeds 0 1 2 --output results.csv

A specialist, MO-PPO with the settings that both algorithms have, is trained once for each of a few linear preferences
from the distribution of training, without its emphasis; the config's network is trained once per seed. All drive the
same episodes of the test split by their greedy policies. The table has the expected utility of the discounted return in
scales, and a network's share of the specialists' mean. A preference for which standing still is best has utility 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from conditioned_preferences import PREFERENCES_SEED
from result_file import check_folder, read_results, write_results
from rich.console import Console
from rich.table import Table

from algorithms.common.preferences import LINEAR
from algorithms.conditioned_mo_ppo import ConditionedMOPPO, ConditionedMOPPOConfig
from algorithms.experiments.build import build
from algorithms.experiments.cli import exit_on_error, make_parser
from algorithms.experiments.config import load_experiment, make_experiment
from algorithms.experiments.policy_evaluation import evaluation_env
from algorithms.mo_ppo import MOPPOConfig
from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.evaluation.splits import SPLITS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from algorithms.experiments.config import Experiment
    from mo_deepdrive.evaluation.evaluation import Evaluation

SPECIALIST_SEED = 0
CONFIGS = ("one_waypoint/conditioned_drawn", "static_obstacle/conditioned_drawn", "left_turn/conditioned")
NETWORK, SPECIALIST = "network", "specialist"


@dataclass(frozen=True)
class Result:
    """What a learner achieves under one preference.

    Attributes:
        config: of the network.
        changed: settings other than the config's, ``KEY=VALUE`` with spaces between.
        learner: :data:`NETWORK` or :data:`SPECIALIST`.
        seed: of the run.
        steps: environment steps.
        preference: its number.
        weights: of the objectives, in units of their scales.
        utility: expected utility of the discounted return, in scales.
        arrivals: share of the episodes.
        seconds: CPU time of the training.
    """

    config: str
    changed: str
    learner: str
    seed: int
    steps: int
    preference: int
    weights: str
    utility: Annotated[float, ".4f"]
    arrivals: Annotated[float, ".3f"]
    seconds: Annotated[float, ".0f"]

    @property
    def run(self) -> tuple[str, str, str, int, int]:
        """What tells its row from others."""
        return self.config, self.changed, self.learner, self.seed, self.preference


def specialist_experiment(experiment: Experiment, weights: NDArray[np.float64]) -> Experiment:
    """MO-PPO for the linear utility of ``weights`` (d,) of returns, with what its settings share with the network's."""
    values: dict[str, Any] = experiment.to_dict()
    network: ConditionedMOPPOConfig = experiment.algorithm.config
    shared = {
        key: getattr(network, key) for key in ConditionedMOPPOConfig.model_fields if key in MOPPOConfig.model_fields
    }
    # The past does not matter to a linear utility, and with accrued_gamma = 1 its advantages are those of the network:
    # with less, late decisions would count for less.
    past = {"accrued_gamma": 1.0, "observe_accrued": False, "observe_discount": False}
    values["algorithm"] = {"name": "mo_ppo", **shared, **past}
    values["utility"] = {"name": "linear", "arguments": {"weights": weights.tolist()}}
    return make_experiment(values)


class Comparison:
    """The runs of a config, its preferences, and the episodes in which all are scored.

    Args:
        config: of the network.
        changes: settings other than the config's, ``KEY=VALUE``.
        count: number of preferences.
        episodes: of every policy.

    Raises:
        ValueError: if the config's algorithm is another, or it has no linear utilities or several vehicles.
    """

    def __init__(self, config: str, changes: Sequence[str], count: int, episodes: int):
        self.config, self.changes = config, list(changes)
        agent = build(self.experiment(SPECIALIST_SEED), num_envs=1)
        if not isinstance(agent, ConditionedMOPPO) or agent.env.vehicles > 1 or agent.preferences.used != [LINEAR]:
            raise ValueError(
                f"config {config!r} must be of conditioned_mo_ppo, with one vehicle and linear utilities alone"
            )
        self.preferences = agent.preferences.draw(count, np.random.default_rng(PREFERENCES_SEED), emphasis=False)
        self.scales, self.episodes = agent.scales, episodes
        self.scored: dict[str, Any] = {
            "episodes": episodes,
            "seed": SPLITS["test"].start,
            "gamma": agent.accrued_discount,
        }

    def experiment(self, seed: int) -> Experiment:
        """The network's."""
        return load_experiment(self.config, [f"--seed={seed}", *(f"--{change}" for change in self.changes)])

    def specialist(self, preference: int) -> list[Result]:
        """Train a specialist for one of the preferences in this process."""
        weights = self.preferences[preference].astype(np.float64) / self.scales
        agent, seconds = trained(specialist_experiment(self.experiment(SPECIALIST_SEED), weights))
        env = evaluation_env(self.experiment(SPECIALIST_SEED), self.episodes)
        try:
            found = evaluate(agent, env, greedy=True, **self.scored)
        finally:
            env.close()
        return [self.result(SPECIALIST, SPECIALIST_SEED, preference, found, seconds)]

    def network(self, seed: int) -> list[Result]:
        """Train a network in this process, and score it under every preference."""
        agent, seconds = trained(self.experiment(seed))
        env = evaluation_env(self.experiment(seed), self.episodes)
        try:
            found = agent.evaluate_policies(self.preferences, env, **self.scored)
            return [self.result(NETWORK, seed, number, each, seconds) for number, each in enumerate(found)]
        finally:
            env.close()

    def result(self, learner: str, seed: int, preference: int, found: Evaluation, seconds: float) -> Result:
        """What a learner achieves under a preference."""
        weights = self.preferences[preference]
        return Result(
            config=self.config,
            changed=" ".join(self.changes),
            learner=learner,
            seed=seed,
            steps=self.experiment(seed).training.total_timesteps,
            preference=preference,
            weights=" ".join(f"{weight:.3f}" for weight in weights),
            utility=float(weights @ (found.discounted[:, 0].mean(axis=0) / self.scales)),
            arrivals=float(found.succeeded[:, 0].mean()),
            seconds=seconds,
        )

    def missing(self, results: Sequence[Result], seeds: Sequence[int]) -> Iterator[Callable[[], list[Result]]]:
        """The runs of which ``results`` lack a row, as functions that make them: specialists first."""
        done = {result.run for result in results}
        run, numbers = (self.config, " ".join(self.changes)), range(len(self.preferences))
        for number in numbers:
            if (*run, SPECIALIST, SPECIALIST_SEED, number) not in done:
                yield partial(self.specialist, number)
        for seed in seeds:
            if any((*run, NETWORK, seed, number) not in done for number in numbers):
                yield partial(self.network, seed)


def trained(experiment: Experiment) -> tuple[Any, float]:
    """The trained agent of an experiment, and the CPU time that it took."""
    torch.set_num_threads(1)
    agent = build(experiment)
    started = process_time()
    agent.train(experiment.training.total_timesteps)
    return agent, process_time() - started


def shares(results: Sequence[Result]) -> dict[int, float]:
    """Of every network, by its seed, its share of the specialists' mean utility; NaN where that is not positive."""
    of_specialists = sum(each.utility for each in results if each.learner == SPECIALIST)
    found: dict[int, float] = {}
    for each in results:
        if each.learner == NETWORK:
            found[each.seed] = found.get(each.seed, 0.0) + each.utility
    return {seed: total / of_specialists if of_specialists > 0.0 else math.nan for seed, total in found.items()}


def table(results: Sequence[Result]) -> Table:
    """One row per preference, with the means over the networks, and their shares of the specialists' mean."""
    shown = Table("weights", "networks", "specialist", "arrivals", "specialist's", "CPU seconds", "specialist's")
    for number in sorted({each.preference for each in results}):
        cells: list[list[str]] = []
        for learner in (NETWORK, SPECIALIST):
            mine = [each for each in results if (each.preference, each.learner) == (number, learner)]
            utility, arrivals, seconds = (
                np.mean([getattr(each, name) for each in mine]) for name in ("utility", "arrivals", "seconds")
            )
            cells.append([f"{utility:.4f}", f"{arrivals:.1%}", f"{seconds:.0f}"])
        shown.add_row(mine[0].weights, *(cell for pair in zip(*cells, strict=True) for cell in pair))
    each_share = ", ".join(f"{share:.1%} (seed {seed})" for seed, share in shares(results).items())
    shown.caption = f"shares of the specialists' mean: {each_share}"
    return shown


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = make_parser(__doc__)
    parser.add_argument("--config", default=CONFIGS[0], help=f"of the network (default: {CONFIGS[0]})")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="of the networks (default: 0)")
    parser.add_argument("--preferences", type=int, default=8, help="number of specialists (default: 8)")
    parser.add_argument("--episodes", type=int, default=1000, help="of every policy (default: 1000)")
    parser.add_argument(
        "--change", nargs="+", default=[], metavar="KEY=VALUE", help="settings other than the config's, of every run"
    )
    parser.add_argument("--output", type=Path, help="CSV file of every run, continued if it exists")
    arguments = parser.parse_args(argv)
    for name, most in (("preferences", 1000), ("episodes", len(SPLITS["test"]))):
        value = getattr(arguments, name)
        if not 1 <= value <= most:
            parser.error(f"--{name} {value} must be between 1 and {most}")
    check_folder(parser, arguments.output)
    with exit_on_error(ValueError, OSError):
        settings = arguments.preferences, arguments.episodes
        comparison = Comparison(arguments.config, arguments.change, *settings)
        results = read_results(arguments.output, Result)
        for make_run in comparison.missing(results, arguments.seeds):
            results += make_run()
            write_results(arguments.output, results)
    changed = " ".join(arguments.change)
    Console().print(table([each for each in results if (each.config, each.changed) == (arguments.config, changed)]))


if __name__ == "__main__":
    main()
