"""The plan of the reproduction: tasks, protocols and variants from a YAML file, and the runs that they need."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from algorithms.common.yaml_io import read_mapping
from algorithms.experiments.config import Count, load_experiment
from algorithms.experiments.jobs import Job
from algorithms.experiments.shipped import find_config
from mo_deepdrive.config import Settings, parse
from mo_deepdrive.names import nearest

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

QUICK_EVALUATIONS = 5  # during training, in a quick reproduction


class Variant(Settings):
    """One curve of a figure, one row of a table: an experiment's config with overrides."""

    label: str
    """Name in figures and tables."""
    config: str
    """YAML file of the experiment, or the name of a shipped one."""
    overrides: dict[str, Any] = {}
    """Values of keys of the experiment."""


class Protocol(Settings):
    """Variants that are trained under the same conditions and compared with each other."""

    title: str
    """The conditions in words."""
    seeds: int | None = Field(default=None, ge=1)
    """Number of runs of each variant; None for the plan's."""
    first_seed: int | None = Field(default=None, ge=0)
    """Seed of the first run; None for the plan's, a different one if settings were chosen on the plan's seeds."""
    quick_timesteps: Count | None = None
    """Environment steps in a quick reproduction; None to leave out the protocol there."""
    overrides: dict[str, Any] = {}
    """Changes of the config of every variant."""
    variants: dict[str, Variant] = Field(min_length=1)
    """Variants by key, which is also the name of the folder of their runs."""


class PlannedTask(Settings):
    """One scenario under one utility, or with an unknown utility."""

    title: str
    """Scenario and utility."""
    protocols: dict[str, Protocol] = Field(min_length=1)
    """By key."""


class Plan(Settings):
    """The whole reproduction."""

    first_seed: Annotated[int, Field(ge=0)]
    """Seed of the first run of each variant; the others follow."""
    seeds: Annotated[int, Field(ge=1)]
    """Number of runs of each variant."""
    quick_seeds: Annotated[int, Field(ge=1)]
    """The same in a quick reproduction."""
    overrides: dict[str, Any] = {}
    """Of every run."""
    quick_overrides: dict[str, Any] = {}
    """Of every run of a quick reproduction."""
    tasks: dict[str, PlannedTask] = Field(min_length=1)
    """By key."""


@dataclass(frozen=True)
class PlannedRun:
    """A run of the plan.

    Attributes:
        task, protocol, variant: their keys.
        label: of the variant.
        seed: of the run.
        job: trains the run.
    """

    task: str
    protocol: str
    variant: str
    label: str
    seed: int
    job: Job


def load_plan(path: str | Path) -> Plan:
    """Read a plan: a YAML file, or the name of a shipped one.

    Raises:
        ValueError: naming the file and every invalid key.
    """
    return parse(Plan, read_mapping(find_config(path)), f"plan {str(path)!r}")


def planned_runs(
    plan: Plan,
    tasks: Sequence[str],
    folder: Path,
    *,
    seeds: int | None = None,
    quick: bool = False,
) -> list[PlannedRun]:
    """The runs of some tasks; every config is resolved and checked.

    Args:
        plan: the whole reproduction.
        tasks: keys of the tasks.
        folder: of the run directories.
        seeds: number of runs of each variant, instead of the plan's; protocols with fewer keep their number.
        quick: fewer seeds and steps, without protocols that have no ``quick_timesteps``.

    Raises:
        ValueError: for an unknown task, or naming the task, protocol and variant with an invalid config.
    """
    for key in tasks:
        if key not in plan.tasks:
            raise ValueError(f"task {key!r} is unknown; {nearest(key, plan.tasks)}")
    return [
        run
        for key in tasks
        for name, protocol in plan.tasks[key].protocols.items()
        if not (quick and protocol.quick_timesteps is None)
        for run in _protocol_runs(plan, key, name, folder, seeds, quick)
    ]


def _protocol_runs(
    plan: Plan, task: str, protocol_key: str, folder: Path, seeds: int | None, quick: bool
) -> Iterator[PlannedRun]:
    protocol = plan.tasks[task].protocols[protocol_key]
    count = min(protocol.seeds or plan.seeds, plan.quick_seeds if quick else protocol.seeds or plan.seeds)
    if seeds is not None:
        count = min(seeds, protocol.seeds) if protocol.seeds else seeds
    first = plan.first_seed if protocol.first_seed is None else protocol.first_seed
    shortened: dict[str, Any] = {}
    if quick and protocol.quick_timesteps is not None:
        shortened = {
            "training.total_timesteps": protocol.quick_timesteps,
            "evaluation.interval": max(1, protocol.quick_timesteps // QUICK_EVALUATIONS),
            **plan.quick_overrides,
        }
    for key, variant in protocol.variants.items():
        name = f"{task}/{protocol_key}/{key}"
        for seed in range(first, first + count):
            values = {**plan.overrides, **protocol.overrides, **variant.overrides, **shortened, "training.seed": seed}
            try:
                experiment = load_experiment(variant.config, _as_overrides(values))
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from None
            job = Job(f"{name}, seed {seed}", experiment, folder / task / protocol_key / key / f"seed{seed}")
            yield PlannedRun(task, protocol_key, key, variant.label, seed, job)


def _as_overrides(values: Mapping[str, Any]) -> list[str]:
    """Command-line overrides of an experiment."""
    return [f"--{key}={json.dumps(value)}" for key, value in values.items()]
