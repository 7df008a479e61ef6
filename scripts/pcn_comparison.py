"""PCN beside morl-baselines' PCN on environments of MO-Gymnasium, both with their defaults.

    python scripts/pcn_comparison.py --output pcn_comparison.csv

Both learn for the same number of environment steps; nothing is tuned for an environment. Every run is a new process on
one thread, and the learners take turns. The front that counts is that of greedy policies in new episodes. The extra
``[peers]`` brings the other library; docs/peers.md explains the table.
"""

from __future__ import annotations

import multiprocessing
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import paired_benchmark
import torch
from result_file import check_folder, check_least, read_results, write_results
from rich.console import Console
from rich.progress import track
from rich.table import Table

from algorithms.experiments.build import build
from algorithms.experiments.cli import exit_on_error, make_parser
from algorithms.experiments.config import make_experiment
from algorithms.experiments.policy_evaluation import evaluate_front
from algorithms.peers import PEERS
from algorithms.peers.running import evaluate_front as evaluate_peer_front
from algorithms.peers.running import prepare, seed_everything
from mo_deepdrive.evaluation.pareto import hypervolume
from mo_deepdrive.evaluation.statistics import mean

if TYPE_CHECKING:
    from collections.abc import Sequence

    from algorithms.experiments.config import Experiment
    from mo_deepdrive.evaluation.front import Front

OURS, THEIRS = "pcn", "morl_baselines.pcn"
LEARNERS = (OURS, THEIRS)
NUM_ENVS = 16  # of ours; the other library's has one
GAMMA = 0.99
EPISODES = 10  # per policy
FIRST_SEED = 10


@dataclass(frozen=True)
class Problem:
    """Where the learners compete.

    Attributes:
        steps: of training.
        reference_point: of the hypervolume.
        optimum: number of policies on the known front; None where it is not known.
    """

    steps: int
    reference_point: tuple[float, ...]
    optimum: int | None = None


PROBLEMS = {
    "fruit-tree-v0": Problem(20_000, (0.0,) * 6, 64),
    "four-room-v0": Problem(60_000, (0.0,) * 3),
    "deep-sea-treasure-v0": Problem(10_000, (0.0, -25.0), 10),
    "deep-sea-treasure-concave-v0": Problem(10_000, (0.0, -25.0), 10),
    "deep-sea-treasure-mirrored-v0": Problem(10_000, (0.0, -25.0), 10),
    "resource-gathering-v0": Problem(10_000, (-1.0,) * 3),
    "minecart-deterministic-v0": Problem(30_000, (-1.0, -1.0, -200.0)),
}


@dataclass(frozen=True)
class Result:
    """One run.

    Attributes:
        environment: a key of :data:`PROBLEMS`.
        learner: one of :data:`LEARNERS`.
        seed: of the run.
        steps: environment steps that were asked for.
        taken: environment steps that were taken.
        hypervolume: of the front of greedy policies.
        policies: their number.
        seconds: CPU time of the training.
        commit: of the code.
    """

    environment: str
    learner: str
    seed: int
    steps: int
    taken: int
    hypervolume: Annotated[float, ".6g"]
    policies: int
    seconds: Annotated[float, ".1f"]
    commit: str

    @property
    def run(self) -> tuple[str, str, int, int]:
        """The arguments of :func:`learn`."""
        return self.environment, self.learner, self.seed, self.steps


def make_run(env_id: str, learner: str, seed: int, steps: int) -> Experiment:
    """The run of a learner with its defaults; the other library's PCN sees observations as they are."""
    algorithm: dict[str, Any] = {"name": learner, "gamma": GAMMA}
    if learner in PEERS:
        algorithm["nominal_scales"] = False
    return make_experiment(
        {
            "environment": {"id": env_id},
            "algorithm": algorithm,
            "training": {
                "total_timesteps": steps,
                "num_envs": 1 if learner in PEERS else NUM_ENVS,
                "seed": seed,
            },
            "evaluation": {
                "final_episodes": EPISODES,
                "gamma": GAMMA,
                "reference_point": list(PROBLEMS[env_id].reference_point),
            },
        }
    )


def learn(env_id: str, learner: str, seed: int, steps: int) -> Result:
    """Train a learner in this process and evaluate its front."""
    torch.set_num_threads(1)
    seed_everything(seed)  # the other library draws from the global generators, and so does four-room-v0
    experiment = make_run(env_id, learner, seed, steps)
    started = process_time()
    front: Front
    if learner in PEERS:
        task = prepare(experiment, lambda _step, _metrics: None)
        policies = PEERS[learner].adapter(task)
        seconds, taken = process_time() - started, task.recorder.steps
        front = evaluate_peer_front(policies, experiment)
    else:
        agent = build(experiment)
        agent.train(steps)
        seconds, taken = process_time() - started, agent.step
        front = evaluate_front(agent, experiment, episodes=EPISODES, seed=experiment.evaluation.final_seed)
    point = np.array(PROBLEMS[env_id].reference_point)
    beyond = bool((front.discounted > point).all(axis=1).any())
    volume = hypervolume(front.discounted, point) if beyond else 0.0
    commit = paired_benchmark.working_tree()
    return Result(env_id, learner, seed, steps, taken, volume, len(front.discounted), seconds, commit)


def learn_in_new_process(arguments: tuple[str, str, int, int]) -> Result:
    """:func:`learn` in a process of its own with one thread."""
    with paired_benchmark.one_thread_each(), multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(learn, arguments)


def rows(results: Sequence[Result]) -> list[list[str]]:
    """The table: means over the seeds with 95% intervals, one row per environment, number of steps and learner."""
    table = []
    for env_id, steps, learner in product(PROBLEMS, sorted({each.steps for each in results}), LEARNERS):
        mine = [each for each in results if (each.environment, each.steps, each.learner) == (env_id, steps, learner)]
        if not mine:
            continue
        volumes, policies, seconds = (
            mean(np.array([getattr(each, name) for each in mine], dtype=np.float64))
            for name in ("hypervolume", "policies", "seconds")
        )
        optimum = PROBLEMS[env_id].optimum
        known = "" if optimum is None else f" of {optimum}"
        found = [volumes.text(), policies.text() + known, f"{seconds.value:.0f}"]
        table.append([env_id, f"{steps:,}", learner, str(len(mine)), *found])
    return table


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = make_parser(__doc__)
    parser.add_argument(
        "--seeds", type=int, default=5, help="runs of each learner per environment (default: %(default)s)"
    )
    parser.add_argument(
        "--only", nargs="+", choices=PROBLEMS, default=list(PROBLEMS), help="environments; default: all"
    )
    parser.add_argument("--learners", nargs="+", choices=LEARNERS, default=list(LEARNERS), help="default: both")
    parser.add_argument("--steps", type=int, help="of every run, instead of the environment's")
    parser.add_argument("--output", type=Path, help="CSV file of every run, continued if it exists")
    arguments = parser.parse_args(argv)
    check_least(parser, arguments, 1, "seeds", "steps")
    check_folder(parser, arguments.output)
    for name in arguments.learners:
        reason = PEERS[name].unavailable_reason() if name in PEERS else None
        if reason is not None:
            parser.error(f"{name} cannot run here: {reason}")
    runs = [
        (env_id, learner, FIRST_SEED + seed, arguments.steps or PROBLEMS[env_id].steps)
        for env_id, seed, learner in product(arguments.only, range(arguments.seeds), arguments.learners)
    ]
    with exit_on_error(ValueError, OSError):
        results = read_results(arguments.output, Result)
        done = {result.run for result in results}
        for run in track([run for run in runs if run not in done]):
            results.append(learn_in_new_process(run))
            write_results(arguments.output, results)
    caption = f"{arguments.seeds} seeds: mean [95% interval]; {paired_benchmark.machine()}, one thread"
    table = Table("environment", "steps", "learner", "seeds", "hypervolume", "policies", "CPU seconds", caption=caption)
    for row in rows(results):
        table.add_row(*row)
    Console().print(table)


if __name__ == "__main__":
    main()
