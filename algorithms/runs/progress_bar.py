"""The progress of a training run: a bar on a terminal, periodic lines otherwise."""

from __future__ import annotations

from contextlib import contextmanager
from time import perf_counter
from typing import TYPE_CHECKING, Any

from numba.core import event
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from algorithms.runs.console import LINE_INTERVAL, LiveDisplay, print_line
from mo_deepdrive.evaluation.metrics import (
    CARDINALITY,
    FRONT,
    HYPERVOLUME,
    STEPS_PER_SECOND,
    SUCCESS,
    TRAIN,
    UTILITY,
    evaluation_prefix,
    split_name,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from types import TracebackType

    from rich.console import Console

SHOWN = (STEPS_PER_SECOND, *(evaluation_prefix(FRONT) + name for name in (HYPERVOLUME, CARDINALITY)))
REFRESH_INTERVAL = 0.1  # s between refreshes of the bar
FIRST_UPDATES = 2  # in which code may be compiled; the time left is known from later ones
COMPILING = "compiling the simulator (once, about 20 s)"


class _CompilationListener(event.Listener):
    """Calls a function when Numba begins to compile code of this project, rather than to load it from its cache."""

    def __init__(self, say: Callable[[str], None]):
        self._say: Callable[[str], None] | None = say

    def on_start(self, event: Any) -> None:
        module = event.data["dispatcher"].py_func.__module__
        if self._say is not None and module.partition(".")[0] in ("mo_deepdrive", "algorithms"):
            self._say(COMPILING)
            self._say = None

    def on_end(self, event: Any) -> None:
        """Not needed."""


@contextmanager
def compilation_noted(say: Callable[[str], None]) -> Iterator[None]:
    """In this context, ``say`` is called once if the simulator or the training loop has to be compiled."""
    with event.install_listener("numba:compile", _CompilationListener(say)):
        yield


class ProgressReporter:
    """Shows steps, speed, utility, arrivals and time left; use it as a context manager.

    Args:
        total: environment steps of the whole training.
        step: environment steps taken so far.
        console: where to print.
        arrivals: whether the environment reports arrivals.
        front: whether a front is learnt, so that its hypervolume is shown instead of a utility.
    """

    def __init__(self, total: int, step: int, console: Console, arrivals: bool = True, front: bool = False):
        performance = (
            [(HYPERVOLUME, "hypervolume {:,.1f}"), (CARDINALITY, "{:.0f} policies")]
            if front
            else [(UTILITY, "utility {:.2f}")]
        )
        self._shown = (*performance, *([(SUCCESS, "arrivals {:.0%}")] if arrivals else []))
        self._total = total
        self._step = self._first = step
        self._updates = 0
        self._printed_step: int | None = None
        self._console = console
        self._start_time = self._print_time = perf_counter()
        self._metrics: dict[str, float] = {}
        self._bar = Progress(
            BarColumn(bar_width=None),
            TextColumn(f"{{task.percentage:>3.0f}}% of {total:,}"),
            TextColumn("{task.fields[numbers]}"),
            TimeRemainingColumn(compact=True, elapsed_when_finished=True),
            console=console,
        )
        self._task = self._bar.add_task("training", total=total, completed=step, numbers="")
        self._display = LiveDisplay(console, "the progress bar", self._bar.get_renderable)

    def note(self, metrics: Mapping[str, float]) -> None:
        """Keep the newest values of the metrics that are shown."""
        for name, value in metrics.items():
            if name in SHOWN or (name.startswith(TRAIN) and split_name(name).metric in (UTILITY, SUCCESS)):
                self._metrics[name] = value

    def update(self, step: int) -> None:
        """Show that ``step`` environment steps have been taken."""
        self._step = step
        self._updates += 1
        if self._updates == FIRST_UPDATES:
            self._start_time, self._first = perf_counter(), step
        passed = perf_counter() - self._print_time
        if not self._display.shown and passed >= LINE_INTERVAL:
            self._line()
        elif self._display.shown and passed >= REFRESH_INTERVAL:
            self._refresh()

    def say(self, message: str) -> None:
        """Print a message above the bar."""
        print_line(self._console, message)

    def _refresh(self) -> None:
        self._print_time = perf_counter()
        self._bar.update(self._task, completed=min(self._step, self._total), numbers=self._numbers())
        self._display.refresh()

    def _numbers(self) -> str:
        """The metrics as text; with several vehicles their mean."""
        parts = []
        for suffix, unit in self._shown:
            values = [value for name, value in self._metrics.items() if name.endswith("/" + suffix)]
            if values:
                parts.append(unit.format(sum(values) / len(values)))
        speed = self._metrics.get(STEPS_PER_SECOND)
        if speed is not None:
            parts.append(f"{speed:,.0f} steps/s")
        return "  ".join(parts)

    def _line(self) -> None:
        self._print_time, self._printed_step = perf_counter(), self._step
        done = self._step - self._first
        left = ""
        if self._updates > FIRST_UPDATES and self._step < self._total:
            seconds = round((self._print_time - self._start_time) / done * (self._total - self._step))
            left = f"  {seconds // 3600}:{seconds // 60 % 60:02}:{seconds % 60:02} left"
        shown = f"step {self._step:,} of {self._total:,} ({self._step / self._total:.0%})  {self._numbers()}{left}"
        self.say(shown.rstrip())

    def __enter__(self) -> ProgressReporter:
        self._start_time = self._print_time = perf_counter()
        self._display.start()
        self._display.refresh()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._display.shown:
            self._refresh()
            self._display.stop()
        elif self._step != self._printed_step:
            self._line()
