"""What the progress of a training run tells: time left, and compilation."""

from __future__ import annotations

import numba
import pytest

from algorithms.runs import progress_bar
from algorithms.runs.progress_bar import COMPILING, ProgressReporter, compilation_noted
from tests.helpers.short_runs import printed, quiet


def test_the_time_left_is_that_of_the_updates_after_compilation(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(progress_bar, "perf_counter", lambda: now[0])
    console = quiet()
    with ProgressReporter(100_000, 0, console) as reporter:
        for step, seconds in ((100, 30.0), (200, 16.0), (1200, 1.0), (20_200, 19.0)):
            now[0] += seconds
            reporter.update(step)
    lines = printed(console).splitlines()
    assert lines[0] == "step 100 of 100,000 (0%)"
    assert lines[1] == "step 200 of 100,000 (0%)"
    assert lines[2] == "step 20,200 of 100,000 (20%)    0:01:20 left"  # 20,000 steps in 20 s


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
