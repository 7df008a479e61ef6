"""Names that users give: hints for those that are unknown, the form of those that they register, how they are shown."""

from __future__ import annotations

import difflib
import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

# Control characters that a terminal obeys, but for tab and newline, and those that change the direction of text.
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]")
_FORM = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")


def nearest(name: object, known: Iterable[str]) -> str:
    """A hint with the known name nearest to ``name``, and all known names."""
    names = sorted(known)
    in_another_case = [candidate for candidate in names if candidate.lower() == str(name).lower()]
    close = in_another_case or difflib.get_close_matches(str(name), names, n=1)
    guess = f"did you mean {close[0]!r}? " if close else ""
    return f"{guess}known: {', '.join(names)}"


def nearest_few(name: str, known: Iterable[str], count: int = 3) -> str:
    """The ``count`` known names nearest to ``name``, where there are too many to list all: ``a, b, c``."""
    return ", ".join(difflib.get_close_matches(name, sorted(known), n=count, cutoff=0.0))


def check_name(name: object, what: str) -> None:
    """Refuse a name that is not lower case words joined by underscores.

    Raises:
        ValueError: naming ``what`` the name is for.
    """
    if not (isinstance(name, str) and _FORM.fullmatch(name)):
        raise ValueError(f"{what} name = {name!r} must be lower case letters, digits and underscores, as 'two_words'")


def printable(text: str) -> str:
    """``text`` with its control characters as escapes, so that a terminal does not obey them."""
    return _CONTROL.sub(lambda control: control[0].encode("unicode_escape").decode(), text)
