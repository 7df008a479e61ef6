"""What stops a training run early: signals, requests, disks that cannot be written to, and other errors."""

from __future__ import annotations

import errno
import signal
import threading
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from types import FrameType, TracebackType

INTERRUPTED = 130  # exit code after Ctrl-C, as shells count it: 128 + SIGINT


class Stopped(Exception):
    """Training had to stop for an external reason, such as a full disk; the message says what to do."""


class DiskFull(Stopped):
    """There is no space left on the disk."""


def no_space(error: OSError) -> bool:
    """Whether the disk, or a quota, is full."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT)


def stopped_by(error: OSError, message: str) -> Stopped:
    """The exception to raise, with ``message``, after an error of the operating system."""
    return (DiskFull if no_space(error) else Stopped)(message)


class JobFailed(Exception):
    """The error of a run as text: other processes may not be able to import its type."""


def describe(error: BaseException) -> str:
    """An error in one line, with its type unless its message is meant for users."""
    text = " ".join(str(error).split())
    for_users = isinstance(error, (ValueError, ImportError, Stopped, OSError, JobFailed))
    return text if for_users and text else f"{type(error).__name__}: {text}"


class Interrupts:
    """Records SIGINT and SIGTERM while it is open, instead of acting on them; a second SIGINT acts at once.

    A second SIGTERM does not, so that what the first one began can be saved: a batch system sends it to every process
    of a job, and then a parent that stops its workers sends it to them again.

    Use it as a context manager. Only the main thread receives signals; in others nothing is recorded.

    Attributes:
        received: the signal's number, 0 for a request to stop that is no signal, or None.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._previous: dict[int, Any] = {}

    def _record(self, number: int, _frame: FrameType | None) -> None:
        self.received = number
        if number == signal.SIGINT:
            self._restore()

    def _restore(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            self._previous = {number: signal.signal(number, self._record) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._restore()
