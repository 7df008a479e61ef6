"""What can be scored on the suite by name: runs, policies of the zoo, and a user's own functions and classes."""

from __future__ import annotations

import importlib.util
import math
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import NormalDist
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from algorithms.reporting.run_records import experiment_record, read_evaluation
from mo_deepdrive import suite
from mo_deepdrive.config import parse_arguments
from mo_deepdrive.evaluation.env_adapter import find_spec
from mo_deepdrive.evaluation.front import EVALUATION_FILE
from mo_deepdrive.evaluation.metrics import SUITE, split_name
from mo_deepdrive.evaluation.splits import SPLITS
from mo_deepdrive.importing import failure, import_named
from mo_deepdrive.names import nearest
from mo_deepdrive.suite.scoring import FAILED, ROUNDING

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from algorithms.experiments.config import Experiment
    from mo_deepdrive.suite import Row, Task

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
        steps: of its training; None for what is not a run.
        environment: in which it was trained; "" for what is not a run.
    """

    source: str
    learner: str
    seed: int
    tasks: tuple[str, ...]
    policy: Callable[[str], Any]
    state: str = "finished"
    cpu_seconds: float | None = None
    steps: int | None = None
    environment: str = ""

    def score(self, policy: Any, task_id: str, **options: Any) -> list[Row]:
        """The rows of its policy for a task; the options are those of :func:`mo_deepdrive.suite.score`."""
        rows = suite.score(policy, task_id, learner=self.learner, seed=self.seed, **options)
        about = {name: getattr(self, name) for name in ("source", "state", "cpu_seconds", "steps", "environment")}
        return [replace(row, **about) for row in rows]


def names_code(source: str) -> bool:
    """Whether a source is code, which is imported and run, and not a run or a policy of the zoo."""
    path, colon, _ = source.partition(":")
    return bool(colon) or path.endswith(".py")


def open_entry(source: str, *, trust: bool = False) -> Entry:
    """The entry that a user names.

    Args:
        source: a run's directory or a policy of the zoo; a file ``policy.py`` or ``policy.py:name``; or
            ``package.module:name``. The object is a policy as of :func:`mo_deepdrive.suite.score`, or a class that is
            made of a task's id and is one then.
        trust: as for :meth:`algorithms.experiments.run_directory.Run.open`.

    Raises:
        ValueError: if there is none, or it cannot be read.
    """
    path, _, name = source.partition(":")
    if not names_code(source):
        return _of_run(source, trust=trust)
    if not path.endswith(".py"):
        return _own(source, name, import_named("policy", source))
    label = Path(path).stem if name in ("", *OWN_NAMES) else name
    return _own(source, label, _of_file(source, Path(path), name))


def _own(source: str, label: str, policy: Any) -> Entry:
    """The entry of a user's own function or class."""

    def made(task_id: str) -> Any:
        try:
            return policy(task_id) if isinstance(policy, type) else policy
        except (Exception, SystemExit) as error:  # a user's class may raise anything
            hint = f"; {policy.__name__} is called with the id of a task"
            raise ValueError(f"{source!r} on task {task_id}: {failure(error)}{hint}") from error

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
        known = nearest(name or OWN_NAMES[0], own) if own else "it defines nothing"
        raise ValueError(f"policy {source!r}: the file has no {wanted}; {known}")
    return getattr(module, found[0])


def _of_run(source: str, *, trust: bool) -> Entry:
    """The entry of a run or of a policy of the zoo."""
    from algorithms.experiments.build import load_policy
    from algorithms.experiments.run_directory import Run
    from algorithms.experiments.suite_scores import scorable

    run = Run.open(source, trust=trust)
    experiment, status = run.experiment, run.status
    agents: list[Any] = []

    def policy(task_id: str) -> Any:
        check_experiment(experiment, task_id, source)
        if status.get("state") == FAILED:
            raise ValueError(f"{source!r} failed in training: it has the lowest score, and none to measure")
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
        experiment.training.total_timesteps,
        experiment_record(experiment.to_dict()).environment.label,
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
    """Refuse a run that cannot be an entry of a task, as far as its config says.

    Raises:
        ValueError: naming the run and the task, for a run of another task, one that met the partners of
            the test, or one that trained on the scenarios of the test split.
    """
    task, training = suite.load().task(task_id), experiment.training
    if differences := _differences(experiment, task):
        raise ValueError(f"{source!r} was not trained on task {task_id}: {', '.join(differences)}")
    if training.total_timesteps > task.steps:
        raise ValueError(
            f"{source!r} was trained for {training.total_timesteps:,} environment steps; task {task_id} allows "
            f"{task.steps:,}"
        )
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

    Nothing that they name is opened.

    Args:
        entry: the CSV file, or the run's directory.
        trust: allow rows whose source is code, and as for :meth:`algorithms.experiments.run_directory.Run.open`.

    Raises:
        ValueError: if there are none; or with a line for each fault of them: those of
            :func:`mo_deepdrive.suite.read_rows`, no source, one that is code and not trusted, or one of several
            learners or seeds.
    """
    path = Path(entry)
    found = _rows_of_run(path, trust=trust) if path.is_dir() else suite.read_rows(path)
    rows = [replace(row, source=_found_from(path, row.source)) for row in found if row.value is not None]
    if not rows:
        raise ValueError(f"{entry!r} has no scores")
    if not all(row.source for row in rows):
        raise ValueError(f"{entry!r} does not say which run or policy was scored")
    scored: dict[str, list[str]] = {}
    for row in rows:
        label = f"{row.learner!r} with seed {row.seed}"
        labels = scored.setdefault(_identity(row.source), [])
        labels += [label] if label not in labels else []
    faults = [f"{each!r} is scored as {' and as '.join(labels)}" for each, labels in scored.items() if len(labels) > 1]
    if not trust:
        code = dict.fromkeys(row.source for row in rows if names_code(row.source))
        faults += [f"{each!r} is code that would be imported and run; add --trust if you trust it" for each in code]
    suite.refuse(entry, faults)
    return rows


def _identity(source: str) -> str:
    """One name for the same run or file, however it is spelt."""
    path, colon, name = source.partition(":")
    colon, name = ("", "") if name in OWN_NAMES else (colon, name)
    return f"{Path(path).resolve() if Path(path).exists() else path}{colon}{name}"


def _found_from(table: Path, source: str) -> str:
    """A source that, if it is beside the table, is found from the working directory."""
    path, colon, name = source.partition(":")
    beside = table.parent / path
    return f"{beside}{colon}{name}" if table.is_file() and path and beside.exists() else source


def _rows_of_run(path: Path, *, trust: bool) -> list[Row]:
    from algorithms.experiments.run_directory import Run

    experiment, evaluation = Run.open(path, trust=trust).experiment, read_evaluation(path)
    if evaluation is None:
        raise ValueError(f"{str(path)!r} has no final evaluation: there is no {EVALUATION_FILE}")
    rows = [
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
    suite.check_rows(rows, str(path))
    return rows


def fresh_seed(number: int, episodes: int) -> int:
    """The seed of the first of ``episodes`` fresh scenarios, which follow from a number; no split has them."""
    room = 2**30 - episodes
    return 2**30 + int(np.random.default_rng(number).integers(room))


REPRODUCED, AN_EPISODE, HOLDS, DIFFERS = "reproduced", "but for an episode", "holds", "differs"
FALSE_ALARMS = 0.01  # of honest entries, on fresh scenarios
WIDTH = 2.0 * NormalDist().inv_cdf(0.975)  # of a 95% interval, in standard errors


class Comparison(NamedTuple):
    """A recorded row, what was found for it (None: nothing), on fresh scenarios or the test split, and the verdict."""

    recorded: Row
    found: Row | None
    fresh: bool
    verdict: str

    @property
    def agrees(self) -> bool:
        """Whether the verdict is in favour of the entry."""
        return self.verdict in (REPRODUCED, AN_EPISODE, HOLDS)


def compare(
    recorded: Sequence[Row], again: Sequence[Row], fresh: Sequence[Row], episodes: int, numbers: int
) -> list[Comparison]:
    """Compare what an entry claims of one policy on one task with what was measured.

    Args:
        recorded: the claims.
        again: measured on the test split.
        fresh: measured on fresh scenarios.
        episodes: of each.
        numbers: of all that the entry claims, as of :func:`holds`.
    """
    on_test, on_fresh = ({(row.policy, row.column): row for row in rows} for rows in (again, fresh))
    found = []
    for row in recorded:
        key = (row.policy, row.column)
        mine = on_test.get(key)
        if mine is None:
            found.append(Comparison(row, None, False, "is compared with nothing"))
            continue
        found.append(Comparison(row, mine, False, reproduces(row, mine, episodes)))
        for name in ("seed", "steps", "environment") if mine.steps is not None else ():  # of a run, which says them
            claim, known = getattr(row, name), getattr(mine, name)
            if claim not in (None, "", known):
                told = f"has {name} = {claim!r}; that of the run is {known!r}"
                found.append(Comparison(row, mine, False, told))
        if key in on_fresh and mine.low is not None:
            found.append(Comparison(row, on_fresh[key], True, holds(mine, on_fresh[key], numbers)))
    return found


def reproduces(recorded: Row, found: Row, episodes: int) -> str:
    """Whether a number was found again on the scenarios that it was recorded on, with its interval.

    Sums and networks round differently on another processor or with another PyTorch, by which one sampled action in a
    million is another one, and with it an episode: one of E that is four standard deviations away moves the mean by
    4 sd / E, which is the width of the interval over sqrt(E).

    Args:
        recorded: what is claimed.
        found: what was measured.
        episodes: E.

    Returns:
        "reproduced" if value and interval are equal to rounding, "but for an episode", or "differs".
    """
    claimed, measured = ((row.value, row.low, row.high) for row in (recorded, found))
    if [each is None for each in claimed] != [each is None for each in measured]:
        return DIFFERS
    pairs = [(a, b) for a, b in zip(claimed, measured, strict=True) if a is not None and b is not None]
    if all(abs(a - b) <= _rounding(b) for a, b in pairs):
        return REPRODUCED
    an_episode = _standard_error(found) * WIDTH / math.sqrt(episodes)
    return AN_EPISODE if all(abs(a - b) <= an_episode + _rounding(b) for a, b in pairs) else DIFFERS


def holds(found: Row, fresh: Row, numbers: int) -> str:
    """Whether a number that was measured on the test split is as high on fresh scenarios, both with an interval.

    Both are random: their difference may be as many of its standard errors as the largest of ``numbers`` differences
    of honest entries exceeds in :data:`FALSE_ALARMS` of all cases (Bonferroni).

    Returns:
        "holds" or "differs".
    """
    assert found.value is not None
    assert fresh.value is not None
    limit = NormalDist().inv_cdf(1.0 - FALSE_ALARMS / (2.0 * numbers))
    error = math.hypot(_standard_error(found), _standard_error(fresh))
    return HOLDS if abs(found.value - fresh.value) <= limit * error + _rounding(found.value) else DIFFERS


def _standard_error(row: Row) -> float:
    return 0.0 if row.low is None or row.high is None else (row.high - row.low) / WIDTH


def _rounding(value: float) -> float:
    return ROUNDING * (1.0 + abs(value))
