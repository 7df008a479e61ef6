"""What Sphinx is told about docstrings: sections in Markdown, and indented equations."""

from __future__ import annotations

import re
from typing import Any

_SECTION = re.compile(r"(Args|Attributes|Example|Examples|Note|Raises|Returns|Yields):")


def prepare(app: Any, what: str, name: str, owner: Any, options: Any, lines: list[str]) -> None:
    """Leave the Markdown sections of environments to their pages, and keep the lines of equations as they are.

    A handler of ``autodoc-process-docstring``, before napoleon's.
    """
    del app, what, name, owner, options
    markdown = next((i for i, line in enumerate(lines) if line.startswith("## ")), None)
    if markdown is not None:
        google = next((i for i, line in enumerate(lines) if i > markdown and _SECTION.fullmatch(line)), len(lines))
        lines[markdown:google] = ["Spaces, rewards and ends: the pages of the environments.", ""]
    lines[:] = literal_equations(lines)


def literal_equations(lines: list[str]) -> list[str]:
    """Mark indented blocks that follow a paragraph as literal, up to the first section of Google's style."""
    found: list[str] = []
    paragraph = ""  # the last line that is not indented
    inside = False
    for i, line in enumerate(lines):
        if line and not line.startswith(" "):
            paragraph, inside = line, False
            if _SECTION.fullmatch(line):
                return found + lines[i:]
        elif line.startswith("    ") and not inside and found and not found[-1].strip():
            inside = True
            if paragraph and not paragraph.endswith("::") and not re.match(r"[-*\d.]+ ", paragraph):
                found += ["::", ""]
        found.append(line)
    return found
