"""What is trained to reproduce the paper: cells of arms of variants, read from a YAML file, turned into jobs."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from algorithms.common.yaml_io import read_mapping
from algorithms.experiments.config import Count, load_experiment
from algorithms.experiments.jobs import Job
from mo_deepdrive.config import Settings, nearest, parse

QUICK_EVALUATIONS = 5  # on the way


class Variant(Settings):
    """One line of a figure, one row of a table: a config and how it differs from its file.

    Attributes:
        label: its name in figures and tables.
        config: the experiment's YAML file, relative to the root of the repository.
        overrides: keys of the experiment and their values.
    """

    label: str
    config: str
    overrides: dict[str, Any] = {}


class Arm(Settings):
    """Variants that are compared with each other, under the same conditions.

    Attributes:
        title: what they have in common.
        seeds: runs of each; None for the plan's number.
        first_seed: None for the plan's; another where the plan's were looked at before the settings were final.
        quick_timesteps: environment steps of each in a quick reproduction; None leaves the arm out of it.
        overrides: of every variant.
        variants: by key; the key names the runs' folder.
    """

    title: str
    seeds: int | None = Field(default=None, ge=1)
    first_seed: int | None = Field(default=None, ge=0)
    quick_timesteps: Count | None = None
    overrides: dict[str, Any] = {}
    variants: dict[str, Variant] = Field(min_length=1)


class Cell(Settings):
    """One scenario under one utility (or under none): what a panel of a figure shows.

    Attributes:
        title: of the panel.
        arms: by key.
    """

    title: str
    arms: dict[str, Arm] = Field(min_length=1)


class Plan(Settings):
    """The whole reproduction.

    Attributes:
        first_seed: runs have this seed and the following ones.
        seeds: runs of each variant.
        quick_seeds: the same in a quick reproduction.
        overrides: of every run.
        quick_overrides: of every run of a quick reproduction.
        cells: by key.
    """

    first_seed: Annotated[int, Field(ge=0)]
    seeds: Annotated[int, Field(ge=1)]
    quick_seeds: Annotated[int, Field(ge=1)]
    overrides: dict[str, Any] = {}
    quick_overrides: dict[str, Any] = {}
    cells: dict[str, Cell] = Field(min_length=1)


@dataclass(frozen=True)
class Entry:
    """A run of the plan.

    Attributes:
        cell, arm, variant: its keys.
        label: of the variant.
        seed: of the run.
        job: the run itself.
    """

    cell: str
    arm: str
    variant: str
    label: str
    seed: int
    job: Job


def load_plan(path: str | Path) -> Plan:
    """Read a plan.

    Raises:
        ValueError: naming the file and every key that is wrong.
    """
    return parse(Plan, read_mapping(path), f"plan {str(path)!r}")


def entries(
    plan: Plan,
    cells: Sequence[str],
    runs: Path,
    *,
    seeds: int | None = None,
    quick: bool = False,
    root: Path = Path(),
) -> list[Entry]:
    """The runs of some cells; every config is resolved and checked.

    Args:
        plan: what there is.
        cells: keys of the plan's cells.
        runs: folder of the run directories.
        seeds: runs of each variant, instead of what plan and arms say (arms with fewer keep their number).
        quick: fewer seeds, fewer steps, and without the arms that have no quick form.
        root: the folder that the configs are relative to.

    Raises:
        ValueError: for unknown cells, or naming the cell, arm and variant whose config is wrong.
    """
    for key in cells:
        if key not in plan.cells:
            raise ValueError(f"cell {key!r} is unknown; {nearest(key, plan.cells)}")
    return [
        entry
        for key in cells
        for name, arm in plan.cells[key].arms.items()
        if not (quick and arm.quick_timesteps is None)
        for entry in _of_arm(plan, key, name, arm, runs, seeds, quick, root)
    ]


def _of_arm(
    plan: Plan, cell: str, name: str, arm: Arm, runs: Path, seeds: int | None, quick: bool, root: Path
) -> Iterator[Entry]:
    count = min(arm.seeds or plan.seeds, plan.quick_seeds if quick else arm.seeds or plan.seeds)
    if seeds is not None:
        count = min(seeds, arm.seeds) if arm.seeds else seeds
    shortened: dict[str, Any] = {}
    if quick and arm.quick_timesteps is not None:
        few = {"evaluation.interval": max(1, arm.quick_timesteps // QUICK_EVALUATIONS)}
        shortened = {"training.total_timesteps": arm.quick_timesteps, **few, **plan.quick_overrides}
    for key, variant in arm.variants.items():
        first = plan.first_seed if arm.first_seed is None else arm.first_seed
        for seed in range(first, first + count):
            values = {**plan.overrides, **arm.overrides, **variant.overrides, **shortened, "training.seed": seed}
            where = f"{cell}/{name}/{key}"
            try:
                experiment = load_experiment(root / variant.config, _as_arguments(values))
            except ValueError as error:
                raise ValueError(f"{where}: {error}") from None
            job = Job(f"{where}, seed {seed}", experiment, runs / cell / name / key / f"seed{seed}")
            yield Entry(cell, name, key, variant.label, seed, job)


def _as_arguments(values: Mapping[str, Any]) -> list[str]:
    return [f"--{key}={json.dumps(value)}" for key, value in values.items()]
