"""Numba's simulator of CUDA moves the worlds as the CPU does: threads, scratch of one lane, autoreset and launcher."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from mo_deepdrive.world.scenarios import SCENARIOS
from tests.helpers.paths import REPOSITORY


@pytest.mark.slow
def test_the_kernels_move_worlds_as_the_cpu_does() -> None:
    simulator = {"NUMBA_ENABLE_CUDASIM": "1", "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(
        [sys.executable, "-m", "tests.cuda.simulated"],
        env={**os.environ, **simulator},
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    lines = [f"{scenario} {kind}: 66 episodes" for scenario in SCENARIOS for kind in ("discrete", "continuous")]
    assert done.stdout.splitlines() == lines
