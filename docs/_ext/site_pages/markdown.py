"""Small pieces of Markdown."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

REPOSITORY_URL = ""  # of files outside docs; without one, links to them are their text


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table; bars in cells are escaped."""
    lines = [header, ["---"] * len(header), *rows]
    return "".join(f"| {' | '.join(str(cell).replace('|', chr(92) + '|') for cell in line)} |\n" for line in lines)


def as_markdown(text: str) -> str:
    """Prose of a docstring with the roles and literals of reStructuredText as code, and equations as literal blocks."""
    text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text)
    text = re.sub(r"``([^`\n]+(?:\n[^`\n]+)?)``", r"`\1`", text)
    lines: list[str] = []
    literal = False
    for line in text.splitlines():
        indented = line.startswith("    ")
        if indented and not literal and lines and not lines[-1].strip():
            literal = True
            lines.append("```text")
        if literal and line.strip() and not indented:
            literal = False
            while not lines[-1].strip():
                lines.pop()
            lines += ["```", ""]
        # The numbers of equations are at the right margin of the file, which is wider than a page.
        lines.append(re.sub(r" {3,}(\(\d+\))$", r"   \1", line[4:]) if literal else line)
    return "\n".join([*lines, *(["```"] if literal else [])])
