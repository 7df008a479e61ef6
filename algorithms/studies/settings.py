"""The settings of a study, as its YAML file gives them."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BeforeValidator, Field

from algorithms.runs.config import Count, UtilitySettings, find_config
from algorithms.studies.sweep_settings import (
    SEED_KEYS,
    BackendSettings,
    Seeds,
    found_beside,
    key_problems,
    keys_in,
    tried_keys,
)
from mo_deepdrive.support.yaml import read_mapping
from mo_deepdrive.world.config import EnvironmentSettings, Settings, parse

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

MAX_TUNING_RUNS = 12  # of an arm
# Experiment keys that are set elsewhere, and where.
ELSEWHERE = {
    **SEED_KEYS,
    "evaluation.split": "a study scores its tuning on the validation split, and the runs that count on the test split",
    "evaluation.task": "name the task of the suite as 'task' of a task",
}

Values = dict[str, Annotated[list[Any], Field(min_length=1)]]


def _as_tasks(value: Any) -> Any:
    """A list is short for tasks of the suite."""
    if not isinstance(value, list):
        return value
    if not all(isinstance(name, str) for name in value) or len(set(value)) < len(value):
        raise ValueError("a list must have the ids of tasks of the suite, each of them once; other tasks have names")
    return {name: {"task": name} for name in value}


class Learner(Settings):
    """An algorithm with its settings, one line of a table."""

    label: str | None = None
    """Name in tables and figures; None for its key."""
    config: str | None = None
    """YAML file with the algorithm, or of a whole experiment, relative to the working directory or to the folder of the
    study's own file, or the name of a shipped one."""
    overrides: dict[str, Any] = {}
    """Values of experiment keys."""
    tuning: Values | None = None
    """Values of experiment keys that are tried, instead of those of the study; every combination is tried."""
    tuning_share: float | None = Field(default=None, gt=0.0, le=1.0)
    """Share of a run's environment steps that a run of its tuning takes, instead of the study's."""

    def with_changes(self, other: Learner) -> Learner:
        """The learner with what ``other`` sets: its overrides are added, anything else is replaced."""
        changes = {name: getattr(other, name) for name in other.model_fields_set}
        return self.model_copy(update={**changes, "overrides": {**self.overrides, **other.overrides}})


class Tuning(Settings):
    """How the settings of every arm are chosen: tried on the validation split, the best mean over the seeds wins."""

    values: Values = {}
    """Values of experiment keys that are tried, for learners that name none; every combination is tried."""
    seeds: Seeds = [100]
    """Seeds of each combination, none of which may be a seed that counts; a number is short for that many from 0 on."""
    share: float = Field(default=1.0, gt=0.0, le=1.0)
    """Share of a run's environment steps that a run of the tuning takes."""


class StudyTask(Settings):
    """What is learnt. A task of the suite brings environment, utility, steps and score; any other names them."""

    task: str | None = None
    """The id of a task of the suite."""
    title: str | None = None
    """Name in tables and figures; None for the suite's, or for its key."""
    environment: EnvironmentSettings | None = None
    """The environment, instead of that of the learners' configs."""
    utility: UtilitySettings | None = None
    """The utility, instead of that of the learners' configs."""
    steps: Count | None = None
    """Environment steps of a run, instead of those of the learners' configs."""
    metric: str | None = None
    """The metric of the final evaluation by which settings are chosen and learners are compared, instead of the
    study's; with a suite's task its score."""
    seeds: Seeds | None = None
    """Seeds that count, instead of the study's."""
    help: dict[str, Any] = {}
    """As the study's, which these are added to."""
    overrides: dict[str, Any] = {}
    """Values of experiment keys, the same for all runs of the task."""
    learners: dict[str, Learner] = {}
    """Further learners of this task by name, and what differs here from the study's learner of that name."""


class Study(BackendSettings):
    """A study: tasks, learners, and how settings are chosen."""

    title: str = ""
    """Name in tables and figures."""
    tasks: Annotated[dict[str, StudyTask], BeforeValidator(_as_tasks), Field(min_length=1)]
    """What is learnt, by name; a list of ids is short for tasks of the suite."""
    learners: dict[str, Learner] = {}
    """What learns, by name."""
    seeds: Seeds = [0]
    """Seeds that count, scored on the test split; a number is short for that many from 0 on."""
    tuning: Tuning | None = None
    """How settings are chosen; None to train every learner with its own."""
    metric: str | None = None
    """The metric of the final evaluation by which settings are chosen and learners are compared, such as
    "stochastic/utility_esr" or "front/hypervolume"; for tasks that name none."""
    columns: list[str] = []
    """Further metrics of the final evaluation that the results have, without the policy, such as "success"."""
    help: dict[str, Any] = {}
    """Settings that every learner gets that has them, so that all have the same help."""
    overrides: dict[str, Any] = {}
    """Values of experiment keys, the same for all runs."""

    @property
    def adaptive(self) -> bool:
        """As of the base class."""
        return self.tuning is not None

    @property
    def labels(self) -> dict[str, str]:
        """The names of learners in tables and figures, of those that have one."""
        learners = [self.learners, *(task.learners for task in self.tasks.values())]
        return {name: learner.label for each in learners for name, learner in each.items() if learner.label}

    def learners_of(self, task: str) -> dict[str, Learner]:
        """The learners of a task, by name."""
        own = self.tasks[task].learners
        return {
            name: self.learners.get(name, Learner()).with_changes(own.get(name, Learner()))
            for name in {**self.learners, **own}
        }

    def points(self, learner: Learner) -> list[dict[str, Any]]:
        """The settings that are tried for a learner: values of experiment keys; none if the study does not tune."""
        values = (self.tuning.values if learner.tuning is None else learner.tuning) if self.tuning else {}
        combinations = product(*values.values()) if values else ()
        return [dict(zip(values, combination, strict=True)) for combination in combinations]


def load_study(path: str | Path) -> Study:
    """Read the settings of a study: a YAML file, or the name of a shipped one."""
    name, path = str(path), find_config(path)
    given = read_mapping(path)
    if "tasks" not in given:
        kind, command = ("sweep", "sweep") if "config" in given else ("experiment", "train")
        raise ValueError(f"{name!r} is the file of a{'n' * (kind[0] == 'e')} {kind}; mo-deepdrive {command} takes it")
    study = parse(Study, given, f"study {name!r}")
    problems = problems_of(study)
    if problems:
        raise ValueError(f"invalid study {name!r}: {'; '.join(problems)}")

    def beside(learners: dict[str, Learner]) -> dict[str, Learner]:
        """The learners, whose configs may be beside the study's file."""
        return {
            key: learner.model_copy(update={"config": found_beside(learner.config, path)})
            if learner.config
            else learner
            for key, learner in learners.items()
        }

    tasks = {key: task.model_copy(update={"learners": beside(task.learners)}) for key, task in study.tasks.items()}
    return study.model_copy(update={"tasks": tasks, "learners": beside(study.learners)})


def learners_in(study: Study) -> Iterator[tuple[str, Learner]]:
    """All learners of a study, and where they are in it."""
    yield from ((f"learners.{name}", learner) for name, learner in study.learners.items())
    for key, task in study.tasks.items():
        yield from ((f"tasks.{key}.learners.{name}", learner) for name, learner in task.learners.items())


def _keys_by_place(study: Study) -> dict[str, list[str]]:
    """The experiment keys in a study, by where they are in it."""
    keys = {"overrides": keys_in(study.overrides), "help": keys_in(study.help)}
    if study.tuning is not None:
        keys["tuning.values"] = tried_keys(study.tuning.values)
    for key, task in study.tasks.items():
        keys |= {f"tasks.{key}.overrides": keys_in(task.overrides), f"tasks.{key}.help": keys_in(task.help)}
    for place, learner in learners_in(study):
        keys |= {f"{place}.overrides": keys_in(learner.overrides), f"{place}.tuning": tried_keys(learner.tuning or {})}
    return keys


def problems_of(study: Study) -> list[str]:
    """What is invalid in a study by itself, one line each."""
    problems = []
    tuning = [] if study.tuning is None else study.tuning.seeds
    counted = {"seeds": study.seeds, **{f"tasks.{key}.seeds": task.seeds or [] for key, task in study.tasks.items()}}
    for where, seeds in {**counted, "tuning.seeds": tuning}.items():
        if len(set(seeds)) < len(seeds):
            problems.append(f"{where} = {seeds} has a duplicate seed")
        if where in counted and (both := set(seeds) & set(tuning)):
            problems.append(f"{where} has {min(both)}, a seed of the tuning; take others")
    problems += key_problems(_keys_by_place(study), ELSEWHERE)
    for place, learner in learners_in(study):
        for name in ("tuning", "tuning_share") if study.tuning is None else ():
            if getattr(learner, name) is not None:
                problems.append(f"{place}.{name} has no effect in a study without tuning")
    for key, task in study.tasks.items():
        if task.task is not None and task.environment is not None:
            problems.append(f"tasks.{key}.environment: the suite's task {task.task!r} has an environment of its own")
    tasks = study.tasks.values()
    for name, used in {
        "metric": any(task.task is None and task.metric is None for task in tasks),
        "seeds": any(task.seeds is None for task in tasks),
    }.items():
        if name in study.model_fields_set and getattr(study, name) is not None and not used:
            problems.append(f"{name} has no effect: every task has its own")
    if study.ray.asha is not None:
        problems.append("ray.asha would prune runs that count")
    for name in study.tasks:
        runs = {key: len(study.points(learner)) * len(tuning) for key, learner in study.learners_of(name).items()}
        if not runs:
            problems.append(f"task {name!r} has no learners")
        elif len(set(runs.values())) > 1:
            numbers = ", ".join(f"{key} {number}" for key, number in runs.items())
            problems.append(f"task {name!r}: every learner must have the same number of tuning runs, not {numbers}")
        elif study.tuning is not None and 0 in runs.values():
            problems.append(f"task {name!r}: tuning without values; give tuning.values, or those of the learners")
        if (most := max(runs.values(), default=0)) > MAX_TUNING_RUNS:
            problems.append(f"task {name!r}: {most} tuning runs of a learner; at most {MAX_TUNING_RUNS} are allowed")
    return problems
