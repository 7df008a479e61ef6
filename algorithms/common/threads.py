"""How many threads the trainers use."""

from __future__ import annotations

import numba
import scipy.linalg.cython_blas  # noqa: F401  (Numba's products use it, and it must be loaded to be limited)
import torch
from threadpoolctl import threadpool_limits

_count = 1


def set_threads(count: int) -> None:
    """Let compiled networks and torch use ``count`` threads, but no more than there are cores.

    Compiled networks give the same results with any number. Threads wait for each other by spinning, so that each needs
    a core of its own. BLAS gets one thread: the products in compiled code are small.
    """
    global _count
    _count = min(count, numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]  # Numba has no types
    numba.set_num_threads(_count)
    torch.set_num_threads(count)
    threadpool_limits(1, user_api="blas")


def threads() -> int:
    """The number of threads of compiled networks."""
    return _count
