"""The tables of a Markdown page."""

from __future__ import annotations

import re
from collections.abc import Iterator


def tables(text: str) -> Iterator[list[dict[str, str]]]:
    """The tables of a page, as rows by the names of their columns, without the quotes of code."""
    for block in re.findall(r"(?:^\|.*\n)+", text, flags=re.MULTILINE):
        lines = block.replace("`", "").splitlines()
        header, _, *rows = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
        yield [dict(zip(header, row, strict=True)) for row in rows]
