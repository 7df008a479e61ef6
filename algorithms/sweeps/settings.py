"""What a sweep's YAML file says."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from algorithms.common.yaml_io import read_mapping
from algorithms.experiments.config import SHORT_FORMS, Count
from mo_deepdrive.config import Settings, parse

MOST_SEEDS = 100_000


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


def _counted(value: Any) -> Any:
    """5 seeds are 0, 1, 2, 3 and 4."""
    if not isinstance(value, int) or isinstance(value, bool):
        return value
    if value > MOST_SEEDS:
        raise ValueError(f"at most {MOST_SEEDS:,} seeds")
    return list(range(value))


def _choices(value: Any) -> Any:
    return {"choices": value} if isinstance(value, list) else value


Seed = Annotated[int, Field(ge=0, lt=2**31)]


class Range(Settings):
    """The values that a search may choose for a key: numbers of an interval, or one of several choices.

    Attributes:
        low, high: ends, included; whole numbers if both are whole.
        log: whether they are spread over orders of magnitude.
        step: distance between values; None for all.
        choices: instead of an interval.
    """

    low: int | float | None = None
    high: int | float | None = None
    log: bool = False
    step: int | float | None = None
    choices: Annotated[list[Any] | None, Field(min_length=1)] = None


class SearchSettings(Settings):
    """Points of a space, chosen by Optuna.

    Attributes:
        space: the values of each key; a list is short for ``choices``.
        metric: of the final evaluation, as "greedy/utility_esr", "stochastic/success" or "front/hypervolume"; the mean
            over seeds counts.
        direction: of improvement.
        sampler: "random" chooses all points beforehand, "tpe" from the scores of those before.
        trials: points.
        batch: points that "tpe" chooses at once; the runs of a batch end before the next begins, so that the choice
            does not depend on which run is the fastest.
        seed: of the sampler.
    """

    space: dict[str, Annotated[Range, BeforeValidator(_choices)]] = Field(min_length=1)
    metric: str
    direction: Literal["maximize", "minimize"] = "maximize"
    sampler: Literal["tpe", "random"] = "tpe"
    trials: Count
    batch: Count = 8
    seed: Seed = 0


class Resources(Settings):
    """What one run needs.

    Attributes:
        cpus: cores; a fraction puts several runs on one.
        gpus: devices; a fraction puts several runs on one (Ray), elsewhere whole.
        memory_gb: of main memory; None for what the engine gives.
        minutes: of wall time (Slurm), after which a job is requeued and goes on.
    """

    cpus: float = Field(default=1.0, gt=0)
    gpus: float = Field(default=0.0, ge=0)
    memory_gb: float | None = Field(default=None, gt=0)
    minutes: Count = 60


class AshaSettings(Settings):
    """Asynchronous successive halving (Ray): runs that are behind at a rung are stopped early.

    Attributes:
        metric: of the evaluations while training, as in :class:`SearchSettings`.
        direction: of improvement.
        grace_period: environment steps before a run may be stopped.
        reduction_factor: one run in so many goes on at each rung.
    """

    metric: str
    direction: Literal["maximize", "minimize"] = "maximize"
    grace_period: Count
    reduction_factor: float = Field(default=4.0, gt=1)


class RaySettings(Settings):
    """Ray Tune.

    Attributes:
        asha: early stopping; None for none.
    """

    asha: AshaSettings | None = None


class SlurmSettings(Settings):
    """Slurm, by submitit.

    Attributes:
        partition, account, qos, constraint: as sbatch has them.
        runs_per_job: runs that one task of the array makes, one after the other or side by side.
        side_by_side: how many of them at a time.
        array_parallelism: tasks of the array at a time.
        signal_delay_s: how long before the end of its time a job is told to save and requeue (s).
        max_requeues: how often a job may use up its time.
        setup: shell commands before each job.
        additional: any other option of sbatch.
    """

    partition: str | None = None
    account: str | None = None
    qos: str | None = None
    constraint: str | None = None
    runs_per_job: Count = 1
    side_by_side: Count = 1
    array_parallelism: Count = 256
    signal_delay_s: Count = 90
    max_requeues: Count = 100
    setup: list[str] = []
    additional: dict[str, Any] = {}


class SweepSettings(Settings):
    """A sweep: a base experiment, what varies, and what its runs need.

    Attributes:
        config: the YAML file of the base experiment, relative to the working directory; or several, as the outermost
            dimension of the grid.
        overrides: keys of the experiment and their values, the same for all runs.
        grid: keys of the experiment and the values that each takes, every combination; a mapping is merged into the
            section that it is for.
        search: points of a space instead of a grid, or of each cell of the grid.
        seeds: of the runs of each cell; a number for 0, 1, ... below it.
        resources: of each run.
        retries: how often a run is tried again whose process died or could not write.
        ray, slurm: of these engines.
    """

    config: Annotated[list[str], BeforeValidator(_listed), Field(min_length=1)]
    overrides: dict[str, Any] = {}
    grid: dict[str, Annotated[list[Any], Field(min_length=1)]] = {}
    search: SearchSettings | None = None
    seeds: Annotated[list[Seed], BeforeValidator(_counted), Field(min_length=1)] = [0]
    resources: Resources = Resources()
    retries: int = Field(default=3, ge=0)
    ray: RaySettings = RaySettings()
    slurm: SlurmSettings = SlurmSettings()


def load_sweep(path: str | Path) -> SweepSettings:
    """Read a sweep.

    Raises:
        ValueError: naming the file and every key that is wrong.
    """
    what = f"sweep {str(path)!r}"
    settings = parse(SweepSettings, read_mapping(path), what)
    space = {} if settings.search is None else settings.search.space
    places: dict[str, dict[str, Any]] = {
        "overrides": settings.overrides,
        "grid": settings.grid,
        "search.space": space,
    }
    problems: list[str] = []
    for key in dict.fromkeys(key for keys in places.values() for key in keys):
        found = [name for name, keys in places.items() if key in keys]
        if SHORT_FORMS.get(key, key) == "training.seed":
            problems.append(f"{key!r} in {found[0]}: seeds have a key of their own, 'seeds'")
        if len(found) > 1:
            problems.append(f"{key!r} is in {' and in '.join(found)}")
    for key, values in space.items():
        problems += [f"search.space.{key}: {problem}" for problem in _problems(values)]
    fixed = [(key, [value]) for key, value in settings.overrides.items()] + list(settings.grid.items())
    for key, given in fixed:
        if key == "training" and any(isinstance(value, dict) and "seed" in value for value in given):
            problems.append("'seed' in 'training': seeds have a key of their own, 'seeds'")
    if len(set(settings.config)) < len(settings.config):
        problems.append(f"config = {settings.config} has a file twice")
    if len(set(settings.seeds)) < len(settings.seeds):
        problems.append(f"seeds = {settings.seeds} has a seed twice")
    if problems:
        raise ValueError(f"invalid {what}: {'; '.join(problems)}")
    return settings


def _problems(values: Range) -> list[str]:
    """What is wrong with a range."""
    if values.choices is not None:
        return ["choices stand alone"] if values.model_fields_set != {"choices"} else []
    if values.low is None or values.high is None:
        return ["needs 'low' and 'high', or 'choices'"]
    found = []
    if values.low > values.high:
        found.append(f"low = {values.low} is above high = {values.high}")
    if values.log and values.low <= 0:
        found.append(f"low = {values.low} must be positive for a logarithmic range")
    if values.log and values.step is not None:
        found.append("a logarithmic range has no step")
    if values.step is not None and values.step <= 0:
        found.append(f"step = {values.step} must be positive")
    return found
