"""Methods for non-linear utilities on the same tasks, with the same steps and the same tuning for each.

    python scripts/esr_comparison.py --output esr_comparison.csv
    python scripts/esr_comparison.py --only one_waypoint_nonlinear --workers 2 --output esr_comparison.csv

PPO scalarises every decision; MO-PPO with ``utility_difference`` is between ESR and SER; MO-PPO with
``expected_utility`` and MOCAC optimise ESR, the former of episodes that its discount cuts short, unless gamma is 1.
Every method has the settings of the shipped YAML file of its task, or of the nearest one, but for the learning rate,
which is tuned (scripts/tuned_comparison.py). The scores are the expected utility of an episode (ESR) and the share of
arrivals, of 1,000 episodes with sampled actions.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import process_time
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import tuned_comparison
from result_file import check_least
from rich.console import Console
from rich.table import Table
from tuned_comparison import RATES, TUNING_SEED, Result, Run

from algorithms.experiments.build import build
from algorithms.experiments.cli import exit_on_error, make_parser
from algorithms.experiments.config import load_experiment, make_experiment
from algorithms.experiments.policy_evaluation import evaluate_policies
from algorithms.mocac import MOCACConfig
from mo_deepdrive.evaluation.metrics import STOCHASTIC, SUCCESS, UTILITY_ESR
from mo_deepdrive.evaluation.statistics import mean

if TYPE_CHECKING:
    from collections.abc import Sequence

    from algorithms.experiments.config import Experiment

FIRST_SEED, EPISODES = 20, 1000
PPO, DIFFERENCE, EXPECTED, MOCAC = "ppo", "utility_difference", "expected_utility", "mocac"
UNDISCOUNTED = f"{EXPECTED}, gamma 1"
METHODS = (PPO, DIFFERENCE, EXPECTED, UNDISCOUNTED, MOCAC)
# What MOCAC does not share with a task's MO-PPO, as in one_waypoint/mocac_comfort: it judges undiscounted returns.
MOCAC_SETTINGS: dict[str, Any] = {
    "name": "mocac", "gamma": 1.0, "observe_discount": False, "critic": "particles", "particles": 32
}  # fmt: skip


@dataclass(frozen=True)
class Task:
    """A utility.

    Attributes:
        ppo: shipped config whose settings PPO has.
        mo_ppo: shipped config whose settings MO-PPO has, and MOCAC where it has them too.
        steps: environment steps of a run.
    """

    ppo: str
    mo_ppo: str
    steps: int


TASKS = {
    "one_waypoint_comfort_budget": Task("one_waypoint/ppo_comfort", "one_waypoint/mo_ppo_comfort", 4_000_000),
    "one_waypoint_nonlinear": Task("one_waypoint/ppo_nonlinear", "one_waypoint/mo_ppo_nonlinear", 4_000_000),
    "static_obstacle_nonlinear": Task("static_obstacle/ppo_nonlinear", "static_obstacle/mo_ppo_nonlinear", 4_000_000),
    "left_turn_risk_averse": Task("left_turn/ppo_linear", "left_turn/mo_ppo_risk_averse", 10_000_000),
}


def make_run_experiment(run: Run) -> Experiment:
    """The experiment of a run; tuning is scored on the validation split."""
    task = TASKS[run.task]
    values = load_experiment(task.ppo if run.learner == PPO else task.mo_ppo, []).to_dict()
    settings = values["algorithm"]
    if run.learner == MOCAC:
        settings = {
            name: value for name, value in settings.items() if name in MOCACConfig.model_fields
        } | MOCAC_SETTINGS
    elif run.learner == UNDISCOUNTED:
        settings |= {"advantage": EXPECTED, "gamma": 1.0}
    elif run.learner != PPO:
        settings["advantage"] = run.learner
    settings["learning_rate"] *= run.rate
    values["algorithm"], values["utility"] = settings, {"name": run.task}
    values["training"] |= {"total_timesteps": run.steps, "seed": run.seed}
    values["evaluation"] = {"final_episodes": EPISODES}
    if run.seed == TUNING_SEED:
        values["evaluation"]["split"] = "validation"
    return make_experiment(values)


def learn(run: Run) -> Result:
    """Train and score a run in this process."""
    torch.set_num_threads(1)
    experiment = make_run_experiment(run)
    agent = build(experiment)
    started = process_time()
    agent.train(run.steps)
    seconds, settings = process_time() - started, experiment.evaluation
    found = evaluate_policies(agent, experiment, episodes=settings.final_episodes, seed=settings.final_seed)
    metrics = found[STOCHASTIC].metrics()
    rate = f"{run.rate:.3g}"
    first, second = metrics[UTILITY_ESR], metrics[SUCCESS]
    return Result(run.task, run.learner, rate, run.seed, run.steps, agent.step, first, second, seconds)


def table_rows(results: Sequence[Result]) -> list[list[str]]:
    """The table: one row per task and method, with means over the seeds that count and 95% intervals."""
    rows = []
    for task, steps in dict.fromkeys((result.task, result.steps) for result in results):
        for method in METHODS:
            of_method = [each for each in results if (each.task, each.learner, each.steps) == (task, method, steps)]
            mine = [result for result in of_method if result.seed != TUNING_SEED]
            if mine:
                utilities, arrivals = (np.array([getattr(each, name) for each in mine]) for name in ("first", "second"))
                each_seed = ", ".join(f"{utility:.2f}" for utility in utilities)
                cells = f"{mine[0].steps:,}", f"{float(np.mean([each.seconds for each in mine])):.0f}"
                shown = mean(utilities).text(), each_seed, f"{100.0 * arrivals.mean():.1f}"
                rows.append([task, method, mine[0].rate, str(len(mine)), *cells, *shown])
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = make_parser(__doc__)
    tuned_comparison.add_arguments(parser, list(TASKS))
    parser.add_argument("--steps", type=int, help="of every run, instead of the task's")
    arguments = parser.parse_args(argv)
    tuned_comparison.check_arguments(parser, arguments)
    check_least(parser, arguments, 1, "steps")
    learners = [(task, method, arguments.steps or TASKS[task].steps) for task in arguments.only for method in METHODS]
    seeds = range(FIRST_SEED, FIRST_SEED + arguments.seeds)
    with exit_on_error(ValueError, OSError):
        results = tuned_comparison.complete(arguments.output, learners, seeds, learn, arguments.workers)
    names = "task", "method", "rate", "seeds", "steps", "CPU seconds", "utility (ESR)", "each seed", "arrivals (%)"
    rates = ", ".join(f"{rate:.3g}" for rate in RATES)
    table = Table(*names, caption=f"mean [95% interval] over seeds; learning rates {rates} times the config's")
    for row in table_rows(results):
        table.add_row(*row)
    Console(width=160).print(table)


if __name__ == "__main__":
    main()
