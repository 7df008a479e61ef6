"""Scores of policies on the tasks of the suite, as rows of one tidy table."""

from __future__ import annotations

import csv
import math
from dataclasses import MISSING, astuple, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from mo_deepdrive.evaluation.env_adapter import EnvAdapter
from mo_deepdrive.evaluation.episodes import as_policy
from mo_deepdrive.evaluation.metrics import FRONT, GREEDY, POLICIES, STOCHASTIC
from mo_deepdrive.evaluation.policy import AccruedReward, FunctionPolicy
from mo_deepdrive.evaluation.splits import SPLITS, first_seed
from mo_deepdrive.evaluation.statistics import Estimate, resample
from mo_deepdrive.suite.scorers import (
    CONTROLLABILITY,
    CVAR,
    SCORE,
    SCORERS,
    WORST,
    Scorer,
    open_drives,
    policies_of,
    single,
)
from mo_deepdrive.suite.tasks import load
from mo_deepdrive.support.atomic_io import atomic_write, csv_bytes
from mo_deepdrive.support.importing import failure
from mo_deepdrive.support.names import nearest

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from mo_deepdrive.suite.scorers import Drives
    from mo_deepdrive.suite.tasks import Task

FAILED = "failed"  # the state of a run that has the lowest score


@dataclass(frozen=True)
class Row:
    """One number of a scored run; a run that has none, since it failed or has not ended, has one row that says so.

    Attributes:
        task: the id of the task.
        learner: what was trained.
        seed: by which it was trained.
        policy: "greedy", "stochastic" or "front"; "" without a value.
        column: "score", a perturbation of the suite, or what a scorer gives beside the score; "" without a value.
        value: the number, not normalised; None where there is none.
        low, high: ends of its 95% bootstrap interval over the scenarios; None where it has none.
        source: the run or policy that was scored.
        state: of the training.
        cpu_seconds: of the training; None where it is not known.
        version: of the suite.
        steps: environment steps of the training; None where they are not known.
        environment: in which it was trained: its id, and arguments that are not the default.
    """

    task: str
    learner: str
    seed: int
    policy: str
    column: str
    value: float | None
    low: float | None = None
    high: float | None = None
    source: str = ""
    state: str = "finished"
    cpu_seconds: float | None = None
    version: int = 0
    steps: int | None = None
    environment: str = ""

    @property
    def key(self) -> tuple[str, str, int, str, str]:
        """What there is one row of."""
        return self.task, self.learner, self.seed, self.policy, self.column

    @property
    def normalised(self) -> float | None:
        """With the floor as 0 and the ceiling as 1; None for what is not on the scale of the score."""
        suite = load()
        if self.value is None or (self.column != SCORE and self.column not in suite.perturbations):
            return None
        return float(suite.task(self.task).normalised(self.value))


_ROW = TypeAdapter(Row)


def score(
    policy: Any,
    task_id: str,
    *,
    learner: str = "policy",
    seed: int = 0,
    episodes: int | None = None,
    first_episode: int | None = None,
    perturbed: bool = True,
) -> list[Row]:
    """Score a policy on a task.

    Args:
        policy: an agent, or a function ``policy(observations, accrued, discounts) -> actions``, as
            :func:`mo_deepdrive.evaluation.evaluate` takes them; at the intersection it returns actions of both
            vehicles, of which those of the task's vehicle count. Where the utility is not known, also a list of them (a
            front, of which the best on the validation split is taken for each preference), a function of four
            arguments, the last of which are the weights (d,) of the preference, which sum to 1, of returns divided by
            the nominal scales of the objectives; or an object whose ``for_preference(weights)`` gives such a policy.
        task_id: of the task.
        learner: label of the rows.
        seed: by which the policy was trained, for the rows.
        episodes: E; the task's by default.
        first_episode: seed of the first episode; that of the test split by default.
        perturbed: also score it under the perturbations of the task.

    Returns:
        The rows: of the policy that is ranked (an agent's greedy or stochastic one, as the task declares) and, for
        agents, the score of the other one.

    Raises:
        TypeError: for what cannot be called as a policy.
        ValueError: for an unknown task, or a policy that does not drive in the task's environment.
    """
    suite = load()
    task = suite.task(task_id)
    check_policy(policy, task_id)
    episodes = task.episodes if episodes is None else episodes
    start = first_seed("test" if first_episode is None else None, first_episode, episodes)
    scorer = SCORERS[task.score]
    kinds = [task.policy, *({GREEDY, STOCHASTIC} - {task.policy} if _is_agent(policy) else ())]
    rows = []
    for kind in kinds:
        ranked = kind == task.policy
        settings: dict[str, dict[str, Any]] = {SCORE: {}}
        if ranked and perturbed:
            settings |= {name: suite.perturbations[name] for name in task.columns}
        for name, arguments in settings.items():
            with open_drives(task, arguments, start, episodes, greedy=kind == GREEDY) as drives:
                for column, number in _numbers(scorer, drives, policy, everything=name == SCORE and ranked):
                    place = task_id, learner, seed, kind, name if column == SCORE else column
                    rows.append(Row(*place, number.value, number.low, number.high, version=suite.version))
    return rows


def _numbers(scorer: Scorer, drives: Drives, policy: Any, *, everything: bool) -> Iterator[tuple[str, Estimate]]:
    """The columns of a scorer, or its score alone."""
    samples = scorer.collect(drives, policy)
    for column, number in scorer.numbers.items():
        if column == SCORE or everything:
            yield column, resample(samples, number(drives.task))
    if scorer.details is not None and everything:
        for column, value in scorer.details(drives.task, samples).items():
            yield column, Estimate(value)


def _members(policy: Any, task: Task) -> list[Any]:
    """Policies that stand for a policy: those of a front, or that under the first preference."""
    found = policies_of(policy)
    if isinstance(found, list):
        return found
    d = len(task.objectives())
    try:
        return [found(np.full(d, 1.0 / d))]
    except (Exception, SystemExit) as error:  # a user's object may raise anything
        raise ValueError(f"the policy failed for weights ({d},): {failure(error)}") from error


def _is_agent(policy: Any) -> bool:
    """Whether a policy can act greedily or by sampling, as it is asked to."""
    if hasattr(policy, "for_preference"):
        return bool(getattr(policy, "samples", False))
    first = policy[0] if isinstance(policy, (list, tuple)) and policy else policy
    return isinstance(getattr(first, "env", None), EnvAdapter)


def check_policy(policy: Any, task_id: str) -> None:
    """Refuse a policy that cannot drive in a task, by one decision in two scenarios.

    Raises:
        TypeError: for what cannot be called as a policy.
        ValueError: naming the task, for an agent of another one, a front where the utility is known, or actions of the
            wrong shape, type or range.
    """
    task = load().task(task_id)
    try:
        members = _members(policy, task)
        if not members:
            raise ValueError("the front has no policy")
        if task.utility is not None:
            single(policy)
        with open_drives(task, {}, SPLITS["validation"].start, 2, greedy=True) as drives:
            adapter = EnvAdapter(drives.env)
            actors = [as_policy(member, adapter) for member in members]  # before anything is compiled
            functions = [actor for actor in actors if isinstance(actor, FunctionPolicy)]
            if functions:
                observations = adapter.reset([drives.seed, drives.seed + 1])
            nothing = AccruedReward.begin(2, adapter.vehicles, len(adapter.objectives))
            for actor in functions:
                actor.act(observations, nothing, None)
    except (TypeError, ValueError) as error:
        raise type(error)(f"task {task_id}: {error}") from None


def write_rows(path: str | Path, rows: Sequence[Row]) -> None:
    """Write rows as CSV, a column for each attribute.

    Raises:
        OSError: if the file cannot be written; it is complete or unchanged.
    """
    names = [field.name for field in fields(Row)]
    body = [["" if value is None else value for value in astuple(row)] for row in rows]
    atomic_write(Path(path), csv_bytes([names, *body]))


def check_row(row: Row) -> None:
    """Refuse what no scored run has.

    Raises:
        ValueError: naming the attribute, its value and what is allowed.
    """
    if row.policy not in POLICIES and (row.policy or row.value is not None):
        raise ValueError(f"policy = {row.policy!r} must be {GREEDY!r}, {STOCHASTIC!r} or {FRONT!r}")
    for name in ("value", "low", "high", "cpu_seconds"):
        number = getattr(row, name)
        if number is not None and not math.isfinite(number):
            raise ValueError(f"{name} = {number} must be finite")
    if (row.low is None) != (row.high is None):
        raise ValueError(f"low = {row.low} and high = {row.high} must both be given, or neither")
    if row.value is None:
        if row.low is not None:
            raise ValueError(f"low = {row.low} without a value")
    elif row.state == FAILED:
        raise ValueError(f"value = {row.value} of a run that failed, which has none")
    elif row.low is not None and row.high is not None and not row.low <= row.value <= row.high:
        raise ValueError(f"value = {row.value} must be from low = {row.low} to high = {row.high}")


def check_of_suite(row: Row) -> None:
    """Refuse what is not of this version of the suite, or not one of its numbers.

    Raises:
        ValueError: naming the attribute, its value and what is allowed.
    """
    suite = load()
    if row.value is not None and row.version != suite.version:
        raise ValueError(f"version {row.version} of the suite; this is version {suite.version}")
    if row.task not in suite.tasks:
        raise ValueError(f"task = {row.task!r} is unknown; {nearest(row.task, list(suite.tasks))}")
    if row.steps is not None and row.steps > (limit := suite.task(row.task).steps):
        raise ValueError(f"steps = {row.steps:,}; task {row.task} allows {limit:,}")
    if row.value is not None and row.policy not in (GREEDY, STOCHASTIC):
        raise ValueError(f"policy = {row.policy!r} must be {GREEDY!r} or {STOCHASTIC!r}")
    known = [SCORE, CVAR, WORST, CONTROLLABILITY, *suite.perturbations]
    if row.value is not None and row.column.partition("/")[0] not in known:
        raise ValueError(f"column = {row.column!r} is unknown; {nearest(row.column, known)}")


def read_rows(path: str | Path) -> list[Row]:
    """The rows that :func:`write_rows` wrote, each of them valid, and each number there once.

    Raises:
        ValueError: if it is another file, or naming the line and what is wrong in it.
    """
    columns = {field.name: field.type == "str" for field in fields(Row)}  # by name, whether it is text
    required = {field.name for field in fields(Row) if field.default is MISSING}
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as file:  # spreadsheets begin with a BOM
            reader = csv.DictReader(file)
            names = {*(reader.fieldnames or ())}
            if not required <= names <= {*columns}:
                raise ValueError(f"its columns must be {', '.join(columns)}")
            rows: dict[tuple[Any, ...], Row] = {}
            for line in reader:
                if None in line or None in line.values():
                    raise ValueError(f"line {reader.line_num} must have {len(names)} cells")
                known = {name: text for name, text in line.items() if text or columns[name]}
                try:
                    row = _ROW.validate_python({"value": None, **known})
                    check_row(row)
                    if rows.setdefault(row.key, row) is not row:
                        raise ValueError(f"a second row of {', '.join(map(str, row.key))}")
                except ValidationError as error:
                    problem = error.errors(include_url=False)[0]
                    where = f"line {reader.line_num}: {problem['loc'][0]} = {line[problem['loc'][0]]!r}"
                    raise ValueError(f"{where}: {problem['msg']}") from None
                except ValueError as error:
                    raise ValueError(f"line {reader.line_num}: {error}") from None
            return list(rows.values())
    except FileNotFoundError:
        raise ValueError(f"{str(path)!r} does not exist") from None
    except UnicodeDecodeError:
        raise ValueError(f"{str(path)!r} is not a table of scores: it is not a text file") from None
    except (OSError, ValueError, csv.Error) as error:
        raise ValueError(f"{str(path)!r} is not a table of scores: {error}") from None
