"""How many threads the libraries below the trainers use."""

from __future__ import annotations

import torch
from threadpoolctl import threadpool_limits


def set_threads(count: int) -> None:
    """Let torch use ``count`` threads, and BLAS, whose products in compiled code are small, one."""
    torch.set_num_threads(count)
    # Numba loads the library of SciPy when it compiles a product, which may be later.
    import scipy.linalg.cython_blas  # noqa: F401

    threadpool_limits(1, user_api="blas")
