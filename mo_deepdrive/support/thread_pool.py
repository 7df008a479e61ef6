"""A pool of threads among which the parts of a batch are shared."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

T = TypeVar("T")


class ThreadPool:
    """Threads that are started when they are needed; a copy of the pool, or a forked process, starts its own."""

    def __init__(self) -> None:
        self._executor: ThreadPoolExecutor | None = None
        self._process = 0

    def __reduce__(self) -> tuple[type[ThreadPool], tuple[()]]:
        return ThreadPool, ()

    def run(self, function: Callable[[T], None], parts: Sequence[T]) -> None:
        """Call ``function`` for every part at the same time, the first in this thread."""
        first, *rest = parts
        if rest and (self._executor is None or self._process != os.getpid()):
            # A forked child inherits the executor without its threads, and would wait for them for ever.
            self._executor, self._process = ThreadPoolExecutor(len(rest)), os.getpid()
        others = [self._executor.submit(function, part) for part in rest] if self._executor is not None else []
        try:
            function(first)
        finally:
            wait(others)  # nobody writes to the parts any more, even after an error
        for other in others:
            other.result()

    def close(self) -> None:
        """End the threads; another call would start new ones."""
        if self._executor is not None and self._process == os.getpid():
            self._executor.shutdown()
        self._executor = None
