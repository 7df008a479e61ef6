"""What comparisons of learners with the same tuning for each share: which runs are made, and their file.

Every learner is trained once with each learning rate of :data:`RATES`, with a seed of its own, scored on the validation
split. The best rate is then trained with the seeds that count, scored on the test split. Runs that the file has already
are not repeated, so that a comparison can be continued. Every run is a new process on one thread.
"""

from __future__ import annotations

import multiprocessing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import paired_benchmark
from result_file import check_folder, check_least, read_results, write_results
from rich.progress import track

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
    first: Annotated[float, ".6g"]
    second: Annotated[float, ".6g"]
    seconds: Annotated[float, ".1f"]

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
    done = {result.key: float(f"{result.first:.6g}") for result in results}  # with the digits that the file has
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
        ValueError: if ``path`` is another file, or the seeds that count have that of the tuning.
        OSError: if it cannot be written.
    """
    if TUNING_SEED in seeds:
        raise ValueError(f"seeds = {min(seeds)} to {max(seeds)}: {TUNING_SEED} is that of the tuning; take fewer seeds")
    results = read_results(path, Result)
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


def add_arguments(parser: ArgumentParser, tasks: Sequence[str]) -> None:
    """The options that the comparisons share."""
    parser.add_argument("--seeds", type=int, default=5, help="runs of each learner that count (default: %(default)s)")
    parser.add_argument("--only", nargs="+", choices=tasks, default=list(tasks), help="tasks; default: all")
    parser.add_argument("--workers", type=int, default=1, help="runs at the same time (default: %(default)s)")
    parser.add_argument("--output", type=Path, required=True, help="CSV file of every run, continued if it exists")


def check_arguments(parser: ArgumentParser, arguments: Namespace) -> None:
    """Exit with a message unless the options that the comparisons share are valid."""
    check_least(parser, arguments, 1, "seeds", "workers")
    check_folder(parser, arguments.output)
