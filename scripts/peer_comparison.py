"""Other libraries' algorithms beside this package's on OneWaypoint: the same CPU time, the same tuning for each.

    python scripts/peer_comparison.py --minutes 10 --output peer_comparison.csv

A learner has its library's defaults but for the learning rate, which is tuned (scripts/tuned_comparison.py), and the
settings of TASKS; docs/peers.md explains them and the table. The number of environment steps is what takes the CPU time
on its machine. The learners of this package are also trained for the fewer steps that the others make in that time. The
extra ``[peers]`` brings the other libraries.
"""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass
from itertools import product
from time import process_time
from typing import TYPE_CHECKING, Any

import numpy as np
import paired_benchmark
import torch
import tuned_comparison
from rich.console import Console
from rich.table import Table
from tuned_comparison import TUNING_SEED, Result, Run

from algorithms.experiments.build import build
from algorithms.experiments.cli import exit_on_error, make_parser
from algorithms.experiments.config import make_experiment
from algorithms.experiments.policy_evaluation import evaluate_front, evaluate_policies
from algorithms.peers import PEERS
from algorithms.peers.running import evaluate_front as evaluate_peer_front
from algorithms.peers.running import prepare, seed_everything
from mo_deepdrive.evaluation.front import indicators
from mo_deepdrive.evaluation.metrics import EXPECTED_UTILITY, HYPERVOLUME, STOCHASTIC, SUCCESS, UTILITY_ESR
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.evaluation.statistics import mean

if TYPE_CHECKING:
    from collections.abc import Sequence

    from algorithms.experiments.config import Experiment

ENV_ID = "mo-deepdrive-one-waypoint-v0"
GAMMA = 0.99
FIRST_SEED, LEAST_MINUTES = 0, 0.001
DRAWN_EPISODES = 100  # per policy of a front, where destinations are drawn
UTILITY, UTILITY_EPISODES = "one_waypoint_linear", 1000
STEPS_PER_ENV = 2_000  # at least: whoever has few steps takes them in fewer environments


@dataclass(frozen=True)
class Learner:
    """An algorithm with its library's defaults.

    Attributes:
        learning_rate: the default one.
        speed: environment steps per CPU second.
        num_envs: in parallel, at most.
        settings: of the algorithm, which are not tuned.
    """

    learning_rate: float
    speed: int
    num_envs: int
    settings: dict[str, Any]


@dataclass(frozen=True)
class Task:
    """What is learnt.

    Attributes:
        arguments: of the environment.
        learners: by name.
        known_utility: whether the utility is known, or a front is to be found.
    """

    arguments: dict[str, Any]
    learners: dict[str, Learner]
    known_utility: bool = False

    @property
    def scores(self) -> tuple[str, str]:
        """The two scores of a run; the first one chooses the learning rate."""
        if self.known_utility:
            return UTILITY_ESR, SUCCESS
        return (
            (HYPERVOLUME, EXPECTED_UTILITY) if self.arguments.get("fixed_destination") else (EXPECTED_UTILITY, SUCCESS)
        )


# The defaults when the runs with discrete and with continuous actions were made.
NO_GROWTH, GROWTH = {"cost_growth": 0.0}, {"cost_growth": 0.15}
CONDITIONED = Learner(1e-3, 100_000, 256, {"max_policies": 500, **NO_GROWTH})
CONTINUOUS_CONDITIONED = Learner(1e-3, 160_000, 256, {"max_policies": 500, **GROWTH})
DRAWN_CONDITIONED = Learner(1e-3, 150_000, 256, {"max_policies": 100, **NO_GROWTH})
DRAWN_CONTINUOUS_CONDITIONED = Learner(1e-3, 150_000, 256, {"max_policies": 100, **GROWTH})
OUR_PCN = Learner(1e-3, 8_000, 16, {})
CONTINUOUS_PCN = Learner(1e-3, 16_000, 16, {})  # of runs that learn to drive, whose episodes are short
ENVELOPE = Learner(3e-4, 11, 1, {})
GPI_LS = Learner(3e-4, 42, 1, {"arguments": {"gradient_updates": 1}})
CAPQL = Learner(3e-4, 82, 1, {})
THEIR_PCN = Learner(1e-3, 1_300, 1, {})
FIXED, CONTINUOUS = {"fixed_destination": True}, {"action_type": "continuous"}
TASKS = {
    "known utility": Task(
        {},
        {
            "ppo": Learner(1e-3, 120_000, 256, {}),
            "mo_ppo": Learner(1e-3, 120_000, 256, {}),
            "stable_baselines3.ppo": Learner(3e-4, 1_400, 8, {}),
            "morl_baselines.nl_mo_ppo": Learner(2.5e-4, 4_500, 8, {}),
        },
        known_utility=True,
    ),
    "fixed, discrete": Task(
        FIXED,
        {
            "conditioned_mo_ppo": CONDITIONED,
            "pcn": OUR_PCN,
            "morl_baselines.pcn": THEIR_PCN,
            "morl_baselines.envelope": ENVELOPE,
        },
    ),
    "fixed, continuous": Task(
        FIXED | CONTINUOUS,
        {
            "conditioned_mo_ppo": CONTINUOUS_CONDITIONED,
            "pcn": CONTINUOUS_PCN,
            "morl_baselines.capql": CAPQL,
            "morl_baselines.gpi_ls_continuous": GPI_LS,
        },
    ),
    "drawn, discrete": Task({}, {"conditioned_mo_ppo": DRAWN_CONDITIONED, "morl_baselines.envelope": ENVELOPE}),
    "drawn, continuous": Task(
        CONTINUOUS,
        {
            "conditioned_mo_ppo": DRAWN_CONTINUOUS_CONDITIONED,
            "morl_baselines.capql": CAPQL,
            "morl_baselines.gpi_ls_continuous": GPI_LS,
        },
    ),
}


def make_run_experiment(run: Run) -> Experiment:
    """The experiment of a run; tuning is scored on the validation split."""
    task = TASKS[run.task]
    learner = task.learners[run.learner]
    rate = {"learning_rate": learner.learning_rate * run.rate}
    settings = dict(learner.settings)
    if run.learner in PEERS:
        settings["arguments"] = {**settings.get("arguments", {}), **rate}
    else:
        settings |= rate
    num_envs = min(learner.num_envs, max(1, run.steps // STEPS_PER_ENV))
    fixed = task.arguments.get("fixed_destination")
    episodes = UTILITY_EPISODES if task.known_utility else 1 if fixed else DRAWN_EPISODES
    values: dict[str, Any] = {
        "environment": {"id": ENV_ID, "arguments": task.arguments},
        "algorithm": {"name": run.learner, "gamma": GAMMA, **settings},
        "training": {"total_timesteps": run.steps, "num_envs": num_envs, "seed": run.seed},
        "evaluation": {"final_episodes": episodes, "gamma": GAMMA},
    }
    if run.seed == TUNING_SEED:
        values["evaluation"]["split"] = "validation"
    if task.known_utility:
        values["utility"] = {"name": UTILITY}
    return make_experiment(values)


def learn(run: Run) -> Result:
    """Train and score a run in this process."""
    torch.set_num_threads(1)
    seed_everything(run.seed)  # the other libraries draw from the global generators
    experiment = make_run_experiment(run)
    task, settings = TASKS[run.task], experiment.evaluation
    episodes = {"episodes": settings.final_episodes, "seed": settings.final_seed}
    started = process_time()
    trained: Any
    if run.learner in PEERS:
        peer_task = prepare(experiment, lambda _step, _metrics: None)
        with contextlib.redirect_stdout(io.StringIO()):  # the other libraries print
            policies = PEERS[run.learner].adapter(peer_task)
        seconds, taken = process_time() - started, peer_task.recorder.steps
        scales = peer_task.env.objective_scales
        trained = policies.at(np.zeros(1, dtype=np.intp)) if task.known_utility else policies
    else:
        trained = build(experiment)
        trained.train(run.steps)
        seconds, taken = process_time() - started, trained.step
        scales = trained.env.objective_scales
    if task.known_utility:
        found = evaluate_policies(trained, experiment, **episodes)[STOCHASTIC].metrics()
    else:
        peer = run.learner in PEERS
        front = evaluate_peer_front(trained, experiment) if peer else evaluate_front(trained, experiment, **episodes)
        found = indicators(front.discounted, reference_point=settings.reference_point, scales=scales)
        found[SUCCESS] = float(front.success.mean())
    first, second = (found[name] for name in task.scores)
    return Result(run.task, run.learner, f"{run.rate:.3g}", run.seed, run.steps, taken, first, second, seconds)


def steps_of(task: str, learner: str, minutes: float) -> int:
    """Environment steps that take so many CPU minutes."""
    return round(TASKS[task].learners[learner].speed * 60.0 * minutes)


def all_learners(tasks: Sequence[str], minutes: float) -> list[tuple[str, str, int]]:
    """Triples of task, learner and steps: for so many CPU minutes; ours also for the steps that the others make."""
    same_time = [
        (task, learner, steps_of(task, learner, minutes)) for task in tasks for learner in TASKS[task].learners
    ]
    same_steps = [
        (task, learner, steps)
        for task, other, steps in same_time
        if other in PEERS
        for learner in TASKS[task].learners
        if learner not in PEERS
    ]
    return same_time + same_steps


def table_rows(results: Sequence[Result]) -> list[list[str]]:
    """The table: means over the seeds that count with 95% intervals, one row per task and learner."""
    rows = []
    for task, chosen in TASKS.items():
        for learner, steps in product(chosen.learners, sorted({result.steps for result in results})):
            mine = [
                r for r in results if (r.task, r.learner, r.steps) == (task, learner, steps) and r.seed != TUNING_SEED
            ]
            if mine:
                scores = [mean(np.array([getattr(r, name) for r in mine])).text() for name in ("first", "second")]
                named = [f"{name} {text}" for name, text in zip(chosen.scores, scores, strict=True)]
                seconds = f"{np.mean([r.seconds for r in mine]):.0f}"
                rows.append([task, learner, mine[0].rate, str(len(mine)), f"{mine[0].taken:,}", seconds, *named])
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = make_parser(__doc__)
    parser.add_argument("--minutes", type=float, default=10.0, help="CPU minutes of a run (default: %(default)s)")
    tuned_comparison.add_arguments(parser, list(TASKS))
    arguments = parser.parse_args(argv)
    tuned_comparison.check_arguments(parser, arguments)
    if arguments.minutes < LEAST_MINUTES:
        parser.error(f"--minutes {arguments.minutes} must be at least {LEAST_MINUTES}")
    for learner in dict.fromkeys(name for task in arguments.only for name in TASKS[task].learners):
        reason = PEERS[learner].unavailable_reason() if learner in PEERS else None
        if reason is not None:
            parser.error(f"{learner} cannot run here: {reason}")
    learners = all_learners(arguments.only, arguments.minutes)
    seeds = range(FIRST_SEED, FIRST_SEED + arguments.seeds)
    with exit_on_error(ValueError, OSError):
        results = tuned_comparison.complete(arguments.output, learners, seeds, learn, arguments.workers)
    splits = f"tuned on seed {TUNING_SEED} of {SPLITS['validation'].start:,} and up"
    caption = f"mean [95% interval] over seeds; {splits}; {paired_benchmark.machine()}, one thread"
    table = Table("task", "learner", "rate", "seeds", "steps", "CPU seconds", "score", "and", caption=caption)
    for row in table_rows(results):
        table.add_row(*row)
    Console(width=160).print(table)


if __name__ == "__main__":
    main()
