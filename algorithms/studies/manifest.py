"""The manifest of a sweep or study: one line of JSON per run, byte for byte the same on every machine and backend."""

from __future__ import annotations

import copy
import hashlib
import json
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from algorithms.reporting.run_records import INCIDENTAL
from algorithms.runs.config import (
    Experiment,
    check_loggers,
    directory_name,
    is_peer,
    make_experiment,
    override,
    peer_running,
)
from algorithms.runs.jobs import Job
from mo_deepdrive.support.atomic_io import atomic_write, own_path
from mo_deepdrive.support.names import nearest_few

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

FILE = "manifest.jsonl"
RUNS = "runs"


@dataclass(frozen=True)
class ManifestRow:
    """A line of the manifest: one run."""

    __pydantic_config__ = ConfigDict(extra="forbid", strict=True)

    id: str  # a hexadecimal hash of everything in ``config`` that affects the result
    directory: Annotated[str, Field(pattern=rf"^{RUNS}/[^/.][^/]*$")]  # relative to the sweep's
    cell: dict[str, Any]  # what differs from other cells, by key; the runs of a cell differ in their seed alone
    seed: int
    trial: int | None  # number of the settings that are tried, in a search or a tuning
    config: dict[str, Any]  # the resolved experiment

    @property
    def name(self) -> str:
        """A readable name for messages."""
        return f"{label(self.cell)} seed {self.seed} ({self.id})".strip()

    @cached_property
    def experiment(self) -> Experiment:
        """The experiment in ``config``, whose code is imported."""
        return make_experiment(self.config, here=False)

    def job(self, sweep: Path) -> Job:
        """The job that trains this run of the sweep in the directory ``sweep``."""
        return Job(self.name, self.experiment, sweep / self.directory, self.id)

    def line(self) -> bytes:
        """The row as a line of a manifest file."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return json.dumps(values, separators=(",", ":"), allow_nan=False).encode() + b"\n"


class Scores:
    """What a plan knows of runs that have ended: here nothing, so that it has the runs with which it begins."""

    def of(self, row: ManifestRow, metric: str) -> float | None:
        """The value of a metric; None for a run that failed or has no finite value, NaN for one that has not ended."""
        del row, metric
        return math.nan

    def settle(self, earlier: Sequence[ManifestRow], later: Sequence[ManifestRow]) -> bool:
        """Whether ``later`` runs may be chosen by the scores of ``earlier`` ones, or failed ones are repeated first."""
        del earlier, later
        return True

    def mean(self, rows: Sequence[ManifestRow], metric: str) -> float | None:
        """The mean of :meth:`of`, which is NaN as long as a run has not ended, then None if one failed."""
        scores = [self.of(row, metric) for row in rows]
        known = [score for score in scores if score is not None]
        return fmean(known) if len(known) == len(scores) or any(map(math.isnan, known)) else None


def label(cell: Mapping[str, Any]) -> str:
    """A cell as text: ``algorithm.learning_rate=0.001 training.num_envs=16``."""
    return " ".join(f"{key}={value_text(value)}" for key, value in cell.items())


def value_text(value: Any) -> str:
    """The value of a key as text: strings as they are, anything else as JSON."""
    return value if isinstance(value, str) else json.dumps(value, default=str)


def run_id(config: Mapping[str, Any]) -> str:
    """The first digits of the SHA-256 of a resolved experiment's canonical JSON, without keys that are INCIDENTAL."""
    hashed = dict(config)
    for key in INCIDENTAL:
        *sections, last = key.split(".")
        place = hashed
        for section in sections:
            place[section] = place = dict(place[section])
        place.pop(last, None)
    text = json.dumps(hashed, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def cell_rows(
    cell: dict[str, Any],
    values: Mapping[str, Any],
    seeds: Sequence[int],
    trial: int | None = None,
    *,
    metric: str | None = None,
    build_once: bool = True,
) -> list[ManifestRow]:
    """The rows of one cell, one per seed; ``build_once`` checks that the agent can be built and has the metric."""
    where = f"cell [{label(cell)}]"
    experiment = make_experiment(overridden(values, {"training.seed": seeds[0]}, cell), where, here=False)
    if trial is not None and experiment.evaluation.split != "validation":
        raise ValueError(
            f"{where}: evaluation.split = {experiment.evaluation.split!r}: settings are chosen by the final scores, "
            "which needs 'validation'"
        )
    if build_once:
        try:
            _check_buildable(experiment, metric)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
    resolved = json.loads(json.dumps(experiment.to_dict(), sort_keys=True))
    rows: list[ManifestRow] = []
    for seed in seeds:
        config = {**resolved, "training": {**resolved["training"], "seed": seed}}
        name = run_id(config)
        directory = f"{RUNS}/{directory_name(experiment.algorithm.name)}-seed{seed}-{name}"
        row = ManifestRow(name, directory, cell, seed, trial, config)
        training = experiment.training.model_copy(update={"seed": seed})
        vars(row)["experiment"] = experiment.model_copy(update={"training": training})  # parsed once for all seeds
        rows.append(row)
    return rows


def _check_buildable(experiment: Experiment, metric: str | None) -> None:
    """Raise now the error that the run would raise when it starts, or whoever needs the metric at its end."""
    from algorithms.runs.build import build, check_resident
    from algorithms.runs.report import final_metric_names

    check_loggers(experiment)
    if is_peer(experiment.algorithm.name):
        # This machine may not have the run's device.
        settings = experiment.training.model_copy(update={"device": "cpu"})
        peer_running().prepare(experiment.model_copy(update={"training": settings}), lambda _step, _metrics: None)
    else:
        if experiment.is_resident:
            check_resident(experiment)
        build(experiment, num_envs=1)
    if metric is not None and metric not in (known := final_metric_names(experiment)):
        raise ValueError(f"metric {metric!r} is unknown; the nearest ones: {nearest_few(metric, known)}")


def overridden(values: Mapping[str, Any], changes: Mapping[str, Any], cell: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of ``values`` with ``changes`` applied; errors name the cell."""
    result = copy.deepcopy(dict(values))
    try:
        for key, value in changes.items():
            override(result, key, copy.deepcopy(value))
    except ValueError as error:
        raise ValueError(f"cell [{label(cell)}]: {error}") from None
    return result


def short_names(paths: Sequence[str]) -> dict[str, str]:
    """Short names of config files and paths of classes: stems and classes, or all as given if two of them are equal."""
    stems = [Path(directory_name(path)).stem for path in paths]
    return dict(zip(paths, stems if len(set(stems)) == len(stems) else paths, strict=True))


def refuse_duplicates(rows: Sequence[ManifestRow]) -> None:
    """Refuse two cells that are the same run."""
    seen: dict[str, ManifestRow] = {}
    for row in rows:
        if other := seen.get(row.id):
            raise ValueError(
                f"cells [{label(other.cell)}] and [{label(row.cell)}] have the same run (seed {row.seed}, {row.id}): "
                "they do not differ in anything that affects its result"
            )
        seen[row.id] = row


def write_manifest(sweep: Path, rows: Sequence[ManifestRow]) -> Path:
    """Write the manifest into a sweep's directory, atomically; returns its path."""
    sweep.mkdir(parents=True, exist_ok=True)
    path = own_path(sweep, FILE)
    for row in rows:
        own_path(sweep, row.directory)
    atomic_write(path, (row.line() for row in rows))
    return path


def is_sweep(path: Path) -> bool:
    """Whether a directory is that of a sweep or study."""
    return (path / FILE).is_file()


def read_manifest(sweep: Path) -> list[ManifestRow]:
    """The rows of a manifest."""
    path, rows = sweep / FILE, TypeAdapter(ManifestRow)
    if not path.is_file():
        raise ValueError(f"{str(sweep)!r} is neither a sweep nor a study: it has no {FILE}")
    read = []
    for number, line in enumerate(path.read_bytes().splitlines(), 1):
        try:
            read.append(rows.validate_json(line))
        except ValidationError as error:
            problem = error.errors(include_url=False)[0]
            field = f"{'.'.join(map(str, problem['loc']))} = {problem['input']!r}: " if problem["loc"] else ""
            raise ValueError(f"manifest {str(path)!r} is broken in line {number}: {field}{problem['msg']}") from None
    return read
