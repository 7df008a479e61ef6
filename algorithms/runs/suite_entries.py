"""Scores on the suite: of what a user names (runs, policies of the zoo, own functions and classes), and of a run."""

from __future__ import annotations

import importlib.util
import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from algorithms.reporting.run_records import read_evaluation
from mo_deepdrive import suite
from mo_deepdrive.evaluation.env_adapter import find_spec
from mo_deepdrive.evaluation.front import EVALUATION_FILE
from mo_deepdrive.evaluation.metrics import SUITE, split_name
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.suite.scoring import FAILED
from mo_deepdrive.support.atomic_io import write_json
from mo_deepdrive.support.importing import failure, import_named
from mo_deepdrive.support.names import nearest
from mo_deepdrive.world.config import parse_arguments

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from algorithms.runs.config import Experiment
    from algorithms.runs.run_directory import Run
    from mo_deepdrive.evaluation.policy import Policy
    from mo_deepdrive.suite import Row, Task

CHOSEN_EPISODES = 20  # of the validation split, by which the policies of a front are chosen
OWN_NAMES = ("policy", "Policy")  # looked for in a file that is named without one


@dataclass(frozen=True)
class Entry:
    """A policy that is scored.

    Attributes:
        source: as the user names it.
        learner: label of its rows.
        seed: by which it was trained.
        tasks: those that it is made for; none if that is not known.
        policy: gives the policy for a task, or raises ValueError.
        state: of its training.
        cpu_seconds: of its training; None if it is not known.
    """

    source: str
    learner: str
    seed: int
    tasks: tuple[str, ...]
    policy: Callable[[str], Any]
    state: str = "finished"
    cpu_seconds: float | None = None

    def score(self, policy: Any, task_id: str, **options: Any) -> list[Row]:
        """The rows of its policy for a task; the options are those of :func:`mo_deepdrive.suite.score`."""
        rows = suite.score(policy, task_id, learner=self.learner, seed=self.seed, **options)
        return [replace(row, source=self.source, state=self.state, cpu_seconds=self.cpu_seconds) for row in rows]


def is_own_code(source: str) -> bool:
    """Whether a source is a file or an object of the user's, which :func:`open_entry` imports and calls."""
    path, colon, _ = source.partition(":")
    return path.endswith(".py") or bool(colon)


def open_entry(source: str, *, trust: bool = False) -> Entry:
    """The entry that a user names.

    Args:
        source: a run's directory or a policy of the zoo; a file ``policy.py`` or ``policy.py:name``; or
            ``package.module:name``. The object is a policy as of :func:`mo_deepdrive.suite.score`, or a class that is
            made of a task's id and is one then.
        trust: as for :meth:`algorithms.runs.run_directory.Run.open`.
    """
    path, _, name = source.partition(":")
    if path.endswith(".py"):
        return _own(source, _of_file(source, Path(path), name))
    if name:
        return _own(source, import_named("policy", source))
    return _of_run(source, trust=trust)


def _own(source: str, policy: Any) -> Entry:
    path, _, name = source.partition(":")
    label = Path(path).stem if name in ("", *OWN_NAMES) else name

    def made(task_id: str) -> Any:
        if not isinstance(policy, type):
            return policy
        try:
            return policy(task_id)
        except (Exception, SystemExit) as error:  # a user's class may raise anything
            call = f"{policy.__name__}({task_id!r})"
            raise ValueError(f"policy {source!r}: {call} cannot be made: {failure(error)}") from error

    return Entry(source, label, 0, (), made)


def _of_file(source: str, path: Path, name: str) -> Any:
    """The object of a user's file."""
    if not path.is_file():
        raise ValueError(f"policy file {str(path)!r} does not exist")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # a user's module may raise anything
        raise ValueError(f"policy {source!r} cannot be imported: {failure(error)}") from error
    found = [each for each in ([name] if name else OWN_NAMES) if hasattr(module, each)]
    if not found:
        own = [each for each, value in vars(module).items() if getattr(value, "__module__", None) == path.stem]
        wanted = repr(name) if name else f"{OWN_NAMES[0]!r} or {OWN_NAMES[1]!r}"
        raise ValueError(f"policy {source!r}: the file has no {wanted}; {nearest(name or OWN_NAMES[0], own)}")
    return getattr(module, found[0])


def _of_run(source: str, *, trust: bool) -> Entry:
    """The entry of a run or of a policy of the zoo."""
    from algorithms.runs.build import load_policy
    from algorithms.runs.run_directory import Run

    run = Run.open(source, trust=trust)
    experiment, status = run.experiment, run.status
    agents: list[Any] = []

    def policy(task_id: str) -> Any:
        check_experiment(experiment, task_id, source)
        if status.get("state") == FAILED:
            raise ValueError(f"{source!r} failed in training: it has the lowest score, and no other")
        if not agents:
            agents.append(load_policy(run, partners=False))
        scored = experiment.evaluation.model_copy(update={"task": task_id})
        return scorable(agents[0], experiment.model_copy(update={"evaluation": scored}))

    return Entry(
        source,
        experiment.algorithm.name,
        experiment.training.seed,
        tuple(task_id for task_id, task in suite.load().tasks.items() if _is_of(experiment, task)),
        policy,
        str(status.get("state", "finished")),
        status.get("cpu_seconds"),
    )


def _is_of(experiment: Experiment, task: Task) -> bool:
    """Whether a run was trained for a task."""
    same_utility = experiment.utility == task.utility or (
        experiment.utility is not None and task.utility is not None and experiment.utility.name == task.utility.name
    )
    return same_utility and not _differences(experiment, task)


def _differences(experiment: Experiment, task: Task) -> list[str]:
    """How the environment of a run differs from that of a task."""
    environment = experiment.environment
    if environment.id != task.environment.id:
        return [f"environment.id = {environment.id!r} (not {task.environment.id!r})"]
    own = parse_arguments(find_spec(environment.id).kwargs["scenario"], environment.arguments)
    wanted = task.config()
    return [
        f"{name} = {getattr(own, name)!r} (not {getattr(wanted, name)!r})"
        for name in type(wanted).model_fields
        if getattr(own, name) != getattr(wanted, name)
    ]


def check_experiment(experiment: Experiment, task_id: str, source: str) -> None:
    """Refuse a run that cannot be an entry of a task, as far as its config says."""
    task, training = suite.load().task(task_id), experiment.training
    if differences := _differences(experiment, task):
        raise ValueError(f"{source!r} was not trained on task {task_id}: {', '.join(differences)}")
    if (steps := training.total_timesteps) > task.steps:
        raise ValueError(f"{source!r} trained for {steps:,} environment steps; task {task_id} allows {task.steps:,}")
    if training.seed in SPLITS["test"]:
        raise ValueError(
            f"{source!r} was trained on the test split: training.seed = {training.seed:,} is a seed of it; choose one "
            f"outside of {SPLITS['test'].start:,} to {SPLITS['test'].stop - 1:,}"
        )
    if task.partners is not None:
        trained = {name for names in training.partners.values() for name in names}
        if met := sorted(trained & set(task.partners.names)):
            raise ValueError(f"{source!r} met partners of task {task_id} in training: {', '.join(met)}")


def recorded_rows(entry: str, *, trust: bool = False) -> list[Row]:
    """The rows that an entry claims: of a table that ``suite score`` wrote, or of a run that was scored at its end.

    Args:
        entry: the CSV file, or the run's directory.
        trust: as for :meth:`algorithms.runs.run_directory.Run.open`.
    """
    path = Path(entry)
    rows = (
        _rows_of_run(path, trust=trust) if path.is_dir() else [_found_from(path, row) for row in suite.read_rows(path)]
    )
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


def _found_from(table: Path, row: Row) -> Row:
    """A row whose source, if it is beside the table, is found from the working directory."""
    beside = table.parent / row.source
    return replace(row, source=str(beside)) if row.source and beside.exists() else row


def _rows_of_run(path: Path, *, trust: bool) -> list[Row]:
    from algorithms.runs.run_directory import Run

    experiment, evaluation = Run.open(path, trust=trust).experiment, read_evaluation(path)
    if evaluation is None:
        raise ValueError(f"{str(path)!r} has no final evaluation: there is no {EVALUATION_FILE}")
    return [
        suite.Row(
            str(experiment.evaluation.task),
            experiment.algorithm.name,
            experiment.training.seed,
            name.policy,
            name.metric.removeprefix(SUITE),
            found.value,
            found.low,
            found.high,
            source=str(path),
            version=evaluation.suite_version or 0,
        )
        for name, found in ((split_name(key), found) for key, found in evaluation.scores.items())
        if name.metric.startswith(SUITE)
    ]


def fresh_seed(number: int, episodes: int) -> int:
    """The seed of the first of ``episodes`` fresh scenarios, which follow from a number; no split has them."""
    room = 2**30 - episodes
    return 2**30 + int(np.random.default_rng(number).integers(room))


def disagreement(recorded: Row, found: Row | None, *, fresh: bool) -> str:
    """Why a recorded score does not hold; empty if it does.

    Args:
        recorded: what the entry says.
        found: what the policy has now; None if the task has no such number.
        fresh: whether it was found on other scenarios. On the same ones both must be equal, but for the last bits of
            another kind of processor, which may change a few episodes: by a twentieth of the interval's width. On
            others they are two samples, which differ by at most three standard errors of their difference; what has no
            interval has no standard error, and is compared on the same ones alone.
    """
    if found is None or found.value is None:
        return "the task has no such number"
    assert recorded.value is not None
    if recorded.seed != found.seed and not is_own_code(recorded.source):  # a run says by which it was trained
        return f"its seed = {recorded.seed}, found {found.seed}"
    allowed = 1e-6 * max(1.0, abs(found.value))
    errors = [0.0 if row.low is None or row.high is None else (row.high - row.low) / 3.92 for row in (recorded, found)]
    if fresh and found.low is None:
        return ""
    if fresh:
        # The recorded interval is taken for no wider than twice the one that is found.
        return _beyond(
            recorded.value, found.value, allowed + 3.0 * math.hypot(min(errors[0], 2.0 * errors[1]), errors[1])
        )
    allowed = max(allowed, 0.05 * 3.92 * errors[1])
    for name in ("value", "low", "high"):
        one, other = getattr(recorded, name), getattr(found, name)
        if one is None and other is None:
            continue
        if one is None or other is None or _beyond(one, other, allowed):
            return f"its {name} = {one}, found {other}"
    return ""


def _beyond(recorded: float, found: float, allowed: float) -> str:
    return (
        "" if abs(recorded - found) <= allowed else f"differs by {abs(recorded - found):.4g}, more than {allowed:.4g}"
    )


@dataclass(frozen=True)
class PreferenceFollower:
    """A conditioned agent as a scorer takes it.

    Attributes:
        agent: told a linear preference, it acts by it.
        samples: whether its actions can be sampled.
    """

    agent: Any
    samples: bool = True

    def for_preference(self, weights: NDArray[np.float64]) -> Policy:
        """The policy under weights (d,) of returns divided by the nominal scales of the objectives."""
        env = self.agent.env
        own = weights * self.agent.scales / env.objective_scales
        condition = self.agent.preferences.condition("linear", dict(zip(env.objectives, own.tolist(), strict=True)))
        policy: Policy = self.agent.policy(condition)
        return policy


def scorable(agent: Any, experiment: Experiment) -> Any:
    """What :func:`mo_deepdrive.suite.score` takes of an agent.

    Args:
        agent: trained.
        experiment: that it was trained on, with the task that it is scored on.

    Returns:
        The agent itself for a known utility; what follows the hidden preferences, if it can be told them; else the
        policies of its front on the validation split.
    """
    # Not earlier: a user's own policy is scored without torch.
    from algorithms.agent import FrontAgent
    from algorithms.runs.report import evaluate_front

    if not isinstance(agent, FrontAgent):
        return agent
    task = suite.load().task(str(experiment.evaluation.task))
    if task.preferences is not None and hasattr(agent, "preferences"):
        return PreferenceFollower(agent)
    front = evaluate_front(agent, experiment, episodes=CHOSEN_EPISODES, seed=SPLITS["validation"].start)
    return [agent.policy(condition) for condition in front.conditions]


def score_run(run: Run, policy: Any) -> None:
    """Score a policy on the task of a run, and write the scores into its evaluation.json, as "greedy/suite/score".

    Perturbations are left out on the validation split, where settings are chosen.

    Args:
        run: with its final evaluation.
        policy: as of :func:`scorable`.
    """
    settings = run.experiment.evaluation
    rows = suite.score(
        policy, str(settings.task), first_episode=settings.final_seed, perturbed=settings.split == "test"
    )
    path = run.path / EVALUATION_FILE
    values = json.loads(path.read_bytes())
    for row in rows:
        found = values["policies"].setdefault(row.policy, {})
        found[SUITE + row.column] = {"value": row.value, "low": row.low, "high": row.high}
    write_json(path, {**values, "suite_version": suite.load().version})
