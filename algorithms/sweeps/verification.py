"""Check the finished runs of a sweep against the record of their files, and have those that differ made again."""

from __future__ import annotations

from itertools import count
from typing import TYPE_CHECKING

from algorithms.experiments.run_directory import read_status
from algorithms.experiments.run_files import NOT_RECORDED, RESULTS, broken_files
from algorithms.sweeps.manifest import iterate_manifest

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from algorithms.experiments.jobs import Job

FOLDER = "broken"


def verify(sweep: Path, say: Callable[[str], None]) -> None:
    """Check all files of the finished runs of a sweep, so that training it makes again what is broken.

    A run of which only the final evaluation is broken is evaluated again from its checkpoint. Any other is moved to
    ``SWEEP/broken/NAME-N`` and trained anew. Runs of earlier versions, which have no record, are kept.

    Args:
        sweep: its directory.
        say: called with a line about each broken run, and with a summary.

    Raises:
        ValueError: if the directory has no manifest.
        OSError: if a run cannot be moved or changed.
    """
    finished = broken = unknown = 0
    for row in iterate_manifest(sweep):
        run = sweep / row.directory
        if read_status(run).get("state") != "finished":
            continue
        finished += 1
        problems = broken_files(run)
        if problems == [NOT_RECORDED]:
            unknown += 1
        elif problems:
            broken += 1
            say(f"{run}: {'; '.join(problems)}: {_discard(row.job(sweep), sweep / FOLDER, problems)}")
    recorded = "" if unknown == 0 else f", {unknown} cannot be checked because an earlier version made them"
    say(f"{finished} finished runs: {broken} broken{recorded}")


def _discard(job: Job, folder: Path, problems: Sequence[str]) -> str:
    """Make a broken run one that is not finished; returns what will be done with it."""
    if {problem.partition(":")[0] for problem in problems} <= set(RESULTS):
        opened = job.open(device="cpu")  # this machine may not have the run's device
        opened.lock()
        opened.set_status("trained", opened.status.get("step", 0))
        opened.unlock()
        return "evaluated again"
    folder.mkdir(exist_ok=True)
    target = next(path for number in count(1) if not (path := folder / f"{job.path.name}-{number}").exists())
    job.path.rename(target)
    return f"moved to {target}, made again"
