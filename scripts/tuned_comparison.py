"""What comparisons of learners with the same tuning for each share: which runs are made, and their file.

Every learner is trained once with each learning rate of :data:`RATES`, with a seed of its own, scored on the validation
split. The best rate is then trained with the seeds that count, scored on the test split. Runs that the file has already
are not repeated, so that a comparison can be continued. Every run is a new process on one thread.
"""

from __future__ import annotations

import csv
import multiprocessing
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

import paired_benchmark
from rich.progress import track

from algorithms.common.atomic_io import atomic_write, csv_bytes

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace
    from collections.abc import Callable, Iterator, Sequence

RATES = (1.0, 3.0, 1 / 3)  # learning rates that are tried, in units of the default
TUNING_SEED = 100


@dataclass(frozen=True)
class Run:
    """One run.

    Attributes:
        task: what is learnt.
        learner: what learns.
        rate: one of :data:`RATES`.
        seed: of the run.
        steps: environment steps.
    """

    task: str
    learner: str
    rate: float
    seed: int
    steps: int

    @property
    def key(self) -> tuple[str, str, str, int, int]:
        """What tells it from other runs; a learner that trains in rounds may take a few more steps than it is given."""
        return self.task, self.learner, f"{self.rate:.3g}", self.seed, self.steps


@dataclass(frozen=True)
class Result:
    """What a run achieved.

    Attributes:
        task, learner, rate, seed, steps: as of :class:`Run`.
        taken: environment steps that were taken.
        first, second: the scores of the task; the first one chooses the learning rate.
        seconds: CPU time of the training.
    """

    task: str
    learner: str
    rate: str
    seed: int
    steps: int
    taken: int
    first: float
    second: float
    seconds: float

    @property
    def key(self) -> tuple[str, str, str, int, int]:
        """As of its run."""
        return self.task, self.learner, self.rate, self.seed, self.steps


def missing_runs(
    results: Sequence[Result], learners: Sequence[tuple[str, str, int]], seeds: Sequence[int]
) -> list[Run]:
    """The runs that can be made now: tuning first, and for learners that are tuned, the seeds that count.

    Args:
        results: of the runs that have been made.
        learners: triples of task, learner and steps.
        seeds: those that count.
    """
    done = {result.key: result.first for result in results}
    runs = []
    for task, learner, steps in learners:
        tuning = [Run(task, learner, rate, TUNING_SEED, steps) for rate in RATES]
        runs += [run for run in tuning if run.key not in done]
        if all(run.key in done for run in tuning):
            best = max(tuning, key=lambda run: done[run.key])
            final = [Run(task, learner, best.rate, seed, steps) for seed in seeds]
            runs += [run for run in final if run.key not in done]
    return runs


def complete(
    path: Path,
    learners: Sequence[tuple[str, str, int]],
    seeds: Sequence[int],
    learn: Callable[[Run], Result],
    workers: int,
) -> list[Result]:
    """Make the missing runs of a comparison, ``workers`` at a time, and write each result to ``path``; all results.

    Raises:
        ValueError: if ``path`` is another file.
        OSError: if it cannot be written.
    """
    results = read_results(path)
    while runs := missing_runs(results, learners, seeds):
        for result in track(_learn_in_new_processes(learn, runs, workers), total=len(runs)):
            results.append(result)
            write_results(path, results)
    return results


def _learn_in_new_processes(learn: Callable[[Run], Result], runs: Sequence[Run], workers: int) -> Iterator[Result]:
    """The results of ``runs``, as they finish, each from a process of its own with one thread."""
    context = multiprocessing.get_context("spawn")
    with paired_benchmark.one_thread_each(), context.Pool(workers, maxtasksperchild=1) as pool:
        yield from pool.imap_unordered(learn, runs, chunksize=1)


def read_results(path: Path) -> list[Result]:
    """The results that :func:`write_results` wrote to ``path``; an empty list if the file does not exist.

    Raises:
        ValueError: if it is another file.
    """
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    try:
        kinds = {field.name: {"int": int, "float": float, "str": str}[str(field.type)] for field in fields(Result)}
        return [Result(**{name: kind(row[name]) for name, kind in kinds.items()}) for row in rows]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is not a file of this script: {type(error).__name__}: {error}") from None


def write_results(path: Path, results: Sequence[Result]) -> None:
    """Write one row per run as CSV, atomically."""
    rows = [[field.name for field in fields(Result)]]
    for result in results:
        cells = asdict(result) | {"seconds": f"{result.seconds:.1f}"}
        cells |= {name: f"{cells[name]:.6g}" for name in ("first", "second")}
        rows.append([str(cell) for cell in cells.values()])
    atomic_write(path, csv_bytes(rows))


def add_arguments(parser: ArgumentParser, tasks: Sequence[str]) -> None:
    """The options that the comparisons share."""
    parser.add_argument("--seeds", type=int, default=5, help="runs of each learner that count (default: %(default)s)")
    parser.add_argument("--only", nargs="+", choices=tasks, default=list(tasks), help="tasks; default: all")
    parser.add_argument("--workers", type=int, default=1, help="runs at the same time (default: %(default)s)")
    parser.add_argument("--output", type=Path, required=True, help="CSV file of every run, continued if it exists")


def check_arguments(parser: ArgumentParser, arguments: Namespace) -> None:
    """Exit with a message unless the options that the comparisons share are valid."""
    for name in ("seeds", "workers"):
        if getattr(arguments, name) < 1:
            parser.error(f"--{name} {getattr(arguments, name)} must be at least 1")
    if not arguments.output.parent.is_dir():
        parser.error(f"--output {arguments.output}: there is no folder {arguments.output.parent}")
