"""The dashboard: the counts of runs by state, the time left, and how often it prints."""

from __future__ import annotations

import io
import json
import re
from typing import TYPE_CHECKING

import pytest
from rich.console import Console

from algorithms.experiments import dashboard as module
from algorithms.experiments.dashboard import MOST_ROWS, Dashboard
from tests.helpers.short_runs import job, printed, quiet

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from algorithms.experiments.jobs import Job

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
    monkeypatch.setattr(module, "monotonic", made)
    return made


def jobs(folder: Path, count: int) -> list[Job]:
    """Runs that have not been started."""
    return [job(folder, seed) for seed in range(count)]


def put(wanted: Job, state: str, step: int = 0) -> None:
    """Write the status of a run to its directory."""
    wanted.path.mkdir(parents=True, exist_ok=True)
    (wanted.path / "status.json").write_text(json.dumps({"state": state, "step": step}))


def counts(wanted: list[Job]) -> dict[str, int]:
    """How many runs are in each state."""
    return dict(Dashboard(wanted, quiet()).counts)


def terminal() -> Console:
    """A terminal that stores what is printed."""
    return Console(force_terminal=True, file=io.StringIO(), width=100)


def shown(console: Console) -> list[str]:
    """The lines printed to a console, without colours and cursor movements."""
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", printed(console)).replace("\r", "\n").splitlines()


# ------------------------------------------------------------------------------------------------------------- numbers


def test_runs_are_counted_by_their_states(tmp_path: Path) -> None:
    wanted = jobs(tmp_path, 9)
    states = ["finished", "finished", "pruned", "failed", "running", "trained", "interrupted"]
    for each, state in zip(wanted, states, strict=False):
        put(each, state)
    wanted[8].path.mkdir()  # started, but without a status
    expected = {"done": 2, "pruned": 1, "failed": 1, "running": 2, "interrupted": 1, "waiting": 2}
    assert counts(wanted) == expected
    summary = Dashboard(wanted, quiet()).summary()
    assert summary == "2 done, 2 running, 1 failed, 2 waiting, 1 interrupted, 1 pruned of 9"


def test_a_run_reported_as_failed_counts_as_failed_whatever_its_directory_says(tmp_path: Path) -> None:
    wanted = jobs(tmp_path, 2)
    put(wanted[0], "running", 96)
    dashboard = Dashboard(wanted, quiet())
    dashboard.failed(wanted[0], "the reason")
    assert dashboard.counts == {"failed": 1, "waiting": 1}


def test_changes_are_shown_at_the_next_update(tmp_path: Path, clock: Clock) -> None:
    wanted = jobs(tmp_path, 2)
    dashboard = Dashboard(wanted, quiet())
    put(wanted[0], "running", 96)
    assert dashboard.counts == {"waiting": 2}
    dashboard.update()
    assert dashboard.counts == {"running": 1, "waiting": 1}
    put(wanted[0], "finished", STEPS)
    clock.now += 0.9
    dashboard.update()
    assert dashboard.counts == {"running": 1, "waiting": 1}
    clock.now += 0.2
    dashboard.update()
    assert dashboard.counts == {"done": 1, "waiting": 1}
    put(wanted[1], "pruned", 96)
    dashboard.update(now=True)
    assert dashboard.counts == {"done": 1, "pruned": 1}


def test_the_time_left_is_extrapolated_from_the_steps_so_far(tmp_path: Path, clock: Clock) -> None:
    wanted = jobs(tmp_path, 4)
    put(wanted[0], "interrupted", 480)  # before the dashboard started
    dashboard = Dashboard(wanted, quiet())
    assert dashboard.seconds_left is None
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


@pytest.mark.parametrize("garbage", [b"\xff\xfe\x80", b"[]", b"", b'{"state": "run'])
def test_a_status_that_cannot_be_read_counts_as_waiting(tmp_path: Path, garbage: bytes) -> None:
    torn = job(tmp_path)
    torn.path.mkdir()
    (torn.path / "status.json").write_bytes(garbage)
    assert counts([torn]) == {"waiting": 1}


# --------------------------------------------------------------------------------------------------------- on a console


def lines_of(console: Console, title: str) -> list[str]:
    """The lines that start with the title."""
    return [line for line in printed(console).splitlines() if line.startswith(f"{title}: ")]


def test_without_a_terminal_there_is_a_line_every_fifteen_seconds_and_one_at_the_end(
    tmp_path: Path, clock: Clock
) -> None:
    wanted = jobs(tmp_path, 2)
    console = quiet()
    with Dashboard(wanted, console, "sweep") as dashboard:
        began, times, said = clock.now, [], 0
        while clock.now < began + 62:
            clock.now += 0.25
            dashboard.update()
            if len(lines_of(console, "sweep")) > said:
                said += 1
                times.append(clock.now - began)
        for each in wanted:
            put(each, "finished", STEPS)
        dashboard.update(now=True)
    assert len(times) == said == 4
    assert all(15 <= later - earlier <= 16.5 for earlier, later in zip([0, *times], times, strict=False))
    assert printed(console).splitlines() == lines_of(console, "sweep")
    assert len(lines_of(console, "sweep")) == 5
    assert lines_of(console, "sweep")[-1] == "sweep: 2 done, 0 running, 0 failed, 0 waiting of 2"


@pytest.mark.parametrize("make", [quiet, terminal])
def test_a_failed_run_is_printed_once_with_its_reason(
    tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch, make: Callable[[], Console]
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    wanted = jobs(tmp_path, 3)
    console = make()
    reason = "a long reason with [brackets] and a number 3.14, " + "and more words " * 12 + "to the end"
    with Dashboard(wanted, console) as dashboard:
        dashboard.failed(wanted[1], reason)
        for _ in range(5):
            clock.now += 20
            dashboard.update()
    assert shown(console).count(f"FAILED seed 1: {reason}") == 1
    assert printed(console).count("FAILED") == 1
    assert any("0 done, 0 running, 1 failed, 2 waiting of 3" in line for line in shown(console)[-3:])


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
    after = shown(console)[len(seen) :]
    assert any(line.startswith("my sweep ") and "1 done, 2 running, 0 failed, 1 waiting of 4" in line for line in seen)
    assert [line for line in seen if line.endswith("seed 1")][-1].split()[-3:] == ["25%", "seed", "1"]
    assert [line for line in seen if line.endswith("seed 2")][-1].split()[-3:] == ["100%", "seed", "2"]
    assert not any("seed 0" in line or "seed 3" in line or "more" in line for line in seen)
    assert after
    assert all(len(line) <= 100 for line in seen)


@pytest.mark.parametrize("count", [MOST_ROWS, MOST_ROWS + 30])
def test_a_terminal_shows_a_dozen_runs_and_counts_the_others(
    tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    wanted = jobs(tmp_path, count)
    for each in wanted:
        put(each, "running", 96)
    console = terminal()
    with Dashboard(wanted, console) as dashboard:
        dashboard.update()
        seen = shown(console)
    assert [line.split()[-1] for line in seen if "seed" in line] == [str(seed) for seed in range(MOST_ROWS)]
    assert [line for line in seen if "more" in line] == ([f"and {count - MOST_ROWS} more"] if count > MOST_ROWS else [])
    assert printed(console).count("\x1b[?25h") == 1  # the cursor is back
