"""The floors and ceilings of the suite, computed anew.

python scripts/bounds/suite.py plan K1 --scenarios 128           # search for drives, and write them into the package
python scripts/bounds/suite.py floor K1 K3
python scripts/bounds/suite.py ceiling K1 K5
python scripts/bounds/suite.py drivers R1 R2 --output docs/results/roundabout.csv
python scripts/bounds/suite.py drivers R1 --runs runs/* --label MO-PPO --output docs/results/roundabout.csv

What is printed belongs into mo_deepdrive/data/suite.yaml. ``drivers``, of the roundabouts alone, writes what those
achieve that bounds are of, or runs in the environment of the task, a row per seed; rows of others stay in the file.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import track

from algorithms.driving.roundabout_rules import ROUNDABOUTS
from algorithms.driving.unskilled import unskilled_policies
from algorithms.runs import cli
from algorithms.runs.build import load_policy
from algorithms.runs.run_directory import Run
from mo_deepdrive import suite
from mo_deepdrive.evaluation.episodes import evaluate
from mo_deepdrive.evaluation.metrics import (
    GINI_UTILITY_ESR,
    MEAN_UTILITY_ESR,
    SHARE_ARRIVED,
    SHARE_COLLIDED,
    WORST_OFF_UTILITY_ESR,
)
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.evaluation.statistics import mean
from mo_deepdrive.support.atomic_io import atomic_write, csv_bytes
from scripts.bounds.rule_search import BLIND, SEEING
from scripts.bounds.suite_bounds import (
    HORIZON,
    TRIED,
    ceiling,
    floor,
    plan_task,
    searched,
    with_spare_preferences,
    worth_driving,
    write_plans,
)

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

    from mo_deepdrive.evaluation.evaluation import Evaluation
    from mo_deepdrive.suite import Task

FLOOR, RULE, LEARNER = "floor", "rule", "learner"
RANDOM, STILL = "acts at random", "stands still"
Driver = tuple[str, str, int | None, Any]  # name, kind, seed of a run, policy


def bounds(task: Task) -> list[Driver]:
    """The drivers that bounds are of: without skill and by rules, of each kind the best on the validation split."""
    unskilled, scenario = unskilled_policies(task.config()), task.config().scenario
    held = _best({name: policy for name, policy in unskilled.items() if name.startswith("holds ")}, task)
    floors = [*((name, unskilled[name]) for name in (STILL, RANDOM)), held, searched(BLIND[scenario], task)]
    found: list[Driver] = [(name, FLOOR, None, policy) for name, policy in floors]
    name, policy = searched(SEEING[scenario], task)
    return [*found, (name, RULE, None, policy)]


def drives_in(run: Run, task: Task) -> bool:
    """Whether the run has trained in the environment of the task."""
    trained_in = run.experiment.environment
    same = trained_in.id == task.environment.id
    return same and task.model_copy(update={"environment": trained_in}).config() == task.config()


def drive(policy: Any, task: Task, episodes: int, split: Any) -> Evaluation:
    """Episodes of a policy in the environment of a task; of agents those of the kind of policy that the task ranks."""
    learnt = hasattr(policy, "env")
    return evaluate(
        policy,
        task.environment.id,
        split=split,
        episodes=episodes,
        utility=task.make_utility(),
        env_kwargs=task.environment.arguments,
        greedy=not learnt or task.policy == "greedy",
    )


def measures(found: Evaluation) -> dict[str, float | None]:
    """Means over episodes and vehicles, with the ends of their 95% intervals; last the returns of the objectives."""
    team = found.team_samples()
    samples: Mapping[str, Any] = {
        "arrived": team[SHARE_ARRIVED],
        "collided": team[SHARE_COLLIDED],
        "utility": team[MEAN_UTILITY_ESR],
        "worst_off": team[WORST_OFF_UTILITY_ESR],
        "gini": team[GINI_UTILITY_ESR],
        **{name: found.returns[:, :, i].mean(axis=1) for i, name in enumerate(found.objectives)},
    }
    values: dict[str, float | None] = {}
    for name, each in samples.items():
        estimate = mean(each)
        values |= {name: estimate.value, f"{name}/low": estimate.low, f"{name}/high": estimate.high}
    return values


def _best(candidates: Mapping[str, Any], task: Task) -> tuple[str, Any]:
    """The candidate whose vehicles have the highest mean utility on the validation split."""

    def worth(name: str) -> float:
        driven = drive(candidates[name], task, TRIED, "validation")
        return float(driven.team_samples()[MEAN_UTILITY_ESR].mean())

    name = max(candidates, key=worth)
    return name, candidates[name]


def plan(task_id: str, options: argparse.Namespace) -> None:
    """Search for the drives of a task, and write them."""
    task = suite.load().task(task_id)
    progress = track(SPLITS["test"][: options.scenarios], "planning", console=Console(stderr=True))
    drawn = with_spare_preferences(task)
    texts, values = plan_task(drawn, progress, options.generations, options.horizon, options.start)
    if task.preferences is not None:
        kept, left_out = worth_driving(task, values.mean(axis=0))
        texts, values = [[each[k] for k in kept.tolist()] for each in texts], values[:, kept]
        print(f"preferences.left_out: {left_out}")
    write_plans(task_id, task, texts)
    print(f"{task_id}: {values.mean():.4f} over {len(values)} scenarios", flush=True)


def drivers(options: argparse.Namespace) -> None:
    """Write the rows of bounds, or of runs if some are given, in place of those that the file has of them."""
    if options.output is None:
        raise ValueError("drivers needs --output FILE")
    if options.runs and not options.label:
        raise ValueError("--runs needs --label NAME")
    cli.check_file("--output", options.output)
    tasks = {task_id: suite.load().task(task_id) for task_id in options.tasks}
    for task_id, task in tasks.items():
        if task.config().scenario not in ROUNDABOUTS:
            raise ValueError(f"drivers is for tasks in the roundabout, not for {task_id}")
    runs = [Run.open(path) for path in options.runs]
    for run in runs:
        if not any(drives_in(run, task) for task in tasks.values()):
            raise ValueError(f"--runs {run.path} drives in the environment of none of {', '.join(tasks)}")
    rows: list[dict[str, Any]] = []
    if options.output.is_file():
        with options.output.open(encoding="utf-8", newline="") as stream:
            rows = list(csv.DictReader(stream))
    for task_id, task in tasks.items():
        learnt = [(run.experiment.training.seed, load_policy(run)) for run in runs if drives_in(run, task)]
        trained: list[Driver] = [(options.label, LEARNER, seed, policy) for seed, policy in learnt]
        driven: list[dict[str, Any]] = []
        for name, kind, seed, policy in trained if runs else bounds(task):
            about = {"task": task_id, "driver": name, "kind": kind, "seed": seed, "episodes": options.episodes}
            row = {**about, **measures(drive(policy, task, options.episodes, "test"))}
            driven.append(row)
            print(f"{task_id}: {row['driver']}: arrived {row['arrived']:.3f}, utility {row['utility']:.4g}", flush=True)
        new = {options.label} if runs else {row["driver"] for row in rows if row["kind"] != LEARNER}
        rows = [row for row in rows if row["task"] != task_id or row["driver"] not in new]
        for row in driven:
            rows.append({name: f"{cell:.5g}" if isinstance(cell, float) else cell for name, cell in row.items()})
    atomic_write(options.output, csv_bytes([list(rows[0]), *(list(row.values()) for row in rows)]))


def compute(options: argparse.Namespace) -> int:
    """Do what is asked for, for every task."""
    cli.check_at_least(options, 1, "scenarios", "generations", "horizon", "episodes")
    if options.what == "drivers":
        drivers(options)
        return 0
    for task_id in options.tasks:
        if options.what == "plan":
            plan(task_id, options)
        else:
            found = (floor if options.what == "floor" else ceiling)(task_id)
            print(f"{task_id}: {options.what}: {{value: {found.value:.4g}, by: {found.by!r}}}", flush=True)
    return 0


OPTIONS = (
    cli.option("what", None, "", choices=("plan", "floor", "ceiling", "drivers")),
    cli.option("tasks", "TASK", "", nargs="+", choices=suite.load().tasks),
    cli.option("--scenarios", "N", "of the test split (default: %(default)s)", type=int, default=128),
    cli.option("--generations", "N", "of a search (default: %(default)s)", type=int, default=20),
    cli.option("--horizon", "S", "s of a planned drive (default: %(default)s)", type=float, default=HORIZON),
    cli.option("--from", "TASK", "start from the plans of another task", dest="start"),
    cli.option("--runs", "RUN", "runs in the table of drivers", nargs="+", default=[]),
    cli.option("--label", "NAME", "what the runs are called in the table"),
    cli.option("--episodes", "N", "per driver (default: %(default)s)", type=int, default=1000),
    cli.option("--output", "FILE", "CSV file of the drivers", type=Path),
)
main = cli.Command("", __doc__, OPTIONS, compute)

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
