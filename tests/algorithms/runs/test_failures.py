"""What becomes of runs that end with an error, wherever they were trained."""

from __future__ import annotations

from pathlib import Path

import pytest

from algorithms.runs.config import make_experiment
from algorithms.runs.failures import WorkerDied, record, verdict
from algorithms.runs.interrupts import DiskFull, JobFailed, Stopped
from algorithms.runs.jobs import Job
from algorithms.runs.run_directory import InUse, Run, read_status
from tests.helpers.short_runs import VALUES


@pytest.mark.parametrize(
    ("error", "verdicts"),
    [
        (DiskFull("full"), ["stop", "stop", "stop"]),
        (InUse("held"), ["wait", "wait", "wait"]),
        (WorkerDied("killed"), ["retry", "retry", "fail"]),
        (Stopped("unwritable"), ["retry", "retry", "fail"]),
        (OSError("unreadable"), ["retry", "retry", "fail"]),
        (JobFailed("KeyError: 'x'"), ["fail", "fail", "fail"]),
        (ValueError("invalid"), ["fail", "fail", "fail"]),
    ],
)
def test_what_a_retry_may_mend_is_retried_as_often_as_allowed(error: Exception, verdicts: list[str]) -> None:
    assert [verdict(error, attempts, retries=2) for attempts in (1, 2, 3)] == verdicts


def test_a_death_is_written_to_the_status_of_the_run_which_could_not_do_so_itself(tmp_path: Path) -> None:
    job = Job("run", make_experiment(VALUES), tmp_path / "run")
    assert record(job, WorkerDied("killed")) == "killed"  # before the directory existed
    Run.create(job.experiment, job.path).unlock()
    assert record(job, WorkerDied("killed")) == "killed"
    status = read_status(job.path)
    assert (status["state"], status["reason"]) == ("failed", "killed")
