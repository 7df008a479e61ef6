"""The runner of sweeps; tests/scripts/test_sweep.py has the other tests."""

from __future__ import annotations

import subprocess
import sys


def test_what_trains_is_not_imported_to_show_the_status() -> None:
    code = "import sys, algorithms.sweeps.runner; print([name for name in ('torch', 'numba') if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
