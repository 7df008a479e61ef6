"""The manifest of a sweep: one line of JSON per run, byte for byte the same on every machine and for every backend."""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from algorithms.reporting.run_records import INCIDENTAL
from algorithms.runs.config import (
    Experiment,
    check_loggers,
    directory_name,
    find_algorithm,
    make_experiment,
    override,
    peer_running,
)
from algorithms.runs.jobs import Job
from mo_deepdrive.support.atomic_io import atomic_write, own_path
from mo_deepdrive.support.names import nearest_few

# Score by run id; None for a run that failed or has no finite score.
Scores = Mapping[str, float | None]

FILE = "manifest.jsonl"
RUNS = "runs"
ID_DIGITS = 12


@dataclass(frozen=True)
class ManifestRow:
    """A line of the manifest: one run of the sweep.

    Attributes:
        id: a hexadecimal hash of everything in ``config`` that affects the result of the run.
        directory: of the run, relative to the sweep's; its name has the algorithm, the seed and the id.
        cell: the varied values, by key.
        seed: of the run.
        trial: number of the point in a hyperparameter search; None without a search.
        config: the resolved experiment.
    """

    __pydantic_config__ = ConfigDict(extra="forbid", strict=True)

    id: str
    directory: Annotated[str, Field(pattern=rf"^{RUNS}/[^/.][^/]*$")]
    cell: dict[str, Any]
    seed: int
    trial: int | None
    config: dict[str, Any]

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
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return json.dumps(values, separators=(",", ":"), allow_nan=False).encode() + b"\n"


def label(cell: Mapping[str, Any]) -> str:
    """A cell as text: ``algorithm.learning_rate=0.001 training.num_envs=16``."""
    return " ".join(
        f"{key}={value if isinstance(value, str) else json.dumps(value, default=str)}" for key, value in cell.items()
    )


def run_id(config: Mapping[str, Any]) -> str:
    """The id of a resolved experiment: the first digits of the SHA-256 of its canonical JSON.

    Device, threads and logging (:data:`algorithms.reporting.run_records.INCIDENTAL`) are left out: they do not affect
    the result. It is not the same bit for bit: the number of threads changes last bits, and a GPU draws other random
    numbers.
    """
    hashed = dict(config)
    for key in INCIDENTAL:
        *sections, last = key.split(".")
        place = hashed
        for section in sections:
            place[section] = place = dict(place[section])
        place.pop(last, None)
    text = json.dumps(hashed, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:ID_DIGITS]


def cell_rows(
    cell: dict[str, Any],
    values: Mapping[str, Any],
    seeds: Sequence[int],
    trial: int | None = None,
    *,
    metric: str | None = None,
    build_once: bool = True,
) -> list[ManifestRow]:
    """The rows of one cell, one per seed.

    Args:
        cell: the varied values, by key.
        values: the sections of the experiment.
        seeds: of the runs.
        trial: number of the settings that are tried, which must be scored on the validation split; None if none are.
        metric: of the final evaluation, which the experiment must have; None to check none.
        build_once: build the agent, to check that it can be built.
    """
    where = _cell_name(cell)
    values = _sorted(overridden(values, {"training.seed": seeds[0]}, cell))
    experiment = make_experiment(values, where, here=False)
    if trial is not None and experiment.evaluation.split != "validation":
        raise ValueError(
            f"{where}: evaluation.split = {experiment.evaluation.split!r}: settings are chosen by the final scores, "
            "which needs 'validation'"
        )
    if build_once:
        _check_buildable(experiment, where, metric)
    resolved = _sorted(experiment.to_dict())
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


def _check_buildable(experiment: Experiment, where: str, metric: str | None) -> None:
    """Raise now the error that the run would raise when it starts, or whoever needs the metric at its end."""
    from algorithms.runs.build import build, check_resident
    from algorithms.runs.report import final_metrics

    try:
        check_loggers(experiment)
        if find_algorithm(experiment.algorithm.name).is_peer:
            # This machine may not have the run's device.
            settings = experiment.training.model_copy(update={"device": "cpu"})
            here = experiment.model_copy(update={"training": settings})
            peer_running().prepare(here, lambda _step, _metrics: None)
        else:
            if experiment.is_resident:
                check_resident(experiment)
            build(experiment, num_envs=1)
        if metric is not None and metric not in (known := final_metrics(experiment)):
            raise ValueError(f"metric {metric!r} is unknown; the nearest ones: {nearest_few(metric, known)}")
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _cell_name(cell: Mapping[str, Any]) -> str:
    """The name of a cell in messages."""
    return f"cell [{label(cell)}]"


def overridden(values: Mapping[str, Any], changes: Mapping[str, Any], cell: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of ``values`` with ``changes`` applied; errors name the cell."""
    result = copy.deepcopy(dict(values))
    try:
        for key, value in changes.items():
            override(result, key, copy.deepcopy(value))
    except ValueError as error:
        raise ValueError(f"{_cell_name(cell)}: {error}") from None
    return result


def _sorted(value: Any) -> Any:
    """The value with the keys of all its mappings in alphabetical order."""
    if isinstance(value, Mapping):
        return {key: _sorted(value[key]) for key in sorted(value, key=str)}
    return [_sorted(each) for each in value] if isinstance(value, list) else value


def short_names(paths: Sequence[str]) -> dict[str, str]:
    """Short names of config files and paths of classes: stems and classes, or all as given if two of them are equal."""
    stems = [Path(directory_name(path)).stem for path in paths]
    return dict(zip(paths, stems if len(set(stems)) == len(stems) else paths, strict=True))


def refuse_duplicates(rows: Sequence[ManifestRow]) -> None:
    """Refuse two cells that are the same run."""
    seen: dict[str, ManifestRow] = {}
    for row in rows:
        other = seen.setdefault(row.id, row)
        if other is not row:
            raise ValueError(
                f"cells [{label(other.cell)}] and [{label(row.cell)}] have the same run (seed {row.seed}, {row.id}): "
                "they do not differ in anything that affects its result"
            )


def write_manifest(sweep: Path, rows: Sequence[ManifestRow]) -> Path:
    """Write the manifest into a sweep's directory, atomically; returns its path."""
    sweep.mkdir(parents=True, exist_ok=True)
    path = own_path(sweep, FILE)
    for row in rows:
        own_path(sweep, row.directory)
    atomic_write(path, (row.line() for row in rows))
    return path


def is_sweep(path: Path) -> bool:
    """Whether a directory is that of a sweep."""
    return (path / FILE).is_file()


def read_manifest(sweep: Path) -> list[ManifestRow]:
    """All rows of a sweep's manifest; errors as of :func:`iterate_manifest`."""
    return list(iterate_manifest(sweep))


def iterate_manifest(sweep: Path) -> Iterator[ManifestRow]:
    """The rows of a sweep's manifest, one at a time, because all of a large sweep take much memory."""
    path, rows = sweep / FILE, TypeAdapter(ManifestRow)
    if not path.is_file():
        raise ValueError(f"{str(sweep)!r} is neither a sweep nor a study: it has no {FILE}")
    with path.open("rb") as lines:
        for number, line in enumerate(lines, 1):
            try:
                yield rows.validate_json(line)
            except ValidationError as error:
                problem = error.errors(include_url=False)[0]
                field = f"{'.'.join(map(str, problem['loc']))} = {problem['input']!r}: " if problem["loc"] else ""
                raise ValueError(
                    f"manifest {str(path)!r} is broken in line {number}: {field}{problem['msg']}"
                ) from None
