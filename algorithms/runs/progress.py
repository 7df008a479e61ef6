"""The progress of one run or of many: on a terminal kept up to date at its end, periodic lines elsewhere."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections import Counter
from datetime import timedelta
from statistics import fmean
from time import perf_counter
from typing import TYPE_CHECKING, Any

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from algorithms.runs.console import print_line
from algorithms.runs.interrupts import Accessory
from algorithms.runs.run_directory import read_status
from mo_deepdrive.evaluation.metrics import (
    CARDINALITY,
    FRONT,
    HYPERVOLUME,
    STEPS_PER_SECOND,
    SUCCESS,
    TRAIN,
    UTILITY,
    evaluation_prefix,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from rich.console import RenderableType
    from typing_extensions import Self


LINE_INTERVAL, REFRESH_INTERVAL = 15.0, 0.1  # s between lines, and between refreshes of a terminal


class Display(ABC):
    """Shows progress while its context is open; what fails on the terminal is one line, and lines follow it."""

    def __init__(self, console: Console, name: str):
        self._console, self._last_line = console, ""
        self._live: Live | None = None
        self._accessory = Accessory(f"{name} is not shown", self.say)
        self._shown_time = perf_counter()

    @abstractmethod
    def _line(self) -> str:
        """The progress as a line."""

    @abstractmethod
    def _render(self) -> RenderableType:
        """The progress as a terminal shows it."""

    def say(self, message: str) -> None:
        """Print a message, above what is shown."""
        print_line(self._console, message)

    def show(self, now: bool = False) -> None:
        """Show the progress, if that was done long enough ago."""
        if now or perf_counter() - self._shown_time >= (REFRESH_INTERVAL if self._live else LINE_INTERVAL):
            self._shown_time = perf_counter()
            if self._live is not None:
                self._attempt(lambda live: live.refresh())
            elif (line := self._line()) != self._last_line or not now:
                self.say(line)
                self._last_line = line

    def _attempt(self, action: Callable[[Live], None]) -> None:
        if self._live is None:
            return
        with self._accessory:
            action(self._live)
            return
        live, self._live = self._live, None
        with contextlib.suppress(Exception):  # it has failed and been reported; this restores the cursor
            live.stop()

    def __enter__(self) -> Self:
        self._shown_time = perf_counter()
        if self._console.is_terminal:
            # No thread refreshes it, whose errors nobody would catch.
            self._live = Live(console=self._console, get_renderable=self._render, auto_refresh=False)
            self._attempt(lambda live: live.start(refresh=True))
        return self

    def __exit__(self, *_: object) -> None:
        on_terminal = self._live is not None
        self._attempt(lambda live: live.stop())  # which shows it a last time
        if not on_terminal:
            self.show(now=True)


# -------------------------------------------------------------------------------------------------------------- one run

FIRST_UPDATES = 2  # in which code may be compiled; the time left is known from later ones
COMPILING = "compiling the simulator (once, about 20 s)"


@contextlib.contextmanager
def compilation_noted(say: Callable[[str], None]) -> Iterator[None]:
    """In this context, ``say`` is called once if Numba has to compile code of this project, which is not cached yet."""
    from numba.core import event  # not earlier: what only starts workers needs no Numba

    messages = [COMPILING]

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            module = event.data["dispatcher"].py_func.__module__
            if messages and module.partition(".")[0] in ("mo_deepdrive", "algorithms"):
                say(messages.pop())

        def on_end(self, event: Any) -> None:
            """Not needed."""

    with event.install_listener("numba:compile", Listener()):
        yield


class ProgressReporter(Display):
    """Shows steps, of ``total`` ones, speed, time left, arrivals where they are known, and the utility or the front."""

    def __init__(self, total: int, step: int, console: Console, arrivals: bool = True, front: bool = False):
        super().__init__(console, "the progress bar")
        self._formats = {(TRAIN, UTILITY): "utility {:.2f}"}  # by the beginning and the end of a metric's name
        if front:
            prefix = evaluation_prefix(FRONT)
            self._formats = {(prefix, HYPERVOLUME): "hypervolume {:,.1f}", (prefix, CARDINALITY): "{:.0f} policies"}
        if arrivals:
            self._formats[TRAIN, SUCCESS] = "arrivals {:.0%}"
        self._total, self._step, self._first, self._updates = total, step, step, 0
        self._start_time = perf_counter()
        self._metrics: dict[str, float] = {}

    def note(self, metrics: Mapping[str, float]) -> None:
        """Keep the newest values."""
        self._metrics |= metrics

    def update(self, step: int) -> None:
        """Show that ``step`` environment steps have been taken."""
        self._step = step
        self._updates += 1
        if self._updates == FIRST_UPDATES:
            self._start_time, self._first = perf_counter(), step
        self.show()

    def _line(self) -> str:
        parts = [f"step {self._step:,} of {self._total:,} ({self._step / self._total:.0%})"]
        for (prefix, metric), text in self._formats.items():
            names = [name for name in self._metrics if name.startswith(prefix) and name.endswith(f"/{metric}")]
            if names:
                parts.append(text.format(fmean(self._metrics[name] for name in names)))  # over several vehicles
        if STEPS_PER_SECOND in self._metrics:
            parts.append(f"{self._metrics[STEPS_PER_SECOND]:,.0f} steps/s")
        if self._updates > FIRST_UPDATES and self._step < self._total:
            seconds = (perf_counter() - self._start_time) / (self._step - self._first) * (self._total - self._step)
            parts.append(f"{timedelta(seconds=round(seconds))} left")
        return "  ".join(parts)

    def _render(self) -> RenderableType:
        row = Table.grid(padding=(0, 2))
        row.add_row(ProgressBar(self._total, self._step, width=30), Text(self._line()))
        return row


# ------------------------------------------------------------------------------------------------------------ many runs

# The name of each state in the table.
SHOWN_STATES = {
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


def summary_of(states: Iterable[Any]) -> str:
    """The number of runs in each state, in one line; the states are those of status.json, or None without one."""
    counts = Counter(SHOWN_STATES[state] for state in states)
    always = ("done", "running", "failed", "waiting")
    shown = (*always, *(name for name in ("interrupted", "pruned") if counts[name]))
    return f"{', '.join(f'{counts[name]} {name}' for name in shown)} of {counts.total()}"


class Dashboard(Display):
    """Shows the states of runs, the running ones, and the time left; call :meth:`update` often."""

    def __init__(self, jobs: Sequence[Any], console: Console, title: str = "runs"):
        super().__init__(console, "the progress")
        self._jobs, self._title = list(jobs), title
        self._status: dict[Path, dict[str, Any]] = {}
        self._failed: set[Path] = set()
        self._start_time, self._next_update = perf_counter(), 0.0
        self._read()
        self._steps_at_start = self._steps_done()

    @property
    def seconds_left(self) -> float | None:
        """Seconds until all runs are done, at the mean speed since the start; None before the first new step."""
        done = self._steps_done() - self._steps_at_start
        return self._steps_left() * (perf_counter() - self._start_time) / done if done > 0 else None

    def failed(self, job: Any, reason: str) -> None:
        """Mark a run as failed and print the reason."""
        self._failed.add(job.path)
        self.say(f"FAILED {job.name}: {reason}")

    def update(self, now: bool = False) -> None:
        """Read and show the progress if the last update is long enough ago, or if ``now`` is true."""
        started = perf_counter()
        if now or started >= self._next_update:
            self._read()
            self._next_update = perf_counter() + max(1.0, (perf_counter() - started) / READING_SHARE)
            self.show()

    def _state(self, job: Any) -> Any:
        return "failed" if job.path in self._failed else self._status[job.path].get("state")

    def _read(self) -> None:
        for job in self._jobs:
            if self._status.get(job.path, {}).get("state") not in ENDED:
                self._status[job.path] = read_status(job.path)

    def _step(self, job: Any) -> int:
        total: int = job.experiment.training.total_timesteps
        return min(total, int(self._status[job.path].get("step", 0)))

    def _steps_done(self) -> int:
        """Up to the last checkpoints, over all runs."""
        return sum(map(self._step, self._jobs))

    def _steps_left(self) -> int:
        """Of the runs that have neither ended nor failed."""
        left = [job for job in self._jobs if self._state(job) not in (*ENDED, "failed")]
        return sum(job.experiment.training.total_timesteps - self._step(job) for job in left)

    def summary(self) -> str:
        """One line: the number of runs in each state, and the time left."""
        left = self.seconds_left
        return summary_of(map(self._state, self._jobs)) + (f", {timedelta(seconds=round(left))} left" if left else "")

    def _line(self) -> str:
        return f"{self._title}: {self.summary()}"

    def _render(self) -> RenderableType:
        head, rows = Table.grid(padding=(0, 2)), Table.grid(padding=(0, 2))
        done, left = self._steps_done(), self._steps_left()
        head.add_row(
            Text(self._title, style="bold", overflow="fold"),
            ProgressBar(max(1, done + left), done if left else max(1, done), width=30),
            Text(self.summary()),
        )
        running = [job for job in self._jobs if SHOWN_STATES[self._state(job)] == "running"]
        for job in running[:MOST_ROWS]:
            step, total = self._step(job), job.experiment.training.total_timesteps
            rows.add_row(ProgressBar(total, step, width=16), Text(f"{step / total:.0%}"), Text(job.name))
        more = len(running) - MOST_ROWS
        return Group(head, rows, *([Text(f"and {more} more")] if more > 0 else []))
