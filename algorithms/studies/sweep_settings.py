"""The settings of a sweep, as its YAML file gives them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from algorithms.runs.config import Count, find_config
from mo_deepdrive.support.yaml import read_mapping
from mo_deepdrive.world.config import Settings, parse

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

MAX_SEEDS = 100_000
# Experiment keys that are set elsewhere, and where.
SEED_KEYS = dict.fromkeys(("seed", "training.seed", "training.seeds"), "set seeds with the key 'seeds'")


def _as_list(value: Any) -> Any:
    """A single config file is short for a list of one."""
    return [value] if isinstance(value, str) else value


def _as_seeds(value: Any) -> Any:
    """A number is short for that many seeds: 5 for 0, 1, 2, 3 and 4."""
    if not isinstance(value, int) or isinstance(value, bool):
        return value
    if value > MAX_SEEDS:
        raise ValueError(f"at most {MAX_SEEDS:,} seeds are allowed")
    return list(range(value))


def _as_choices(value: Any) -> Any:
    """A list is short for ``choices``."""
    return {"choices": value} if isinstance(value, list) else value


Seed = Annotated[int, Field(ge=0, lt=2**31)]
Seeds = Annotated[list[Seed], BeforeValidator(_as_seeds), Field(min_length=1)]


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

    @model_validator(mode="after")
    def _check(self) -> SearchRange:
        if self.choices is not None:
            if self.model_fields_set != {"choices"}:
                raise ValueError("'choices' excludes the other keys")
        elif self.low is None or self.high is None:
            raise ValueError("needs 'low' and 'high', or 'choices'")
        elif self.low > self.high:
            raise ValueError(f"low = {self.low} is above high = {self.high}")
        elif self.log and self.low <= 0:
            raise ValueError(f"low = {self.low} must be positive for a logarithmic range")
        elif self.log and self.step is not None:
            raise ValueError("a logarithmic range takes no step")
        elif self.step is not None and self.step <= 0:
            raise ValueError(f"step = {self.step} must be positive")
        return self


class HyperparameterSearchSettings(Settings):
    """A hyperparameter search with Optuna."""

    space: dict[str, Annotated[SearchRange, BeforeValidator(_as_choices)]] = Field(min_length=1)
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

    @property
    def points_at_a_time(self) -> int:
        """Number of points that the sampler chooses before it needs their scores."""
        return self.batch if self.sampler == "tpe" else self.trials


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


class BackendSettings(Settings):
    """How many runs are trained: the resources of each, and the settings of the backends."""

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
        """Whether later runs are chosen by the scores of earlier ones."""
        return False


class SweepSettings(BackendSettings):
    """A sweep: a base experiment, what varies, and the resources of each run."""

    config: Annotated[list[str], BeforeValidator(_as_list), Field(min_length=1)]
    """YAML file of the base experiment, relative to the working directory or to the folder of the sweep's own file, or
    the name of a shipped one; a list is the outermost dimension of the grid."""
    overrides: dict[str, Any] = {}
    """Values of experiment keys, the same for all runs."""
    grid: dict[str, Annotated[list[Any], Field(min_length=1)]] = {}
    """Values of experiment keys; every combination is a cell. A mapping is merged into its section."""
    search: HyperparameterSearchSettings | None = None
    """A hyperparameter search, instead of a grid or within each cell of it."""
    seeds: Seeds = [0]
    """Seeds of each cell; a number is short for that many from 0 on."""

    @property
    def adaptive(self) -> bool:
        """As of the base class."""
        return self.search is not None


def load_sweep(path: str | Path) -> SweepSettings:
    """Read the settings of a sweep: a YAML file, or the name of a shipped one."""
    name, path = str(path), find_config(path)
    what, given = f"sweep {name!r}", read_mapping(path)
    if "algorithm" in given and "config" not in given:
        raise ValueError(f"{name!r} is the file of an experiment; mo-deepdrive train --config {name} trains it")
    settings = parse(SweepSettings, given, what)
    search = settings.search
    space = {} if search is None else search.space
    places = {"overrides": keys_in(settings.overrides), "grid": tried_keys(settings.grid), "search.space": [*space]}
    problems = key_problems(places, SEED_KEYS)
    for key in dict.fromkeys(key for keys in places.values() for key in keys):
        found = [name for name, keys in places.items() if key in keys]
        if len(found) > 1:
            problems.append(f"{key!r} is in {' and in '.join(found)}")
    if search is not None and search.sampler == "random" and "batch" in search.model_fields_set:
        problems.append("search.batch has no effect with the sampler 'random', which chooses all points in advance")
    if len(set(settings.config)) < len(settings.config):
        problems.append(f"config = {settings.config} has a duplicate file")
    if len(set(settings.seeds)) < len(settings.seeds):
        problems.append(f"seeds = {settings.seeds} has a duplicate seed")
    if problems:
        raise ValueError(f"invalid {what}: {'; '.join(problems)}")
    return settings.model_copy(update={"config": [found_beside(name, path) for name in settings.config]})


def keys_in(values: Mapping[str, Any]) -> list[str]:
    """The dotted experiment keys that a mapping sets, those in its mappings included."""
    return [
        f"{key}.{inner}" if inner else key
        for key, value in values.items()
        for inner in (keys_in(value) if isinstance(value, dict) and value else [""])
    ]


def tried_keys(values: Mapping[str, Sequence[Any]]) -> list[str]:
    """The same of a mapping from keys to the values that are tried for them."""
    return [
        key
        for name, choices in values.items()
        for key in dict.fromkeys(key for choice in choices for key in keys_in({name: choice}))
    ]


def key_problems(places: Mapping[str, Sequence[str]], elsewhere: Mapping[str, str]) -> list[str]:
    """What is wrong with the experiment keys in a file, one line each: they are set elsewhere, or twice in a place.

    Args:
        places: the keys of every place in the file.
        elsewhere: the keys that are set elsewhere, and where.
    """
    found = []
    for place, keys in places.items():
        found += [f"{key!r} in {place}: {elsewhere[key]}" for key in dict.fromkeys(keys) if key in elsewhere]
        found += [f"{key!r} is in {place} twice" for key in dict.fromkeys(keys) if keys.count(key) > 1]
    return found


def replaced_keys(configs: Iterable[str], elsewhere: Mapping[str, str]) -> list[str]:
    """What configs say that is set elsewhere, one line each; the arguments are as of :func:`key_problems`."""
    keys = ((config, key) for config in dict.fromkeys(configs) for key in keys_in(read_mapping(find_config(config))))
    return [f"{config}: {key} is not used; {elsewhere[key]}" for config, key in keys if key in elsewhere]


def found_beside(name: str, file: Path) -> str:
    """``name``, or the path of the config that it names beside the file of a sweep or study."""
    beside = file.parent / name
    return str(beside) if find_config(name, beside=file) == beside else name
