"""How far many runs are, read from their directories: a live table on a terminal, an occasional line elsewhere."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path
from time import monotonic
from types import TracebackType
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from algorithms.experiments.jobs import Job
from algorithms.experiments.progress_bar import LINE_INTERVAL
from algorithms.experiments.run_directory import read_status

# What a run's state is called in the table.
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
BUSY_PART = 0.05  # of the time that may go into reading directories
MOST_ROWS = 12


class Dashboard:
    """Shows how many runs are done, running, failed and waiting, those that are running, and the time left.

    Use it as a context manager and call :meth:`update` often: it reads the directories once in a while.

    Args:
        jobs: the runs.
        console: where to write.
        title: what they are.
    """

    def __init__(self, jobs: Sequence[Job], console: Console, title: str = "runs"):
        self._jobs = list(jobs)
        self._console = console
        self._title = title
        self._status: dict[Path, dict[str, Any]] = {}
        self._failed: dict[Path, str] = {}
        self._live: Live | None = None
        self._began = self._told = monotonic()
        self._next = 0.0
        self._read()
        self._first = self._made()

    @property
    def counts(self) -> Counter[str]:
        """How many runs are in each state, by the name that the table has for it."""
        return Counter(SHOWN[self._state(job)] for job in self._jobs)

    @property
    def seconds_left(self) -> float | None:
        """Until all is done, if it goes on as it went since the monitor began; None while that is not known."""
        made = self._made() - self._first
        return self._to_be_made() * (monotonic() - self._began) / made if made > 0 else None

    def failed(self, job: Job, reason: str) -> None:
        """Note that a run is given up, and say so."""
        self._failed[job.path] = reason
        self._print(f"FAILED {job.name}: {reason}")

    def update(self, now: bool = False) -> None:
        """Read how far the runs are and show it, if it is time again, or ``now``."""
        began = monotonic()
        if not now and began < self._next:
            return
        self._read()
        self._next = monotonic() + max(1.0, (monotonic() - began) / BUSY_PART)
        if self._live is not None:
            self._live.update(self._table(), refresh=True)
        elif began - self._told >= LINE_INTERVAL:
            self._line()

    def _state(self, job: Job) -> Any:
        return "failed" if job.path in self._failed else self._status.get(job.path, {}).get("state")

    def _read(self) -> None:
        for job in self._jobs:
            before = self._status.get(job.path, {}).get("state")
            if before not in ENDED:
                self._status[job.path] = read_status(job.path)

    def _made(self) -> int:
        """Steps made, as far as they are saved."""
        return sum(self._step(job) for job in self._jobs)

    def _to_be_made(self) -> int:
        """Steps that are still to be made."""
        return sum(
            job.experiment.training.total_timesteps - self._step(job)
            for job in self._jobs
            if self._state(job) not in (*ENDED, "failed")
        )

    def _step(self, job: Job) -> int:
        return min(job.experiment.training.total_timesteps, self._status.get(job.path, {}).get("step", 0))

    def summary(self) -> str:
        """One line: how many runs are in each state, and the time left."""
        counts = self.counts
        always = ("done", "running", "failed", "waiting")
        parts = [f"{counts[name]} {name}" for name in always]
        parts += [f"{counts[name]} {name}" for name in ("interrupted", "pruned") if counts[name]]
        left = self.seconds_left
        time_left = "" if not left else f", {timedelta(seconds=round(left))} left"
        return f"{', '.join(parts)} of {len(self._jobs)}{time_left}"

    def _line(self) -> None:
        self._told = monotonic()
        self._print(f"{self._title}: {self.summary()}")

    def _print(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)

    def _table(self) -> Group:
        head = Table.grid(padding=(0, 2))
        made, left = self._made(), self._to_be_made()
        head.add_row(
            Text(self._title, style="bold"),
            ProgressBar(max(1, made + left), made if left else max(1, made), width=30),
            Text(self.summary()),
        )
        running = [job for job in self._jobs if SHOWN[self._state(job)] == "running"]
        rows = Table.grid(padding=(0, 2))
        for job in running[:MOST_ROWS]:
            steps, of = self._status[job.path].get("step", 0), job.experiment.training.total_timesteps
            rows.add_row(ProgressBar(of, steps, width=16), Text(f"{steps / of:.0%}"), Text(job.name))
        more = len(running) - MOST_ROWS
        return Group(head, rows, *([Text(f"and {more} more")] if more > 0 else []))

    def __enter__(self) -> Dashboard:
        if self._console.is_terminal:
            self._live = Live(self._table(), console=self._console, auto_refresh=False)
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.update(self._table(), refresh=True)
            self._live.stop()
        elif self._jobs:
            self._line()
