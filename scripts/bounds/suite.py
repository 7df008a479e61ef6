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

import numpy as np
from rich.console import Console
from rich.progress import track

from algorithms.driving.roundabout_rules import ROUNDABOUTS
from algorithms.driving.unskilled import unskilled_policies
from algorithms.runs.build import load_policy
from algorithms.runs.cli import make_parser
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
from scripts.bounds.suite_bounds import (
    HORIZON,
    TRIED_IN_ROUNDABOUTS,
    ceiling,
    floor,
    plan_file,
    plan_task,
    roundabout_rules,
    with_spare_preferences,
    worth_driving,
    write_plans,
)
from scripts.result_file import check_folder, check_least

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterable, Mapping

    from mo_deepdrive.evaluation.evaluation import Evaluation
    from mo_deepdrive.suite import Task

FLOOR, RULE, LEARNER = "floor", "rule", "learner"
RANDOM, STILL = "acts at random", "stands still"
Driver = tuple[str, str, int | None, Any]  # name, kind, seed of a run, policy


def bounds(task: Task) -> list[Driver]:
    """The drivers that the bounds of a task are of.

    The floors are standing still, acting at random, holding one action and the blind drivers; of the last two kinds,
    and of the rules, there is the one that is best on the validation split.
    """
    unskilled = unskilled_policies(task.config())
    found: list[Driver] = [(name, FLOOR, None, unskilled[name]) for name in (STILL, RANDOM)]
    for prefix, start in (("", "holds "), ("blind, ", "goes ")):
        name, policy = _best({name: policy for name, policy in unskilled.items() if name.startswith(start)}, task)
        found.append((prefix + name, FLOOR, None, policy))
    name, policy = _best(roundabout_rules(), task)
    return [*found, (name, RULE, None, policy)]


def drives_in(run: Run, task: Task) -> bool:
    """Whether the run has trained in the environment of the task."""
    trained_in = run.experiment.environment
    same = trained_in.id == task.environment.id
    return same and task.model_copy(update={"environment": trained_in}).config() == task.config()


def learner(name: str, run: Run) -> Driver:
    """The driver that a run has trained."""
    return name, LEARNER, run.experiment.training.seed, load_policy(run)


def driver_rows(task_id: str, drivers: Iterable[Driver], episodes: int) -> list[dict[str, Any]]:
    """A row per driver, each of ``episodes`` episodes of the test split; see :func:`measures`."""
    task = suite.load().task(task_id)
    rows = []
    for name, kind, seed, policy in drivers:
        about = {"task": task_id, "driver": name, "kind": kind, "seed": seed, "episodes": episodes}
        rows.append({**about, **measures(drive(policy, task, episodes, "test"))})
    return rows


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
    """Means over the episodes and over the vehicles of what is driven, with the ends of their 95% intervals.

    "arrived" and "collided" are shares of the vehicles, "utility" is that of a vehicle, "worst_off" the least of them
    and "gini" the sum that counts the worse-off for more; then come the returns of the objectives.
    """
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
    worth = {
        name: measures(drive(policy, task, TRIED_IN_ROUNDABOUTS, "validation"))["utility"]
        for name, policy in candidates.items()
    }
    name = max(worth, key=lambda each: worth[each] or -np.inf)
    return name, candidates[name]


def parse_arguments(arguments: list[str] | None) -> argparse.Namespace:
    """The options of this script."""
    parser = make_parser(__doc__)
    parser.add_argument("what", choices=("plan", "floor", "ceiling", "drivers"))
    parser.add_argument("tasks", nargs="+", choices=suite.load().tasks, metavar="TASK")
    parser.add_argument("--scenarios", type=int, default=128, help="of the test split (default: %(default)s)")
    parser.add_argument("--generations", type=int, default=20, help="of a search (default: %(default)s)")
    parser.add_argument("--horizon", type=float, default=HORIZON, help="s of a planned drive (default: %(default)s)")
    parser.add_argument("--from", dest="start", metavar="TASK", help="start from the plans of another task")
    parser.add_argument("--runs", nargs="+", default=[], metavar="RUN", help="runs in the table of drivers")
    parser.add_argument("--label", metavar="NAME", help="what the runs are called in the table")
    parser.add_argument("--episodes", type=int, default=1000, metavar="N", help="per driver (default: %(default)s)")
    parser.add_argument("--output", type=Path, metavar="FILE", help="CSV file of the drivers")
    options = parser.parse_args(arguments)
    check_least(parser, options, 1, "scenarios", "generations", "horizon", "episodes")
    if options.what == "drivers":
        if options.output is None:
            parser.error("drivers needs --output FILE")
        if options.runs and not options.label:
            parser.error("--runs needs --label NAME")
        check_folder(parser, options.output)
        for task_id in options.tasks:
            if suite.load().task(task_id).config().scenario not in ROUNDABOUTS:
                parser.error(f"drivers is for tasks in the roundabout, not for {task_id}")
    return options


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
    write_plans(plan_file(task_id), task, texts)
    print(f"{task_id}: {values.mean():.4f} over {len(values)} scenarios", flush=True)


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def drivers(options: argparse.Namespace) -> None:
    """Write the rows of bounds, or of runs if some are given, in place of those that the file has of them."""
    tasks = suite.load()
    runs = [Run.open(path) for path in options.runs]
    for run in runs:
        if not any(drives_in(run, tasks.task(task_id)) for task_id in options.tasks):
            raise ValueError(f"--runs {run.path} drives in the environment of none of {', '.join(options.tasks)}")
    rows: list[dict[str, str]] = []
    if options.output.is_file():
        with options.output.open(encoding="utf-8", newline="") as stream:
            rows = list(csv.DictReader(stream))
    for task_id in options.tasks:
        task = tasks.task(task_id)
        there = [run for run in runs if drives_in(run, task)]
        chosen = [learner(options.label, run) for run in there] if runs else bounds(task)
        found = driver_rows(task_id, chosen, options.episodes)
        for row in found:
            print(f"{task_id}: {row['driver']}: arrived {row['arrived']:.3f}, utility {row['utility']:.4g}", flush=True)
        new = {options.label} if runs else {row["driver"] for row in rows if row["kind"] != LEARNER}
        rows = [row for row in rows if row["task"] != task_id or row["driver"] not in new]
        rows += [{name: _cell(value) for name, value in row.items()} for row in found]
    atomic_write(options.output, csv_bytes([list(rows[0]), *(list(row.values()) for row in rows)]))


def main(arguments: list[str] | None = None) -> int:
    """Run the command line ``arguments``; those of the process if None."""
    options = parse_arguments(arguments)
    if options.what == "drivers":
        try:
            drivers(options)
        except (ValueError, OSError) as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        return 0
    for task_id in options.tasks:
        if options.what == "plan":
            plan(task_id, options)
        else:
            found = (floor if options.what == "floor" else ceiling)(task_id)
            print(f"{task_id}: {options.what}: {{value: {found.value:.4g}, by: {found.by!r}}}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
