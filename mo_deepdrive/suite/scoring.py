"""Scores of policies on the tasks of the suite, as rows of one tidy table."""

from __future__ import annotations

import csv
from dataclasses import MISSING, astuple, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pydantic

from mo_deepdrive.atomic_io import atomic_write, csv_bytes
from mo_deepdrive.evaluation.accrued_reward import AccruedReward
from mo_deepdrive.evaluation.env_adapter import EnvAdapter
from mo_deepdrive.evaluation.episodes import as_policy
from mo_deepdrive.evaluation.function_policy import FunctionPolicy, check_signature
from mo_deepdrive.evaluation.metrics import GREEDY, STOCHASTIC
from mo_deepdrive.evaluation.splits import SPLITS, first_seed
from mo_deepdrive.evaluation.statistics import Estimate, resample
from mo_deepdrive.importing import failure
from mo_deepdrive.names import nearest
from mo_deepdrive.suite.scorers import SCORE, SCORERS, WORST, Scorer, columns_of, make_drives, policies_of, single
from mo_deepdrive.suite.tasks import load

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from mo_deepdrive.suite.scorers import Drives
    from mo_deepdrive.suite.tasks import Task

FAILED = "failed"  # the state of a run that has the lowest score
ROUNDING = 1e-6  # relative and absolute: what processors and orders of summation change in a mean
SHOWN_FAULTS = 20


@dataclass(frozen=True)
class Row:
    """One number of a scored run; a run that has none, since it failed or has not ended, has one row that says so.

    Attributes:
        task: the id of the task.
        learner: what was trained.
        seed: by which it was trained.
        policy: "greedy" or "stochastic".
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

    __pydantic_config__ = pydantic.ConfigDict(allow_inf_nan=False)

    @property
    def normalised(self) -> float | None:
        """With the floor as 0 and the ceiling as 1; None for what is not on the scale of the score."""
        suite = load()
        if self.value is None or (self.column != SCORE and self.column not in suite.perturbations):
            return None
        return float(suite.task(self.task).normalised(self.value))


_ROW = pydantic.TypeAdapter(Row)


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
            drives = make_drives(task, arguments, start, episodes, greedy=kind == GREEDY)
            try:
                for column, found in _numbers(scorer, drives, policy, everything=name == SCORE and ranked):
                    shown, numbers = name if column == SCORE else column, (found.value, found.low, found.high)
                    rows.append(Row(task_id, learner, seed, kind, shown, *numbers, version=suite.version))
            finally:
                drives.env.close()
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
        raise ValueError(failure(error)) from error


def _is_agent(policy: Any) -> bool:
    """Whether a policy can act greedily or by sampling, as it is asked to."""
    if hasattr(policy, "for_preference"):
        return bool(getattr(policy, "samples", False))
    first = policy[0] if isinstance(policy, (list, tuple)) and policy else policy
    return isinstance(getattr(first, "env", None), EnvAdapter)


def check_form(policy: Any, task_id: str) -> list[Any]:
    """Refuse what has not the form of a policy for a task, before its environment is made, which may take minutes.

    Returns:
        The policies that it consists of, or that under the first preference.

    Raises:
        TypeError, ValueError: as :func:`check_policy`.
    """
    task = load().task(task_id)
    try:
        members = _members(policy, task)
        if not members:
            raise ValueError("the front has no policy")
        if task.utility is not None:
            single(policy)
        for member in members:
            if not isinstance(getattr(member, "env", None), EnvAdapter):
                check_signature(member)
    except (TypeError, ValueError) as error:
        raise type(error)(f"task {task_id}: {error}") from None
    return members


def check_policy(policy: Any, task_id: str) -> None:
    """Refuse a policy that cannot drive in a task, by one decision in two scenarios.

    Raises:
        TypeError: for what cannot be called as a policy.
        ValueError: naming the task, for an agent of another one, a front where the utility is known, or actions of the
            wrong shape, type or range.
    """
    members = check_form(policy, task_id)
    drives = make_drives(load().task(task_id), {}, SPLITS["validation"].start, 2, greedy=True)
    try:
        adapter = EnvAdapter(drives.env)
        observations = adapter.reset([drives.seed, drives.seed + 1])
        nothing = AccruedReward.begin(2, adapter.vehicles, len(adapter.objectives))
        for member in members:
            actor = as_policy(member, adapter)
            if isinstance(actor, FunctionPolicy):
                actor.act(observations, nothing, None)
    except (TypeError, ValueError) as error:
        raise type(error)(f"task {task_id}: {error}") from None
    finally:
        drives.env.close()


def write_rows(path: str | Path, rows: Sequence[Row]) -> None:
    """Write rows as CSV, a column for each attribute.

    Raises:
        OSError: if the file cannot be written; it is complete or unchanged.
    """
    names = [field.name for field in fields(Row)]
    body = [["" if value is None else value for value in astuple(row)] for row in rows]
    atomic_write(Path(path), csv_bytes([names, *body]))


def read_rows(path: str | Path) -> list[Row]:
    """The rows that :func:`write_rows` wrote, of tasks of the suite.

    Raises:
        ValueError: if it is another file; or with a line for each row that is not a score of this version of the suite:
            of an unknown task, policy or column, with a number that is not finite or outside of its own interval, more
            steps than the task allows, or a second row of the same number or run.
    """
    texts = {each.name for each in fields(Row) if each.type == "str"}
    known = [each.name for each in fields(Row)]
    required = [each.name for each in fields(Row) if each.default is MISSING]
    rows: list[tuple[str, Row]] = []  # after the line that it is on
    faults: list[str] = []
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as file:  # Excel begins UTF-8 with a mark
            reader = csv.DictReader(file, strict=True)
            columns = reader.fieldnames or ()
            if not {*required} <= {*columns} <= {*known} or len({*columns}) < len(columns):
                found = f"they are {', '.join(columns)}" if columns else "the file is empty"
                raise ValueError(f"its columns must be {', '.join(known)}; {found}")
            for line in reader:
                if None in line or None in line.values():
                    raise ValueError(f"line {reader.line_num} must have {len(columns)} cells")
                cells = {name: text if text or name in texts else None for name, text in line.items()}
                where = f"line {reader.line_num}: "
                try:
                    rows.append((where, _ROW.validate_python(cells)))
                except pydantic.ValidationError as error:
                    told = "; ".join(f"{each['loc'][-1]} = {each['input']}: {each['msg']}" for each in error.errors())
                    faults.append(where + told)
    except FileNotFoundError:
        raise ValueError(f"{str(path)!r} does not exist") from None
    except UnicodeDecodeError:
        raise ValueError(f"{str(path)!r} is not a table of scores: it is not a text file") from None
    except (OSError, ValueError, csv.Error) as error:
        raise ValueError(f"{str(path)!r} is not a table of scores: {error}") from None
    refuse(str(path), [*faults, *_faults_of(rows)])
    return [row for _, row in rows]


def check_rows(rows: Sequence[Row], what: str) -> None:
    """Refuse rows that :func:`read_rows` would refuse; ``what`` names where they are from."""
    refuse(what, [*_faults_of([("", row) for row in rows])])


def refuse(what: str, faults: Sequence[str]) -> None:
    """Raise ValueError with a line for each fault of ``what``, if there is one; the first of many."""
    if faults:
        more = [f"and {len(faults) - SHOWN_FAULTS:,} more"] if len(faults) > SHOWN_FAULTS else []
        raise ValueError("\n".join([*(f"{what!r}: {fault}" for fault in faults[:SHOWN_FAULTS]), *more]))


def _faults(row: Row) -> list[str]:
    """What is wrong with a row by itself."""
    suite = load()
    try:
        task = suite.task(row.task)
    except ValueError as error:
        return [str(error)]
    faults = []
    if row.version != suite.version and (row.version, row.value) != (0, None):
        faults.append(f"it is of version {row.version} of the suite; this is version {suite.version}")
    if row.steps is not None and row.steps > task.steps:
        faults.append(f"steps = {row.steps:,}: task {row.task} allows {task.steps:,} environment steps")
    if row.value is None:
        if (row.policy, row.column, row.low, row.high) != ("", "", None, None):
            faults.append("value is empty; so must be policy, column, low and high")
        return faults
    if row.state == FAILED:
        faults.append(f"value = {row.value}: a run that failed has none")
    if row.policy not in (GREEDY, STOCHASTIC):
        faults.append(f"policy = {row.policy!r} must be {GREEDY} or {STOCHASTIC}")
    allowed = columns_of(task) if row.policy == task.policy else [SCORE]
    if row.column not in allowed:
        faults.append(f"column {row.column!r} of {row.policy} on {row.task} is unknown; {nearest(row.column, allowed)}")
    if row.low is None or row.high is None:
        if row.low is not row.high:
            faults.append("low and high must both be given, or neither")
    elif row.column != WORST:  # the least of several means is above that of most resamples
        slack = ROUNDING * (1.0 + abs(row.value))
        if not row.low - slack <= row.value <= row.high + slack:
            faults.append(f"value = {row.value} is outside of its interval from {row.low} to {row.high}")
    return faults


def _faults_of(rows: Sequence[tuple[str, Row]]) -> Iterator[str]:
    """What is wrong with rows, each after where it is, by themselves and with what they say twice, or differently."""
    runs: dict[tuple[str, str, int], tuple[str, str]] = {}
    seen: set[tuple[str, str, int, str, str]] = set()
    for where, row in rows:
        yield from (where + fault for fault in _faults(row))
        run = (row.task, row.learner, row.seed)
        what = f"{where}{row.learner!r} with seed {row.seed} on {row.task}"
        if (*run, row.policy, row.column) in seen:
            yield f"{what} has several rows of {' '.join([row.policy, row.column]).strip() or 'no value'}"
        elif runs.setdefault(run, (row.source, row.state)) != (row.source, row.state):
            told = [f"{state} ({source or 'no source'})" for source, state in (runs[run], (row.source, row.state))]
            yield f"{what} is of several runs: {', '.join(told)}"
        seen.add((*run, row.policy, row.column))
