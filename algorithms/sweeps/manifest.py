"""From a sweep to its manifest: one line of JSON per run, the same bytes on every machine and for every engine."""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

from algorithms.common.atomic_io import atomic_write
from algorithms.common.yaml_io import read_mapping
from algorithms.experiments.build import build
from algorithms.experiments.config import Experiment, make_experiment, override
from algorithms.experiments.jobs import NOT_COMPARED, Job
from algorithms.sweeps.search import Scores, propose
from algorithms.sweeps.settings import SweepSettings

FILE = "manifest.jsonl"
RUNS = "runs"
MOST_PROBLEMS = 5
ID_DIGITS = 12


@dataclass(frozen=True)
class Row:
    """A line of the manifest: a run that is wanted.

    Attributes:
        id: hexadecimal; a hash of everything in ``config`` that changes what comes out of the run.
        directory: of the run, within the sweep's; it has algorithm, seed and id.
        cell: what distinguishes the run's cell from the others, by key.
        seed: of the run.
        trial: number of the search's point; None without a search.
        config: the resolved experiment.
    """

    id: str
    directory: str
    cell: dict[str, Any]
    seed: int
    trial: int | None
    config: dict[str, Any]

    @property
    def name(self) -> str:
        """For people."""
        return f"{label(self.cell)} seed {self.seed} ({self.id})".strip()

    def job(self, sweep: Path) -> Job:
        """The run of a sweep that has the directory ``sweep``."""
        return Job(self.name, make_experiment(self.config, here=False), sweep / self.directory, self.id)


def label(cell: Mapping[str, Any]) -> str:
    """A cell in words: ``algorithm.learning_rate=0.001 training.num_envs=16``."""
    return " ".join(
        f"{key}={value if isinstance(value, str) else json.dumps(value, default=str)}" for key, value in cell.items()
    )


def run_id(config: Mapping[str, Any]) -> str:
    """The id of a resolved experiment: the beginning of the SHA-256 of its canonical JSON.

    Where it runs (device, threads) and what it logs are left out, for they do not change what comes out.
    """
    counted = copy.deepcopy(dict(config))
    for key in NOT_COMPARED:
        *sections, last = key.split(".")
        place = counted
        for section in sections:
            place = place[section]
        place.pop(last, None)
    text = json.dumps(counted, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:ID_DIGITS]


def expand(settings: SweepSettings, scores: Scores) -> list[Row]:
    """The runs of a sweep, every experiment resolved and every cell built once.

    Args:
        settings: the sweep.
        scores: of the runs that have ended, by id; a search goes on from them, so that the last rows are those of the
            batch that has not ended.

    Raises:
        ValueError: naming each cell that is wrong, and what is wrong with it; or two cells that are the same run.
    """
    bases = {path: read_mapping(path) for path in settings.config}
    names = _names(settings.config)
    rows: list[Row] = []
    problems: list[str] = []
    combinations = list(product(bases, *settings.grid.values()))
    for path, *values in combinations:
        grid = dict(zip(settings.grid, values, strict=True))
        cell = {"config": names[path], **grid} if len(bases) > 1 else grid
        try:
            base = _overridden(bases[path], {**settings.overrides, **grid}, cell)
            rows += _searched(settings, cell, base, scores) if settings.search else _seeds(settings, cell, base)
        except ValueError as error:
            problems.append(str(error))
    if problems:
        more = len(problems) - MOST_PROBLEMS
        shown = [*problems[:MOST_PROBLEMS], *([f"and {more} more"] if more > 0 else [])]
        raise ValueError(f"{len(problems)} of {len(combinations)} cells are wrong:\n  " + "\n  ".join(shown))
    _refuse_repeated(rows)
    return rows


def _searched(settings: SweepSettings, cell: dict[str, Any], base: dict[str, Any], scores: Scores) -> list[Row]:
    assert settings.search is not None
    rows: list[Row] = []

    def runs_of(trial: int, point: dict[str, Any]) -> list[str]:
        here = {**cell, **point}
        found = _seeds(settings, here, _overridden(base, point, here), trial)
        known = {row.id for row in rows}  # a point may be chosen again
        rows.extend(row for row in found if row.id not in known)
        return [row.id for row in found]

    propose(settings.search, runs_of, scores)
    return rows


def _seeds(
    settings: SweepSettings, cell: dict[str, Any], values: dict[str, Any], trial: int | None = None
) -> list[Row]:
    """The rows of one cell."""
    where = _place(cell)
    rows: list[Row] = []
    for seed in settings.seeds:
        experiment = make_experiment(_overridden(values, {"training.seed": seed}, cell), where, here=False)
        if not rows:
            _try(experiment, where)
        config = _sorted(experiment.to_dict())
        name = run_id(config)
        directory = f"{RUNS}/{experiment.algorithm['name']}-seed{seed}-{name}"
        rows.append(Row(name, directory, cell, seed, trial, config))
    return rows


def _try(experiment: Experiment, where: str) -> None:
    """Refuse what would be refused when the run begins."""
    settings = experiment.training.model_copy(update={"device": "cpu"})  # the run's may be on another machine
    try:
        build(experiment.model_copy(update={"training": settings}), num_envs=1)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _place(cell: Mapping[str, Any]) -> str:
    """For messages."""
    return f"cell [{label(cell)}]"


def _overridden(values: Mapping[str, Any], changes: Mapping[str, Any], cell: Mapping[str, Any]) -> dict[str, Any]:
    """The values with the changes; errors name the cell."""
    result = copy.deepcopy(dict(values))
    try:
        for key, value in changes.items():
            override(result, key, copy.deepcopy(value))
    except ValueError as error:
        raise ValueError(f"{_place(cell)}: {error}") from None
    return result


def _sorted(value: Any) -> Any:
    """The same, whatever the order in which the keys of its mappings were written."""
    if isinstance(value, Mapping):
        return {key: _sorted(value[key]) for key in sorted(value)}
    return [_sorted(each) for each in value] if isinstance(value, list) else value


def _names(paths: Sequence[str]) -> dict[str, str]:
    """Short names of config files: their stems, or the paths where stems repeat."""
    stems = [Path(path).stem for path in paths]
    return dict(zip(paths, stems if len(set(stems)) == len(stems) else paths, strict=True))


def _refuse_repeated(rows: Sequence[Row]) -> None:
    seen: dict[str, Row] = {}
    for row in rows:
        other = seen.setdefault(row.id, row)
        if other is not row:
            raise ValueError(
                f"cells [{label(other.cell)}] and [{label(row.cell)}] have the same run (seed {row.seed}, {row.id}): "
                "they differ in nothing that changes what comes out of it"
            )


def manifest_bytes(rows: Sequence[Row]) -> bytes:
    """The text of a manifest."""
    lines = [json.dumps(asdict(row), separators=(",", ":"), allow_nan=False) for row in rows]
    return "".join(line + "\n" for line in lines).encode()


def write_manifest(sweep: Path, rows: Sequence[Row]) -> Path:
    """Write the manifest into a sweep's directory, atomically; its path.

    Raises:
        OSError: if it cannot be written.
    """
    sweep.mkdir(parents=True, exist_ok=True)
    path = sweep / FILE
    atomic_write(path, manifest_bytes(rows))
    return path


def is_sweep(path: Path) -> bool:
    """Whether a directory is a sweep's."""
    return (path / FILE).is_file()


def read_manifest(sweep: Path) -> list[Row]:
    """The rows of a sweep's manifest.

    Raises:
        ValueError: if it is missing or broken.
    """
    path = sweep / FILE
    if not path.is_file():
        raise ValueError(f"{str(sweep)!r} is not a sweep: it has no {FILE}")
    rows = []
    for number, line in enumerate(path.read_bytes().splitlines(), 1):
        try:
            rows.append(Row(**json.loads(line)))
        except (TypeError, ValueError) as error:
            raise ValueError(f"manifest {str(path)!r} is broken in line {number}: {error}") from None
    return rows
