"""Scores on the suite: of what a user names (runs, policies of the zoo, own functions and classes), and of a run."""

from __future__ import annotations

import functools
import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from algorithms.reporting.run_records import read_evaluation
from algorithms.runs.config import check_task
from mo_deepdrive import suite
from mo_deepdrive.evaluation.front import EVALUATION_FILE
from mo_deepdrive.evaluation.metrics import SUITE
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.suite import Row
from mo_deepdrive.suite.results import FAILED
from mo_deepdrive.support.atomic_io import write_json
from mo_deepdrive.support.importing import failure, first_of, import_file, import_named

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from algorithms.reporting.run_records import FinalEvaluation
    from algorithms.runs.config import Experiment
    from algorithms.runs.run_directory import Run
    from mo_deepdrive.evaluation.policy import Policy

CHOSEN_EPISODES = 20  # of the validation split, by which the policies of a front are chosen
OWN_NAMES = ("policy", "Policy")  # looked for in a file that is named without one


class Entry(NamedTuple):
    """A policy that is scored; its state, seed and seconds are those of its training."""

    source: str  # as the user names it
    learner: str
    make: Callable[[str], Any]  # gives the policy for a task, or raises ValueError
    seed: int = 0
    tasks: tuple[str, ...] = ()  # those that it is made for; none if that is not known
    state: str = "finished"
    cpu_seconds: float | None = None

    def policy(self, task_id: str) -> Any:
        """The policy for a task, which can drive there."""
        policy = self.make(task_id)
        try:
            suite.check_policy(policy, task_id)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{self.source!r} on {error}") from None
        return policy

    def score(self, policy: Any, task_id: str, **options: Any) -> list[Row]:
        """The rows of its policy for a task; the options are those of :func:`mo_deepdrive.suite.score`."""
        rows = suite.score(policy, task_id, learner=self.learner, seed=self.seed, **options)
        return [replace(row, source=self.source, state=self.state, cpu_seconds=self.cpu_seconds) for row in rows]


def is_own_code(source: str) -> bool:
    """Whether a source is a file or an object of the user's, which :func:`open_entry` imports and calls."""
    return source.endswith(".py") or ":" in source


def open_entry(source: str, *, trust: bool = False) -> Entry:
    """The entry that a user names, which may name code to run only with ``trust`` where it is a run.

    It is a run's directory or a policy of the zoo; a file ``policy.py`` or ``policy.py:name``; or
    ``package.module:name``: a policy as of :func:`mo_deepdrive.suite.score`, or a class that is made of a task's id.
    """
    if not is_own_code(source):
        return _of_run(source, trust=trust)
    path, _, name = source.partition(":")
    if path.endswith(".py"):
        if not Path(path).is_file():
            raise ValueError(f"policy file {path!r} does not exist")
        key = f"policy {source!r}"
        policy = first_of(key, import_file(key, Path(path)), *([name] if name else OWN_NAMES))
    else:
        policy = import_named("policy", source)

    def make(task_id: str) -> Any:
        if not isinstance(policy, type):
            return policy
        try:
            return policy(task_id)
        except (Exception, SystemExit) as error:  # a user's class may raise anything
            call = f"{policy.__name__}({task_id!r})"
            raise ValueError(f"policy {source!r}: {call} cannot be made: {failure(error)}") from error

    return Entry(source, Path(path).stem if name in ("", *OWN_NAMES) else name, make)


def _of_run(source: str, *, trust: bool) -> Entry:
    """The entry of a run or of a policy of the zoo."""
    from algorithms.runs.build import load_policy
    from algorithms.runs.run_directory import Run

    run = Run.open(source, trust=trust)
    experiment, status = run.experiment, run.status
    state = str(status.get("state", "finished"))
    load = functools.cache(lambda: load_policy(run, partners=False))

    def make(task_id: str) -> Any:
        check_experiment(experiment, task_id, source)
        if state == FAILED:
            raise ValueError(f"{source!r} failed in training: it has the lowest score, and no other")
        scored = experiment.evaluation.model_copy(update={"task": task_id})
        return scorable(load(), experiment.model_copy(update={"evaluation": scored}))

    environment, utility = experiment.environment, experiment.utility
    tasks = tuple(
        task_id
        for task_id, task in suite.load().tasks.items()
        if (utility and utility.name) == (task.utility and task.utility.name)
        and not task.differences(environment.id, environment.arguments)
    )
    name, seed = experiment.algorithm.name, experiment.training.seed
    return Entry(source, name, make, seed, tasks, state, status.get("cpu_seconds"))


def check_experiment(experiment: Experiment, task_id: str, source: str) -> None:
    """Refuse a run that cannot be an entry of a task, as far as its config says."""
    training = experiment.training
    try:
        task = check_task(experiment, task_id)
    except ValueError as error:
        raise ValueError(f"{source!r} cannot be an entry: {error}") from None
    if training.seed in SPLITS["test"]:
        raise ValueError(
            f"{source!r} was trained on the test split: training.seed = {training.seed:,} is a seed of it; choose one "
            f"outside of {SPLITS['test'].start:,} to {SPLITS['test'].stop - 1:,}"
        )
    trained = {name for names in training.partners.values() for name in names}
    if task.partners is not None and (met := sorted(trained & set(task.partners.names))):
        raise ValueError(f"{source!r} met partners of task {task_id} in training: {', '.join(met)}")


def rows_of(evaluation: FinalEvaluation, key: tuple[str, str, int], *shown: str, **about: Any) -> list[Row]:
    """The rows of a final evaluation, by task, learner and seed: scores on the suite and the metrics ``shown``."""
    version = evaluation.suite_version or 0
    return [
        Row(*key, policy, name.removeprefix(SUITE), score.value, score.low, score.high, version=version, **about)
        for policy, scores in evaluation.policies.items()
        for name, score in scores.items()
        if name.startswith(SUITE) or name in shown
    ]


def recorded_rows(entry: str, *, trust: bool = False) -> list[Row]:
    """The rows that an entry claims: of a CSV that ``suite score`` wrote, or of a run that was scored at its end."""
    path = Path(entry)
    if path.is_dir():
        from algorithms.runs.run_directory import Run

        experiment, evaluation = Run.open(path, trust=trust).experiment, read_evaluation(path)
        if evaluation is None:
            raise ValueError(f"{entry!r} has no final evaluation: there is no {EVALUATION_FILE}")
        key = str(experiment.evaluation.task), experiment.algorithm.name, experiment.training.seed
        rows = rows_of(evaluation, key, source=entry)
    else:
        rows = suite.read_rows(path)
        # A source that is beside the table is found from the working directory.
        rows = [
            replace(row, source=str(beside)) if row.source and (beside := path.parent / row.source).exists() else row
            for row in rows
        ]
    rows = [row for row in rows if row.value is not None]
    if not rows:
        raise ValueError(f"{entry!r} has no scores")
    claimed: dict[tuple[str, str], Row] = {}
    for row in rows:
        try:
            suite.check_of_suite(row)
        except ValueError as error:
            raise ValueError(f"{entry!r} has {error}") from None
        if not row.source:
            raise ValueError(f"{entry!r} does not say which run or policy was scored")
        first = claimed.setdefault((row.source, row.task), row)
        if (first.learner, first.seed) != (row.learner, row.seed):
            raise ValueError(
                f"{entry!r} has scores of {row.source!r} on {row.task} twice: of {first.learner}, seed {first.seed}, "
                f"and of {row.learner}, seed {row.seed}"
            )
    return rows


def fresh_seed(number: int, episodes: int) -> int:
    """The seed of the first of ``episodes`` fresh scenarios, which follow from a number; no split has them."""
    return 2**30 + int(np.random.default_rng(number).integers(2**30 - episodes))


def disagreement(recorded: Row, scored: Row | None, *, fresh: bool) -> str:
    """Why a recorded score does not hold beside the one that was scored now; empty if it does.

    On the same scenarios both must be equal, but for the last bits of another kind of processor, which may change a few
    episodes: by a twentieth of the interval's width. On ``fresh`` ones they are two samples, which differ by at most
    three standard errors of their difference; what has no interval has no standard error, and is not compared.
    """
    if scored is None or scored.value is None:
        return "the task has no such number"
    if recorded.seed != scored.seed and not is_own_code(recorded.source):  # a run says by which it was trained
        return f"its seed = {recorded.seed}, found {scored.seed}"
    claimed, error = (
        0.0 if row.low is None or row.high is None else (row.high - row.low) / 3.92 for row in (recorded, scored)
    )
    if fresh:
        # The recorded interval is taken for no wider than twice the one of now.
        allowed = 3.0 * math.hypot(min(claimed, 2.0 * error), error) if scored.low is not None else math.inf
    else:
        allowed = 0.05 * 3.92 * error
    for name in ("value",) if fresh else ("value", "low", "high"):
        before, now = getattr(recorded, name), getattr(scored, name)
        unequal = (before is None) != (now is None)
        if unequal or (now is not None and abs(before - now) > max(allowed, 1e-6 * max(1.0, abs(scored.value)))):
            return f"its {name} = {before}, found {now}"
    return ""


@dataclass(frozen=True)
class PreferenceFollower:
    """An agent that acts by the linear preference that it is told, as a scorer takes it."""

    agent: Any
    follows_changes: bool = True  # else it keeps the first preference of an episode
    samples: bool = True  # its actions can be sampled

    def for_preference(self, weights: NDArray[np.float64]) -> Policy:
        """The policy under weights (d,) of returns divided by the nominal scales of the objectives."""
        env = self.agent.env
        of_agent = (weights * self.agent.scales / env.objective_scales).tolist()
        condition = self.agent.preferences.condition("linear", dict(zip(env.objectives, of_agent, strict=True)))
        return self.agent.policy(condition)  # type: ignore[no-any-return]  # an agent of any class


def scorable(agent: Any, experiment: Experiment) -> Any:
    """What :func:`mo_deepdrive.suite.score` takes of a trained agent, on the task of the experiment's evaluation.

    Of a known utility that is the agent itself; else what follows the hidden preferences, if it can be told them, or
    the policies of its front on the validation split.
    """
    # Not earlier: a user's own policy is scored without torch.
    from algorithms.agent import FrontAgent
    from algorithms.runs.report import evaluate_front

    if not isinstance(agent, FrontAgent):
        return agent
    task = suite.load().task(str(experiment.evaluation.task))
    if task.preferences is not None and hasattr(agent, "preferences"):
        return PreferenceFollower(agent, experiment.evaluation.follow_changes)
    front = evaluate_front(agent, experiment, episodes=CHOSEN_EPISODES, seed=SPLITS["validation"].start)
    return [agent.policy(condition) for condition in front.conditions]


def score_run(run: Run, policy: Any) -> None:
    """Add the scores of a policy on a run's task to its final evaluation; on the test split with perturbations.

    The samples of the score of the test split are kept beside it.
    """
    settings, samples = run.experiment.evaluation, suite.Samples()
    path, perturbed = run.path / EVALUATION_FILE, settings.split == "test"
    values, task = json.loads(path.read_bytes()), str(settings.task)
    rows = suite.score(policy, task, first_episode=settings.final_seed, perturbed=perturbed, samples=samples)
    if perturbed:
        suite.write_samples(path, samples)
    for row in rows:
        scores = values["policies"].setdefault(row.policy, {})
        scores[SUITE + row.column] = {"value": row.value, "low": row.low, "high": row.high}
    write_json(path, {**values, "suite_version": suite.load().version})
