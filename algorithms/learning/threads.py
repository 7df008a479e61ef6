"""How many threads the trainers use."""

from __future__ import annotations

import os
from contextlib import contextmanager
from typing import TYPE_CHECKING

import torch
from threadpoolctl import threadpool_limits

if TYPE_CHECKING:
    from collections.abc import Iterator

_wanted = 1
_process = os.getpid()


def set_threads(count: int) -> None:
    """Let torch use ``count`` threads while it trains. Each needs a core of its own.

    An idle thread spins for milliseconds, on a core that others need, unless ``GOMP_SPINCOUNT`` is 6000 or so when the
    process starts; the command line sees to that.

    Raises:
        ValueError: for more than one thread in a forked process: it has none of the threads that its parent may have
            started, and would wait for them for ever.
    """
    global _wanted
    if count > 1 and os.getpid() != _process:
        raise ValueError(f"threads = {count} must be 1 in a forked process; one started by 'spawn' can have more")
    _wanted = count
    torch.set_num_threads(count)


if hasattr(os, "register_at_fork"):  # one thread in a forked process for all that torch does, not for training alone
    os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))


@contextmanager
def limited_threads() -> Iterator[None]:
    """Let torch use no more threads than were asked for and BLAS one, and as many as before afterwards.

    Torch's default is one per core, which makes small operations slower. Its sums depend on the number of threads, so
    that this number must not depend on the cores.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(min(before, _wanted))
    try:
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(before)
