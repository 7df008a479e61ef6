"""Progress: the counts of runs by state, the time left, compilation, and what is printed."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import numba
import pytest
from rich.console import Console

from algorithms.runs import progress as module
from algorithms.runs.jobs import Job
from algorithms.runs.progress import COMPILING, Dashboard, compilation_noted
from tests.helpers.short_runs import job, printed, quiet

STEPS = 960  # of each run


class Clock:
    """A clock that is advanced by hand."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """The dashboard's clock."""
    made = Clock()
    monkeypatch.setattr(module, "perf_counter", made)
    return made


def jobs(folder: Path, count: int) -> list[Job]:
    """Runs that have not been started."""
    return [job(folder, seed) for seed in range(count)]


def put(wanted: Job, state: str, step: int = 0) -> None:
    """Write the status of a run to its directory."""
    wanted.path.mkdir(parents=True, exist_ok=True)
    (wanted.path / "status.json").write_text(json.dumps({"state": state, "step": step}))


def terminal() -> Console:
    """A terminal that stores what is printed."""
    return Console(force_terminal=True, file=io.StringIO(), width=100)


def shown(console: Console) -> list[str]:
    """The lines printed to a console, without colours and cursor movements."""
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", printed(console)).replace("\r", "\n").splitlines()


def test_runs_are_counted_by_their_states(tmp_path: Path) -> None:
    wanted = jobs(tmp_path, 9)
    states = ["finished", "finished", "pruned", "failed", "running", "trained", "interrupted"]
    for each, state in zip(wanted, states, strict=False):
        put(each, state)
    wanted[8].path.mkdir()
    (wanted[8].path / "status.json").write_bytes(b'{"state": "run')
    summary = Dashboard(wanted, quiet()).summary()
    assert summary == "2 done, 2 running, 1 failed, 2 waiting, 1 interrupted, 1 pruned of 9"


def test_the_time_left_is_extrapolated_from_the_steps_so_far(tmp_path: Path, clock: Clock) -> None:
    wanted = jobs(tmp_path, 4)
    put(wanted[0], "interrupted", 480)  # before the dashboard started
    dashboard = Dashboard(wanted, quiet())
    clock.now += 10
    dashboard.update()
    assert dashboard.seconds_left is None
    put(wanted[0], "finished", STEPS)
    put(wanted[1], "running", 480)
    clock.now += 10
    dashboard.update()
    assert dashboard.seconds_left == pytest.approx(20 * (4 * STEPS - STEPS - 480) / 960)
    assert dashboard.summary() == "1 done, 1 running, 0 failed, 2 waiting of 4, 0:00:50 left"
    for each in wanted:
        put(each, "finished", STEPS)
    clock.now += 3600
    dashboard.update()
    assert dashboard.seconds_left == 0
    assert dashboard.summary() == "4 done, 0 running, 0 failed, 0 waiting of 4"


def test_without_a_terminal_there_is_a_line_every_fifteen_seconds_and_one_at_the_end(
    tmp_path: Path, clock: Clock
) -> None:
    wanted, console = jobs(tmp_path, 2), quiet()
    with Dashboard(wanted, console, "sweep") as dashboard:
        for _ in range(62):
            clock.now += 1.0
            dashboard.update()
        for each in wanted:
            put(each, "finished", STEPS)
        dashboard.update(now=True)
    *waiting, last = printed(console).splitlines()
    assert waiting == ["sweep: 0 done, 0 running, 0 failed, 2 waiting of 2"] * 4
    assert last == "sweep: 2 done, 0 running, 0 failed, 0 waiting of 2"


def test_a_failed_run_is_printed_with_its_reason_as_it_is(tmp_path: Path) -> None:
    wanted, console = jobs(tmp_path, 2), quiet()
    put(wanted[0], "running", 96)
    reason = "a long reason with [brackets] and a number 3.14, " + "and more words " * 12 + "to the end"
    dashboard = Dashboard(wanted, console)
    dashboard.failed(wanted[0], reason)
    assert printed(console) == f"FAILED seed 0: {reason}\n"
    assert dashboard.summary().startswith("0 done, 0 running, 1 failed, 1 waiting of 2")  # whatever its directory says


def test_a_terminal_shows_the_running_runs(tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    wanted = jobs(tmp_path, 4)
    put(wanted[0], "finished", STEPS)
    console = terminal()
    with Dashboard(wanted, console, "my sweep") as dashboard:
        put(wanted[1], "running", STEPS // 4)
        put(wanted[2], "trained", STEPS)
        clock.now += 2
        dashboard.update()
        seen = shown(console)
        put(wanted[1], "interrupted", STEPS // 2)
        put(wanted[2], "finished", STEPS)
    assert any(line.startswith("my sweep ") and "1 done, 2 running, 0 failed, 1 waiting of 4" in line for line in seen)
    assert [line for line in seen if line.endswith("seed 1")][-1].split()[-3:] == ["25%", "seed", "1"]
    assert [line for line in seen if line.endswith("seed 2")][-1].split()[-3:] == ["100%", "seed", "2"]
    assert not any("seed 0" in line or "seed 3" in line or "more" in line for line in seen)
    assert all(len(line) <= 100 for line in seen)


@pytest.mark.parametrize(("module", "said"), [("mo_deepdrive.simulation.kernel", [COMPILING]), ("users_code", [])])
def test_compilation_is_mentioned_once_and_only_where_it_happens(module: str, said: list[str]) -> None:
    def function(x: float) -> float:
        return x + 1.0

    function.__module__ = module
    compiled, lines = numba.njit(function), []
    with compilation_noted(lines.append):
        compiled(1.0)
        compiled(1)  # another type is compiled again
    assert lines == said
    with compilation_noted(lines.append):
        compiled(2.0)
    assert lines == said
