"""What accompanies a result and must never cost it: figures, videos, pages, loggers, progress."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from algorithms.runs.interrupts import Stopped, describe

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import TracebackType


class Accessory:
    """A context in which any error becomes one line, after which work goes on; Ctrl-C passes.

    It may be entered again and again; whoever does so looks at :attr:`works` first.

    Args:
        failure: what an error means, such as "no video".
        say: prints the line.

    Attributes:
        works: whether nothing has failed so far.
    """

    def __init__(self, failure: str, say: Callable[[str], None]):
        self._failure = failure
        self._say = say
        self.works = True

    def __enter__(self) -> Accessory:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> bool:
        if not isinstance(error, Exception):
            return False
        self.works = False
        self._say(f"warning: {self._failure}: {describe(error)}")
        return True


@contextmanager
def sole_purpose(failure: str) -> Iterator[None]:
    """The context of a command that does nothing else: an error that is not the user's ends it in one line, too.

    Args:
        failure: what an error means, such as "the curves could not be drawn".
    """
    try:
        yield
    except (ValueError, ModuleNotFoundError, Stopped):
        raise
    except Exception as error:
        raise Stopped(f"{failure}: {describe(error)}") from error
