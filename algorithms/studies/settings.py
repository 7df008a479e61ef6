"""The settings of sweeps and studies, as their YAML files give them."""

from __future__ import annotations

import math
from itertools import pairwise, product
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from algorithms.runs.config import Count, UtilitySettings, find_config
from mo_deepdrive.support.names import nearest
from mo_deepdrive.support.yaml import read_mapping
from mo_deepdrive.world.config import EnvironmentSettings, Settings, parse

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

# Experiment keys that are set elsewhere, and where; in a study, and beside it, some more.
SEED_KEYS = dict.fromkeys(("seed", "training.seed", "training.seeds"), "set seeds with the key 'seeds'")
ELSEWHERE = {
    **SEED_KEYS,
    "evaluation.split": "a study scores its tuning on the validation split, and the runs that count on the test split",
    "evaluation.task": "name the task of the suite as 'task' of a task",
}


# -------------------------------------------------------------------------------------------------------- short forms


def _as_seeds(value: Any) -> Any:
    """A number is short for that many seeds: 5 for 0, 1, 2, 3 and 4."""
    return list(range(value)) if isinstance(value, int) and not isinstance(value, bool) else value


def _as_tasks(value: Any) -> Any:
    """A list is short for tasks of the suite."""
    if not isinstance(value, list):
        return value
    if not all(isinstance(name, str) for name in value) or len(set(value)) < len(value):
        raise ValueError("a list must have the ids of tasks of the suite, each of them once; other tasks have names")
    return {name: {"task": name} for name in value}


def _distinct(values: list[Any]) -> list[Any]:
    if len(set(values)) < len(values):
        raise ValueError("it has a duplicate")
    return values


def _increasing(values: list[float]) -> list[float]:
    if any(first >= second for first, second in pairwise(values)):
        raise ValueError("it must increase")
    return values


Seed = Annotated[int, Field(ge=0, lt=2**31)]
Seeds = Annotated[list[Seed], BeforeValidator(_as_seeds), Field(min_length=1), AfterValidator(_distinct)]
Share = Annotated[float, Field(gt=0.0, le=1.0)]
Values = dict[str, Annotated[list[Any], Field(min_length=1)]]


# ----------------------------------------------------------------------------------------------- where runs are trained


class Resources(Settings):
    """What one run needs."""

    cpus: float = Field(default=1.0, gt=0)
    """Cores; with a fraction, several runs share a core."""
    gpus: float = Field(default=0.0, ge=0)
    """Devices; with a fraction, several runs share a device (Ray); Slurm rounds up."""
    memory_gb: float | None = Field(default=None, gt=0)
    """Main memory in GB; None for the backend's default."""
    minutes: Count = 60
    """Wall-clock limit of a Slurm job, after which it is requeued and resumes."""


class AshaSettings(Settings):
    """Early stopping on Ray by asynchronous successive halving (Li et al. 2020): poor runs are pruned at each rung."""

    metric: str
    """The objective, a metric of the evaluations during training, named as the metric of a search."""
    direction: Literal["maximize", "minimize"] = "maximize"
    """Whether to maximize or minimize it."""
    grace_period: Count
    """Environment steps before a run may be pruned."""
    reduction_factor: float = Field(default=4.0, gt=1)
    """One in this many runs continues past each rung."""


class RaySettings(Settings):
    """Settings of the Ray Tune backend."""

    asha: AshaSettings | None = None
    """Early stopping; None to run every run to its end."""


class SlurmSettings(Settings):
    """Settings of the Slurm backend; :func:`algorithms.studies.slurm.sbatch_options` turns them into options."""

    partition: str | None = None
    """Passed to sbatch."""
    account: str | None = None
    """Passed to sbatch."""
    qos: str | None = None
    """Passed to sbatch."""
    constraint: str | None = None
    """Passed to sbatch."""
    runs_per_job: Count = 1
    """Number of runs in one task of the job array."""
    side_by_side: Count = 1
    """How many of these run concurrently."""
    array_parallelism: Count = 256
    """Maximum number of tasks that run concurrently."""
    signal_delay_s: Count = 90
    """Seconds before the time limit at which a job is told to save and requeue."""
    max_requeues: Count = 100
    """How often a job may reach its time limit."""
    setup: list[str] = []
    """Shell commands to run before each job."""
    additional: dict[str, Any] = {}
    """Any other options of sbatch."""


class PlanSettings(Settings):
    """What sweeps and studies have in common: values of all runs, what each needs, and the settings of the backends."""

    overrides: dict[str, Any] = {}
    """Values of experiment keys, the same for all runs."""
    seeds: Seeds = [0]
    """Seeds of each cell of a sweep, or those that count in a study; a number is short for that many from 0 on."""
    resources: Resources = Resources()
    """What each run needs."""
    retries: int = Field(default=3, ge=0)
    """How often to retry a run whose process died or could not write."""
    ray: RaySettings = RaySettings()
    """Settings of the backend of this name."""
    slurm: SlurmSettings = SlurmSettings()
    """Settings of the backend of this name."""

    @property
    def adaptive(self) -> bool:
        """Whether later runs are chosen by the scores of earlier ones: those of a search or of a tuning."""
        return any(getattr(self, name, None) is not None for name in ("search", "tuning"))


# ------------------------------------------------------------------------------------------------------------- a sweep


class SearchRange(Settings):
    """The values that a search may choose for a key: numbers in an interval, or a list of choices."""

    low: int | float | None = None
    """Bounds, inclusive; if both are integers, so are the values."""
    high: int | float | None = None
    """Bounds, inclusive; if both are integers, so are the values."""
    log: bool = False
    """Whether to sample on a logarithmic scale."""
    step: int | float | None = None
    """Distance between values; None for a continuous range."""
    choices: Annotated[list[Any] | None, Field(min_length=1)] = None
    """The values themselves, instead of an interval."""

    @model_validator(mode="before")
    @classmethod
    def _of_choices(cls, value: Any) -> Any:
        return {"choices": value} if isinstance(value, list) else value

    @model_validator(mode="after")
    def _check(self) -> SearchRange:
        if self.choices is not None and self.model_fields_set != {"choices"}:
            raise ValueError("'choices' excludes the other keys")
        if self.choices is None and (self.low is None or self.high is None):
            raise ValueError("needs 'low' and 'high', or 'choices'")
        return self


class SearchSettings(Settings):
    """A hyperparameter search with Optuna."""

    space: dict[str, SearchRange] = Field(min_length=1)
    """The values of each key; a list is short for ``choices``."""
    metric: str
    """The objective, a metric of the final evaluation such as "greedy/utility_esr", "stochastic/success" or
    "front/hypervolume"; averaged over seeds."""
    direction: Literal["maximize", "minimize"] = "maximize"
    """Whether to maximize or minimize it."""
    sampler: Literal["tpe", "random"] = "tpe"
    """The sampler; "random" chooses all points in advance, "tpe" from the scores of earlier points."""
    trials: Count
    """Number of points."""
    batch: Count = 8
    """Number of points that "tpe" chooses at a time; all runs of a batch end before the next is chosen, so that the
    points do not depend on which run finishes first."""
    seed: Seed = 0
    """Seed of the sampler."""

    @model_validator(mode="after")
    def _check(self) -> SearchSettings:
        if self.sampler == "random" and "batch" in self.model_fields_set:
            raise ValueError("'batch' has no effect with the sampler 'random', which chooses all points in advance")
        return self


class SweepSettings(PlanSettings):
    """A sweep: a base experiment, what varies, and the resources of each run."""

    config: Annotated[
        list[str],
        BeforeValidator(lambda value: [value] if isinstance(value, str) else value),
        Field(min_length=1),
        AfterValidator(_distinct),
    ]
    """YAML file of the base experiment, relative to the working directory or to the folder of the sweep's own file, or
    the name of a shipped one; a list is the outermost dimension of the grid."""
    grid: Values = {}
    """Values of experiment keys; every combination is a cell. A mapping is merged into its section."""
    search: SearchSettings | None = None
    """A hyperparameter search, instead of a grid or within each cell of it."""

    @model_validator(mode="after")
    def _check(self) -> SweepSettings:
        space = self.search.space if self.search else {}
        places = {"overrides": keys_in(self.overrides), "grid": keys_in(self.grid), "search.space": [*space]}
        problems = key_problems(places, SEED_KEYS)
        for key in dict.fromkeys(key for keys in places.values() for key in keys):
            having = [place for place, keys in places.items() if key in keys]
            problems += [f"{key!r} is in {' and in '.join(having)}"] if len(having) > 1 else []
        if problems:
            raise ValueError("; ".join(problems))
        return self


# ------------------------------------------------------------------------------------------------------------- a study


class Learner(Settings):
    """An algorithm with its settings, one line of a table."""

    label: str | None = None
    """Name in tables and figures; None for its key."""
    config: str | None = None
    """YAML file with the algorithm, or of a whole experiment, relative to the working directory or to the folder of the
    study's own file, or the name of a shipped one."""
    overrides: dict[str, Any] = {}
    """Values of experiment keys."""
    tuning: Values = {}
    """Values of experiment keys that are tried beside those of the study, or instead of those of the same key."""
    ablation_of: str | None = None
    """The learner whose config, overrides and chosen settings it takes, with its own overrides in place of them: it is
    not tuned itself, so that only what it lacks makes a difference."""

    @property
    def same_policies(self) -> bool:
        """Whether it has the policies of the learner that it ablates, and only their evaluation differs."""
        return self.ablation_of is not None and all(key.startswith("evaluation.") for key in keys_in(self.overrides))

    def with_changes(self, other: Learner) -> Learner:
        """The learner with what ``other`` sets: its overrides are added, anything else is replaced."""
        changes = {name: getattr(other, name) for name in other.model_fields_set}
        return self.model_copy(update={**changes, "overrides": {**self.overrides, **other.overrides}})


class Tuning(Settings):
    """How the settings of every arm are chosen: by the mean score over seeds on the validation split, rung by rung.

    This is successive halving (K. Jamieson and A. Talwalkar, "Non-stochastic best arm identification and hyperparameter
    optimization", AISTATS 2016). The candidates of every rung are trained anew, since schedules follow a run's length.
    """

    values: Values = {}
    """Values of experiment keys that are tried, for all learners that have the setting."""
    candidates: Count | None = None
    """Number of combinations that are drawn, the values of a key about equally often; None for all of them."""
    seeds: Seeds = [100, 101, 102]
    """Seeds of each candidate, none of which may be a seed that counts; a number is short for that many from 0 on."""
    shares: Annotated[list[Share], Field(min_length=1), AfterValidator(_increasing)] = [1.0]
    """Share of a run's environment steps that a run of each rung takes."""
    reduction_factor: float = Field(default=2.0, gt=1)
    """One in so many candidates is in the next rung, at least one."""

    def rungs(self, candidates: int) -> list[tuple[float, int]]:
        """The share of the steps and the number of candidates of each rung."""
        return [(share, math.ceil(candidates / self.reduction_factor**i)) for i, share in enumerate(self.shares)]

    def candidates_of(self, values: Values) -> list[dict[str, Any]]:
        """The candidates of a learner: values by key; fewer than it should have if there are no more combinations."""
        sizes = [len(options) for options in values.values()]
        combinations = np.array([*product(*map(range, sizes))] if values else [])
        if self.candidates is not None:
            combinations = _balanced(combinations, min(self.candidates, len(combinations)))
        places = [dict(zip(values, combination, strict=True)) for combination in combinations]
        return [{key: values[key][i] for key, i in place.items()} for place in places]


def _balanced(combinations: NDArray[np.intp], number: int) -> NDArray[np.intp]:
    """(number, k) of the (n, k) combinations, drawn so that every value of a column comes about equally often."""
    left = np.random.default_rng(0).permutation(combinations)
    drawn, used = left[:0], np.zeros_like(left)  # how often the value at each place of what is left was drawn
    for _ in range(number):
        best = np.argmin(used.sum(axis=1))
        drawn = np.vstack([drawn, left[best]])
        left, used = (np.delete(array, best, axis=0) for array in (left, used + (left == left[best])))
    return drawn


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
    tuning: Tuning | None = None
    """How settings are chosen, instead of the study's way."""
    help: dict[str, Any] = {}
    """As the study's, which these are added to."""
    overrides: dict[str, Any] = {}
    """Values of experiment keys, the same for all runs of the task."""
    learners: dict[str, Learner] = {}
    """Further learners of this task by name, and what differs here from the study's learner of that name."""


class Study(PlanSettings):
    """A study: tasks, learners, and how settings are chosen."""

    title: str = ""
    """Name in tables and figures."""
    tasks: Annotated[dict[str, StudyTask], BeforeValidator(_as_tasks), Field(min_length=1)]
    """What is learnt, by name; a list of ids is short for tasks of the suite."""
    learners: dict[str, Learner] = {}
    """What learns, by name."""
    tuning: Tuning | None = None
    """How settings are chosen; None to train every learner with its own."""
    metric: str | None = None
    """The metric of the final evaluation by which settings are chosen and learners are compared, such as
    "stochastic/utility_esr" or "front/hypervolume"; for tasks that name none."""
    columns: list[str] = []
    """Further metrics of the final evaluation that the results have, without the policy, such as "success"."""
    help: dict[str, Any] = {}
    """Settings that every learner gets that has them, so that all have the same help."""

    @property
    def labels(self) -> dict[str, str]:
        """The names of learners in tables and figures, of those that have one."""
        learners = [self.learners, *(task.learners for task in self.tasks.values())]
        return {name: learner.label for group in learners for name, learner in group.items() if learner.label}

    def learners_of(self, task: str) -> dict[str, Learner]:
        """The learners of a task, by name."""
        changes = self.tasks[task].learners
        return {
            name: self.learners.get(name, Learner()).with_changes(changes.get(name, Learner()))
            for name in {**self.learners, **changes}
        }

    @model_validator(mode="after")
    def _check(self) -> Study:
        if problems := problems_of(self):
            raise ValueError("; ".join(problems))
        return self


def learners_in(study: Study) -> Iterator[tuple[str, Learner]]:
    """All learners of a study, and where they are in it."""
    yield from ((f"learners.{name}", learner) for name, learner in study.learners.items())
    for key, task in study.tasks.items():
        yield from ((f"tasks.{key}.learners.{name}", learner) for name, learner in task.learners.items())


def problems_of(study: Study) -> list[str]:
    """What is invalid in a study by itself, one line each."""
    problems = []
    clashes: dict[str, None] = {}  # tasks that share seeds and tuning have the same one
    keys = {"overrides": keys_in(study.overrides), "help": keys_in(study.help)}
    if study.tuning is not None:
        keys["tuning.values"] = keys_in(study.tuning.values)
    for name, task in study.tasks.items():
        place = f"tasks.{name}"
        keys |= {f"{place}.overrides": keys_in(task.overrides), f"{place}.help": keys_in(task.help)}
        if task.tuning is not None:
            keys[f"{place}.tuning.values"] = keys_in(task.tuning.values)
            if study.tuning is None:
                problems.append(f"{place}.tuning has no effect in a study without tuning")
        seeds, tuning = task.seeds or study.seeds, task.tuning or study.tuning
        if tuning is not None and (both := set(seeds) & set(tuning.seeds)):
            where = f"{place}.seeds" if task.seeds else "seeds"
            clashes[f"{where} has {min(both)}, a seed of the tuning; take others"] = None
        if task.task is not None and task.environment is not None:
            problems.append(f"{place}.environment: the suite's task {task.task!r} has an environment of its own")
        learners = study.learners_of(name)
        tuned = {key for key, learner in learners.items() if learner.ablation_of is None}
        if not learners:
            problems.append(f"task {name!r} has no learners")
        for key, learner in learners.items():
            where, ablated = f"learner {key!r} on task {name!r}", learner.ablation_of
            if ablated is not None and ablated not in tuned:
                problems.append(
                    f"{where}: ablation_of = {ablated!r}, which is no learner there; {nearest(ablated, tuned)}"
                )
            elif ablated is not None and (learner.config or learner.tuning or "algorithm.name" in learner.overrides):
                problems.append(
                    f"{where}: an ablation has config, algorithm.name and tuning of {ablated!r}, not its own"
                )
    for place, learner in learners_in(study):
        keys |= {f"{place}.overrides": keys_in(learner.overrides), f"{place}.tuning": keys_in(learner.tuning)}
        if learner.tuning and study.tuning is None:
            problems.append(f"{place} has a tuning of its own, which has no effect in a study without tuning")
    problems += [*key_problems(keys, ELSEWHERE), *clashes]
    tasks = study.tasks.values()
    if study.metric is not None and all(task.task or task.metric for task in tasks):
        problems.append("metric has no effect: every task has its own")
    if "seeds" in study.model_fields_set and all(task.seeds for task in tasks):
        problems.append("seeds has no effect: every task has its own")
    if study.ray.asha is not None:
        problems.append("ray.asha would prune runs that count")
    return problems


# ---------------------------------------------------------------------------------------------------------- their files

P = TypeVar("P", bound=PlanSettings)
# The commands that train from files, and the keys that only these files have.
COMMANDS = {"study": ("study", "tasks"), "sweep": ("sweep", "config"), "experiment": ("train", "algorithm")}


def load_sweep(path: str | Path) -> SweepSettings:
    """Read the settings of a sweep: a YAML file, or the name of a shipped one."""
    return _load(SweepSettings, "sweep", path)


def load_study(path: str | Path) -> Study:
    """Read the settings of a study: a YAML file, or the name of a shipped one."""
    return _load(Study, "study", path)


def _load(model: type[P], kind: str, path: str | Path) -> P:
    name, path = str(path), find_config(path)
    values = read_mapping(path)
    actual = next((other for other, (_, key) in COMMANDS.items() if key in values), kind)
    if actual != kind:
        command = f"mo-deepdrive {COMMANDS[actual][0]} --config {name}"
        raise ValueError(f"{name!r} is the file of a{'n' * (actual[0] == 'e')} {actual}; {command} trains it")
    return parse(model, _with_paths(values, path), f"{kind} {name!r}")


def _with_paths(value: Any, file: Path, key: str = "") -> Any:
    """What a file says, with the paths of the configs that are beside it instead of their names."""
    if isinstance(value, dict):
        return {name: _with_paths(inner, file, name) for name, inner in value.items()}
    if key != "config":
        return value
    if isinstance(value, list):
        return [_with_paths(name, file, key) for name in value]
    beside = str(file.parent / value) if isinstance(value, str) else None
    return beside if beside and str(find_config(value, beside=file)) == beside else value


def keys_in(values: Mapping[str, Any]) -> list[str]:
    """The dotted experiment keys that a mapping sets or tries, those in its mappings included."""
    keys = []
    for key, value in values.items():
        sections = [section for section in (value if isinstance(value, list) else [value]) if isinstance(section, dict)]
        keys += list(dict.fromkeys(f"{key}.{inner}" for section in sections for inner in keys_in(section))) or [key]
    return keys


def key_problems(places: Mapping[str, list[str]], elsewhere: Mapping[str, str]) -> list[str]:
    """What is wrong with the keys of every place in a file, one line each: set elsewhere, or twice in a place."""
    problems = []
    for place, keys in places.items():
        problems += [f"{key!r} in {place}: {elsewhere[key]}" for key in dict.fromkeys(keys) if key in elsewhere]
        problems += [f"{key!r} is in {place} twice" for key in dict.fromkeys(keys) if keys.count(key) > 1]
    return problems


def replaced_keys(configs: Iterable[str | None], elsewhere: Mapping[str, str]) -> list[str]:
    """What configs say that is set elsewhere, one line each; the arguments are as of :func:`key_problems`."""
    names = [name for name in dict.fromkeys(configs) if name is not None]
    keys = ((name, key) for name in names for key in keys_in(read_mapping(find_config(name))))
    return [f"{name}: {key} is not used; {elsewhere[key]}" for name, key in keys if key in elsewhere]
