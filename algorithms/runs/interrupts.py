"""What stops a training run early, and what never does: signals, disks that cannot be written to, other errors."""

from __future__ import annotations

import _thread
import errno
import signal
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from types import FrameType

INTERRUPTED = 130  # exit code after Ctrl-C, as shells count it: 128 + SIGINT
# How long (s) an update or an evaluation may go on after a signal, so that its work is saved: a person waits at Ctrl-C,
# a batch system kills some 30 s after SIGTERM.
PATIENCE = {signal.SIGINT: 2.0, signal.SIGTERM: 10.0}


class Stopped(Exception):
    """Training had to stop for an external reason, such as a full disk; the message says what to do."""


class DiskFull(Stopped):
    """There is no space left on the disk."""


class JobFailed(Exception):
    """The error of a run as text: other processes may not be able to import its type."""


def no_space(error: OSError) -> bool:
    """Whether the disk, or a quota, is full."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT)


def stopped_by(error: OSError, message: str) -> Stopped:
    """The exception to raise, with ``message``, after an error of the operating system."""
    return (DiskFull if no_space(error) else Stopped)(message)


def describe(error: BaseException) -> str:
    """An error in one line, with its type unless its message is meant for users."""
    text = " ".join(str(error).split())
    for_users = isinstance(error, (ValueError, ImportError, Stopped, OSError, JobFailed))
    return text if for_users and text else f"{type(error).__name__}: {text}"


class Accessory:
    """A context in which any error becomes one line, after which work goes on; Ctrl-C passes.

    For figures, videos, pages, loggers and progress, which must never cost a result. It may be entered again and again;
    whoever does so looks at ``works`` first. ``failure`` is what an error means, such as "no video".
    """

    def __init__(self, failure: str, say: Callable[[str], None]):
        self._failure, self._say = failure, say
        self.works = True  # whether nothing has failed so far

    def __enter__(self) -> Accessory:
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> bool:
        if not isinstance(error, Exception):
            return False
        self.works = False
        self._say(f"warning: {self._failure}: {describe(error)}")
        return True


@contextmanager
def never_fatal(failure: str) -> Iterator[None]:
    """The context of a command that does nothing else: an error that is not the user's ends it in one line, too."""
    try:
        yield
    except (ValueError, ModuleNotFoundError, Stopped):
        raise
    except Exception as error:
        raise Stopped(f"{failure}: {describe(error)}") from error


class Interrupts:
    """Records SIGINT and SIGTERM in its context, instead of acting on them; a second SIGINT acts at once.

    A second SIGTERM does not: a batch system sends one to every process of a job, and then a parent to its workers.
    Only the main thread receives signals. ``patience`` is after how many seconds a signal acts nevertheless, as
    KeyboardInterrupt, unless :meth:`settle` is called before.
    """

    def __init__(self, patience: Mapping[signal.Signals, float] = {}) -> None:
        self.received: int | None = None  # the signal's number, 0 for a request to stop that is no signal, or None
        self._patience = patience
        self._timer: threading.Timer | None = None
        self._overdue = False
        self._previous: dict[int, Any] = {}

    def _record(self, number: int, _frame: FrameType | None) -> None:
        if not self.received:
            self.received = received = signal.Signals(number)
            if received in self._patience:
                self._timer = threading.Timer(self._patience[received], self._insist, [received])
                self._timer.daemon = True
                self._timer.start()
        elif number == signal.SIGINT or self._overdue:
            raise KeyboardInterrupt

    def _insist(self, number: signal.Signals) -> None:
        """Send the signal again, to the main thread, where it ends a system call, too."""
        self._overdue = True
        if hasattr(signal, "pthread_kill"):
            signal.pthread_kill(threading.main_thread().ident or 0, number)
        else:
            _thread.interrupt_main(number)

    def settle(self) -> None:
        """What was under way has ended, and there is time to save it."""
        if self._timer is not None:
            self._timer.cancel()

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            self._previous = {number: signal.signal(number, self._record) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        self.settle()
        for number, handler in self._previous.items():
            signal.signal(number, handler)
