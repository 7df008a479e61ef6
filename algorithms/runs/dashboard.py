"""The progress of many runs, read from their directories: a live table on a terminal, periodic lines otherwise."""

from __future__ import annotations

from collections import Counter
from datetime import timedelta
from time import monotonic
from typing import TYPE_CHECKING, Any

from rich.console import Console, Group
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from algorithms.runs.console import LINE_INTERVAL, LiveDisplay, print_line
from algorithms.runs.run_directory import read_status

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path
    from types import TracebackType

    from algorithms.runs.jobs import Job

# The name of each state in the table.
SHOWN = {
    "finished": "done",
    "pruned": "pruned",
    "failed": "failed",
    "running": "running",
    "trained": "running",
    "interrupted": "interrupted",
    None: "waiting",
}
ENDED = ("finished", "pruned")
READING_SHARE = 0.05  # largest share of the time that is spent reading directories
MOST_ROWS = 12  # running jobs that are listed


def count_states(states: Iterable[Any]) -> Counter[str]:
    """The number of runs in each state, by the names in the table; the states are those of status.json or None."""
    return Counter(SHOWN[state] for state in states)


def summary_of(counts: Counter[str]) -> str:
    """The result of :func:`count_states` in one line."""
    always = ("done", "running", "failed", "waiting")
    parts = [f"{counts[name]} {name}" for name in always]
    parts += [f"{counts[name]} {name}" for name in ("interrupted", "pruned") if counts[name]]
    return f"{', '.join(parts)} of {counts.total()}"


class Dashboard:
    """Shows how many runs are done, running, failed and waiting, the running ones, and the time left.

    Use it as a context manager and call :meth:`update` often; it reads the directories at longer intervals.

    Args:
        jobs: the runs.
        console: where to print.
        title: heading of the table.
    """

    def __init__(self, jobs: Sequence[Job], console: Console, title: str = "runs"):
        self._jobs = list(jobs)
        self._console = console
        self._title = title
        self._status: dict[Path, dict[str, Any]] = {}
        self._failed: dict[Path, str] = {}
        self._display = LiveDisplay(console, "the progress", self._table)
        self._start_time = self._print_time = monotonic()
        self._next_update = 0.0
        self._read()
        self._steps_at_start = self._steps_done()

    @property
    def counts(self) -> Counter[str]:
        """The number of runs in each state, by the names in the table."""
        return count_states(map(self._state, self._jobs))

    @property
    def seconds_left(self) -> float | None:
        """Seconds until all runs are done, at the mean speed since the start; None before the first new step."""
        done = self._steps_done() - self._steps_at_start
        return self._steps_left() * (monotonic() - self._start_time) / done if done > 0 else None

    def failed(self, job: Job, reason: str) -> None:
        """Mark a run as failed and print the reason."""
        self._failed[job.path] = reason
        print_line(self._console, f"FAILED {job.name}: {reason}")

    def update(self, now: bool = False) -> None:
        """Read and show the progress if the last update is long enough ago, or if ``now`` is true."""
        started = monotonic()
        if not now and started < self._next_update:
            return
        self._read()
        self._next_update = monotonic() + max(1.0, (monotonic() - started) / READING_SHARE)
        if self._display.shown:
            self._display.refresh()
        elif started - self._print_time >= LINE_INTERVAL:
            self._line()

    def _state(self, job: Job) -> Any:
        return "failed" if job.path in self._failed else self._status.get(job.path, {}).get("state")

    def _read(self) -> None:
        for job in self._jobs:
            before = self._status.get(job.path, {}).get("state")
            if before not in ENDED:
                self._status[job.path] = read_status(job.path)

    def _steps_done(self) -> int:
        """Steps up to the last checkpoints, over all runs."""
        return sum(self._step(job) for job in self._jobs)

    def _steps_left(self) -> int:
        """Steps until all runs are done, without those that have ended or failed."""
        return sum(
            job.experiment.training.total_timesteps - self._step(job)
            for job in self._jobs
            if self._state(job) not in (*ENDED, "failed")
        )

    def _step(self, job: Job) -> int:
        return min(job.experiment.training.total_timesteps, int(self._status.get(job.path, {}).get("step", 0)))

    def summary(self) -> str:
        """One line: the number of runs in each state, and the time left."""
        left = self.seconds_left
        time_left = "" if not left else f", {timedelta(seconds=round(left))} left"
        return summary_of(self.counts) + time_left

    def _line(self) -> None:
        self._print_time = monotonic()
        print_line(self._console, f"{self._title}: {self.summary()}")

    def _table(self) -> Group:
        head = Table.grid(padding=(0, 2))
        done, left = self._steps_done(), self._steps_left()
        head.add_row(
            Text(self._title, style="bold", overflow="fold"),
            ProgressBar(max(1, done + left), done if left else max(1, done), width=30),
            Text(self.summary()),
        )
        running = [job for job in self._jobs if SHOWN[self._state(job)] == "running"]
        rows = Table.grid(padding=(0, 2))
        for job in running[:MOST_ROWS]:
            steps, total = self._status[job.path].get("step", 0), job.experiment.training.total_timesteps
            rows.add_row(ProgressBar(total, steps, width=16), Text(f"{steps / total:.0%}"), Text(job.name))
        more = len(running) - MOST_ROWS
        return Group(head, rows, *([Text(f"and {more} more")] if more > 0 else []))

    def __enter__(self) -> Dashboard:
        self._display.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._display.shown:
            self._display.stop()
        elif self._jobs:
            self._line()
