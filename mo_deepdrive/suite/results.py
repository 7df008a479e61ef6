"""The format of all results, from a scored policy to the scoreboard.

One number of a run is a row of a CSV file. Beside that is a folder with the samples that the scores of the suite are
made of, a file per task: results.csv has results_samples/K3.npz, with arrays (scenarios, k) named "learner/seed".
"""

from __future__ import annotations

import csv
import zipfile
import zlib
from collections import defaultdict
from dataclasses import astuple, dataclass, fields
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import FiniteFloat, TypeAdapter, ValidationError, model_validator

from mo_deepdrive.evaluation.metrics import FRONT, GREEDY, POLICIES, STOCHASTIC
from mo_deepdrive.suite.scorers import CONTROLLABILITY, CVAR, SCORE, SCORERS, WORST, of_rulebook
from mo_deepdrive.suite.tasks import load
from mo_deepdrive.support.atomic_io import atomic_write, csv_bytes, own_path
from mo_deepdrive.support.names import nearest

if TYPE_CHECKING:
    from collections.abc import Sequence

FAILED = "failed"  # the state of a run that has the lowest score
SIGNIFICANT_BITS = 13  # of the samples that are kept
ROUNDING = 1e-3  # by which a normalised score and that of its samples may differ
Samples = dict[tuple[str, str, int], NDArray[np.float32]]  # of the ranked score, (E, k), by task, learner and seed


@dataclass(frozen=True)
class Row:
    """One number of a scored run; a run that has none, since it failed or has not ended, has one row that says so."""

    task: str  #: the id of a task of the suite, or the name of one of a study
    learner: str  #: what was trained
    seed: int  #: by which it was trained
    policy: str  #: "greedy", "stochastic" or "front"; "" without a value
    #: "score", a perturbation of the suite, or what a scorer gives beside the score; of other tasks a metric of the
    #: final evaluation; "" without a value.
    column: str
    value: FiniteFloat | None  #: the number, not normalised; None where there is none
    #: Ends of its 95% bootstrap interval over the scenarios; None where it has none.
    low: FiniteFloat | None = None
    high: FiniteFloat | None = None
    source: str = ""  #: the run or policy that was scored
    state: str = "finished"  #: of the training
    cpu_seconds: FiniteFloat | None = None  #: of the training; None where it is not known
    version: int = 0  #: of the suite; 0 for what is not of it
    steps: int | None = None  #: environment steps of the training; None where they are not known
    environment: str = ""  #: in which it was trained: its id, and arguments that are not the default

    @property
    def key(self) -> tuple[str, str, int, str, str]:
        """What there is one row of."""
        return self.task, self.learner, self.seed, self.policy, self.column

    @property
    def normalised(self) -> float | None:
        """With the floor as 0 and the ceiling as 1; None for what is not on the scale of the score."""
        suite = load()
        if self.value is None or (self.column != SCORE and self.column not in suite.perturbations):
            return None
        return float(suite.task(self.task).normalised(self.value))

    @model_validator(mode="after")
    def _is_consistent(self) -> Row:
        """Refuse what no scored run has, when rows are read."""
        if self.policy not in POLICIES and (self.policy or self.value is not None):
            raise ValueError(f"policy = {self.policy!r} must be {GREEDY!r}, {STOCHASTIC!r} or {FRONT!r}")
        if (self.low is None) != (self.high is None):
            raise ValueError(f"low = {self.low} and high = {self.high} must both be given, or neither")
        if self.value is None and self.low is not None:
            raise ValueError(f"low = {self.low} without a value")
        if self.value is not None and self.state == FAILED:
            raise ValueError(f"value = {self.value} of a run that failed, which has none")
        if self.low is not None and not self.low <= self.value <= self.high:  # type: ignore[operator]
            raise ValueError(f"value = {self.value} must be from low = {self.low} to high = {self.high}")
        return self


_ROW = TypeAdapter(Row)
REQUIRED = {"task", "learner", "seed", "policy", "column", "value"}


def write_rows(path: str | Path, rows: Sequence[Row]) -> None:
    """Write rows as CSV, a column for each attribute; the file is complete or unchanged."""
    names = [field.name for field in fields(Row)]
    atomic_write(Path(path), csv_bytes([names, *map(astuple, rows)]))


def read_rows(path: str | Path) -> list[Row]:
    """The rows that :func:`write_rows` wrote, each of them valid, and each number there once.

    Of another file a ValueError, naming the line and what is wrong in it.
    """
    columns = {field.name: field.type == "str" for field in fields(Row)}  # by name, whether it is text
    rows: dict[tuple[Any, ...], Row] = {}
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as file:  # spreadsheets begin with a BOM
            lines = csv.DictReader(file)
            names = {*(lines.fieldnames or ())}
            if not REQUIRED <= names <= {*columns}:
                raise ValueError(f"its columns must be {', '.join(columns)}")
            for line in lines:
                where = f"line {lines.line_num}"
                if None in line or None in line.values():
                    raise ValueError(f"{where} must have {len(names)} cells")
                row = _parse({name: text for name, text in line.items() if text or columns[name]}, where)
                if rows.setdefault(row.key, row) is not row:
                    raise ValueError(f"{where}: a second row of {', '.join(map(str, row.key))}")
    except FileNotFoundError:
        raise ValueError(f"{str(path)!r} does not exist") from None
    except (OSError, ValueError, csv.Error) as error:
        raise ValueError(f"{str(path)!r} is not a table of scores: {error}") from None
    return list(rows.values())


def _parse(cells: dict[str, str], where: str) -> Row:
    try:
        return _ROW.validate_python({"value": None, **cells})
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        name = f"{problem['loc'][0]} = {problem['input']!r}: " if problem["loc"] else ""
        raise ValueError(f"{where}: {name}{problem['msg'].removeprefix('Value error, ')}") from None


def write_samples(path: str | Path, samples: Samples) -> None:
    """Write the samples of the scores of a file ``path`` beside it; each file is complete or unchanged."""
    by_task: dict[str, dict[str, NDArray[np.float32]]] = defaultdict(dict)
    for (task, learner, seed), part in samples.items():
        by_task[task][f"{learner}/{seed}"] = part
    for task, parts in by_task.items():
        file, buffer = own_path(Path(path).parent, f"{Path(path).stem}_samples/{task}.npz"), BytesIO()
        np.savez_compressed(buffer, **parts)  # type: ignore[arg-type]  # the names are no arguments of it
        file.parent.mkdir(exist_ok=True)
        atomic_write(file, buffer.getvalue())


def rounded(samples: NDArray[np.float64]) -> NDArray[np.float32]:
    """Samples as they are kept: to SIGNIFICANT_BITS, so that they are compressed by half."""
    mantissa, exponent = np.frexp(samples)
    scale = 2.0**SIGNIFICANT_BITS
    return np.ldexp(np.round(mantissa * scale) / scale, exponent).astype(np.float32)


def read_samples(path: str | Path) -> Samples:
    """The samples that :func:`write_samples` wrote beside a file ``path``; none if there are none.

    Of a broken file a ValueError that names it.
    """
    samples: Samples = {}
    for file in sorted(Path(path).with_name(f"{Path(path).stem}_samples").glob("*.npz")):
        try:
            with np.load(file, allow_pickle=False) as parts:
                for name, part in parts.items():
                    learner, _, seed = name.rpartition("/")
                    if part.dtype != np.float32 or part.ndim != 2 or not part.size or not np.isfinite(part).all():
                        raise ValueError(f"{name!r} must be finite numbers (scenarios, k) of type float32")
                    samples[file.stem, learner, int(seed)] = part
        except (OSError, ValueError, TypeError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
            raise ValueError(f"{str(file)!r} is not a file of samples: {error}") from None
    return samples


def samples_of(rows: Sequence[Row], samples: Samples) -> Samples:
    """The samples of the ranked scores in ``rows``, of runs that were scored in all scenarios of a task.

    A ValueError where a score is not the one of its samples.
    """
    matching: Samples = {}
    for row in rows:
        task, part = load().tasks.get(row.task), samples.get((row.task, row.learner, row.seed))
        if task is None or part is None or (row.policy, row.column) != (task.policy, SCORE):
            continue
        score = float(SCORERS[task.score].score(task, part.mean(axis=0, dtype=np.float64)))
        if row.normalised is None or not abs(task.normalised(score) - row.normalised) <= ROUNDING:
            raise ValueError(
                f"the samples of {row.learner}, seed {row.seed}, on {row.task} have the score {score:.6g}, and the row "
                f"has {row.value}: they are not of one evaluation"
            )
        if len(part) == task.episodes:
            matching[row.task, row.learner, row.seed] = part
    return matching


def check_of_suite(row: Row) -> None:
    """Refuse what is not of this version of the suite, or not one of its numbers.

    The ValueError names the attribute, its value and what is allowed.
    """
    suite = load()
    # Before what another version may not have; a run without a score may have no version.
    if row.version != suite.version and (row.version or row.value is not None):
        raise ValueError(f"version {row.version} of the suite; this is version {suite.version}")
    if row.task not in suite.tasks:
        raise ValueError(f"task = {row.task!r} is unknown; {nearest(row.task, list(suite.tasks))}")
    if row.steps is not None and row.steps > (limit := suite.task(row.task).steps):
        raise ValueError(f"steps = {row.steps:,}; task {row.task} allows {limit:,}")
    if row.value is None:
        return
    if row.policy not in (GREEDY, STOCHASTIC):
        raise ValueError(f"policy = {row.policy!r} must be {GREEDY!r} or {STOCHASTIC!r}")
    known = [SCORE, CVAR, WORST, CONTROLLABILITY, *suite.perturbations]
    if (task := suite.task(row.task)).rulebook is not None:
        known += of_rulebook(task)
    if row.column.partition("/")[0] not in known:
        raise ValueError(f"column = {row.column!r} is unknown; {nearest(row.column, known)}")
