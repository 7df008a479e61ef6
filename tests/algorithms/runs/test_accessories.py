"""What accompanies a result never costs it: whatever fails, at any time, is one line, and the run is finished."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path
from typing import Any

import pytest

from algorithms.runs.config import Experiment, make_experiment
from algorithms.runs.console import make_console, print_line
from algorithms.runs.progress import ProgressReporter
from algorithms.runs.run_directory import Run, read_status
from algorithms.runs.training import resume, train_and_finish
from tests.helpers.short_runs import VALUES

FRONT: dict[str, Any] = {
    "environment": {"id": "deep-sea-treasure-v0"},
    "algorithm": {
        "name": "pcn",
        "hidden": [8],
        "gradient_steps": 1,
        "warmup_episodes": 4,
        "objective_scales": [20, 20],
    },
    "training": {"total_timesteps": 200, "num_envs": 4},
    "evaluation": {"episodes": 1, "final_episodes": 1},
}


class Terminal(io.StringIO):
    """A file that rich takes for a terminal."""

    def isatty(self) -> bool:
        return True


def broken(*_: object, **__: object) -> None:
    raise RuntimeError("of two\nlines")


def finished(folder: Path, experiment: Experiment, file: io.StringIO) -> list[str]:
    """Train to the end; the warnings that were printed."""
    run = Run.create(experiment, folder / "run")
    assert train_and_finish(run, resume(run), make_console(file)) is None
    run.unlock()
    assert read_status(run.path)["state"] == "finished"
    assert json.loads((run.path / "evaluation.json").read_text())["policies"]
    return [line for line in file.getvalue().splitlines() if "warning: " in line]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "file", "message"),
    [
        ("algorithms.runs.loggers.TensorBoard.__init__", io.StringIO, "TensorBoard is disabled"),
        ("algorithms.runs.loggers.TensorBoard.log", io.StringIO, "TensorBoard is disabled"),
        ("algorithms.runs.loggers.TensorBoard.close", io.StringIO, "TensorBoard is disabled"),
        ("rich.live.Live.start", Terminal, "the progress bar is not shown"),
        ("rich.live.Live.refresh", Terminal, "the progress bar is not shown"),
        ("rich.live.Live.stop", Terminal, "the progress bar is not shown"),
        ("algorithms.reporting.videos.record", io.StringIO, "no video"),
        ("matplotlib.figure.Figure.savefig", io.StringIO, "the curves could not be drawn"),
    ],
)
def test_a_run_is_finished_whatever_fails_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str, file: type[io.StringIO], message: str
) -> None:
    monkeypatch.setattr(place, broken)
    figures = not place.startswith(("algorithms.runs", "rich"))
    values = {**VALUES, "logging": {**VALUES["logging"], "save_figures": figures}}
    said = finished(tmp_path, make_experiment(values), file())
    assert said[0].endswith(f"warning: {message}: RuntimeError: of two lines")
    assert len(said) == (2 if "TensorBoard" in place else 1)  # of the results, too


@pytest.mark.slow
def test_a_front_is_finished_without_anything_that_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    for name in ("page.plots", "curves", "videos"):
        monkeypatch.delitem(sys.modules, f"algorithms.reporting.{name}", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    said = finished(tmp_path, make_experiment(FRONT), io.StringIO())
    starts = ("the front could not be drawn", "no video", "the curves could not be drawn")
    assert [line.split(": ")[1] for line in said] == list(starts)


def test_a_display_that_fails_gives_the_terminal_back(monkeypatch: pytest.MonkeyPatch) -> None:
    console = make_console(Terminal())
    with ProgressReporter(100, 0, console) as progress:
        monkeypatch.setattr("rich.live.Live.get_renderable", broken)
        progress.show(now=True)
        progress.show(now=True)
    print_line(console, "the end")
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert text.count("the progress bar is not shown") == 1
    assert text.rindex("\x1b[?25h") > text.rindex("\x1b[?25l"), "the cursor is visible again"
    assert "the end" in text
