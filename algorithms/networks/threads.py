"""How many threads the trainers use."""

from __future__ import annotations

import os
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numba
import scipy.linalg.cython_blas  # noqa: F401  (Numba's own products use it; only what is loaded can be limited)
import torch
from threadpoolctl import ThreadpoolController, threadpool_limits

if TYPE_CHECKING:
    from collections.abc import Iterator
    from contextlib import AbstractContextManager

    from threadpoolctl import LibController

_count = _wanted = 1
_process = os.getpid()
blas_libraries = ThreadpoolController().select(user_api="blas").lib_controllers


def set_threads(count: int) -> None:
    """Let torch use ``count`` threads, and compiled code as many, but no more than there are cores.

    Training gives the same results on any number of cores, but not with any ``count``: a part of the environments per
    thread goes through the networks at once, and the last bits of products depend on the number of rows. Each thread
    needs a core of its own. BLAS gets one thread: the products in compiled code are small.

    An idle thread spins for milliseconds, on a core that others need, unless ``GOMP_SPINCOUNT`` is 6000 or so when the
    process starts; the command line sees to that.

    Raises:
        ValueError: for more than one thread in a forked process: it has none of the threads that its parent may have
            started, and would wait for them for ever.
    """
    global _count, _wanted
    if count > 1 and os.getpid() != _process:
        raise ValueError(f"threads = {count} must be 1 in a forked process; one started by 'spawn' can have more")
    _wanted = count
    _count = min(count, numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]  # Numba has no types
    numba.set_num_threads(_count)
    torch.set_num_threads(count)
    threadpool_limits(1, user_api="blas")


def _begin_fork() -> None:
    """Use one thread in a forked process for all that torch and compiled code do, not for training alone."""
    global _count
    _count = 1
    torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_fork)


def threads() -> int:
    """The number of threads of compiled networks."""
    return _count


def wanted_threads() -> int:
    """The number of threads that was asked for, however many cores there are."""
    return _wanted


class _OneBlasThread:
    """Limits BLAS while it is entered, once or several times: only the first one counts, and only the last exit."""

    def __init__(self) -> None:
        self._entered = 0
        self._before: list[tuple[LibController, int]] = []

    def __enter__(self) -> None:
        if self._entered == 0:
            self._before = [(library, count) for library in blas_libraries if (count := library.get_num_threads()) != 1]
            for library, _ in self._before:
                library.set_num_threads(1)
        self._entered += 1

    def __exit__(self, *_: object) -> None:
        self._entered -= 1
        if self._entered == 0:
            for library, count in self._before:
                library.set_num_threads(count)


_one_blas_thread = _OneBlasThread()


def one_blas_thread() -> AbstractContextManager[None]:
    """Let BLAS use one thread within a ``with`` statement, and as many as before after it.

    With more, every small product waits for threads that may not have a core. The context of threadpoolctl takes as
    long as a pass over a few rows.
    """
    return _one_blas_thread


@contextmanager
def limited_threads() -> Iterator[None]:
    """Let torch use no more threads than were asked for and BLAS one, and as many as before afterwards.

    Torch's default is one per core, which makes small operations slower. Its sums depend on the number of threads, so
    that this number must not depend on the cores.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(min(before, _wanted))
    try:
        with one_blas_thread():
            yield
    finally:
        torch.set_num_threads(before)
