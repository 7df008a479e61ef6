"""Compare the finished runs of a sweep with the records of their files, and discard those that differ."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

from algorithms.runs.run_directory import read_status
from algorithms.runs.run_files import RESULTS, changed_files
from algorithms.studies.manifest import iterate_manifest
from mo_deepdrive.support.atomic_io import own_path

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from algorithms.studies.manifest import ManifestRow


def verify(sweep: Path, say: Callable[[str], None]) -> list[tuple[ManifestRow, list[str]]]:
    """Check all files of the finished runs of a sweep.

    Args:
        sweep: its directory.
        say: called with a line about each run that is broken, and with a summary.

    Returns:
        The broken runs, each with what is broken.

    Raises:
        ValueError: if the directory has no manifest.
    """
    finished = 0
    broken = []
    for row in iterate_manifest(sweep):
        run = sweep / row.directory
        if read_status(run).get("state") != "finished":
            continue
        finished += 1
        problems = changed_files(run)
        if problems:
            broken.append((row, problems))
            say(f"{run}: {'; '.join(problems)}")
    say(f"{finished} finished runs: {len(broken)} broken")
    return broken


def discard(sweep: Path, row: ManifestRow, problems: list[str]) -> None:
    """Make a broken run one that is not finished, so that training the sweep makes it again.

    A run of which only the final evaluation is broken is evaluated again from its checkpoint; any other is deleted.

    Args:
        sweep: the directory of the sweep.
        row: of the run.
        problems: what is broken, from :func:`verify`.

    Raises:
        ValueError: if a link leads out of the sweep, or another process uses the run.
        OSError: if it cannot be changed or deleted.
    """
    directory = own_path(sweep, row.directory)
    if not {problem.partition(":")[0] for problem in problems} <= set(RESULTS):
        shutil.rmtree(directory)
        return
    run = row.job(sweep).open()
    run.lock()
    run.set_status("trained", run.status.get("step", 0))
    run.unlock()
