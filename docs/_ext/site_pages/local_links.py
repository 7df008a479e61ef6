"""Links of the built pages to each other: every file, picture and anchor that they name must exist.

Sphinx checks the links that it resolves itself; this also finds those in raw HTML and those to files of ``_static``.
"""

from __future__ import annotations

from html.parser import HTMLParser
from typing import TYPE_CHECKING
from urllib.parse import unquote, urlsplit

if TYPE_CHECKING:
    from pathlib import Path

STATIC = "_static"  # has pages that Sphinx does not write; links to them may end in the state in which they open
# viewcode's pages: links to them are checked, but not their own, of which some lead back to what is documented twice.
SOURCE = "_modules"


class _Page(HTMLParser):
    """The anchors of a page, and what it links to."""

    def __init__(self, path: Path):
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if value is not None and (name == "id" or (name == "name" and tag == "a")):
                self.anchors.add(value)
            elif value and name in ("href", "src"):
                self.links.append(value)


def broken_links(folder: Path) -> list[str]:
    """One line per local link of a page below ``folder`` that leads nowhere, apart from links in STATIC and SOURCE.

    Args:
        folder: of the built site, which links do not leave.
    """
    root = folder.resolve()
    pages = {path: _Page(path) for path in sorted(root.rglob("*.html")) if _part(path, root) != STATIC}
    found = []
    for path, page in pages.items():
        for link in dict.fromkeys(page.links if _part(path, root) != SOURCE else []):
            url = urlsplit(link)
            if url.scheme or url.netloc:
                continue
            target = (path.parent / unquote(url.path)).resolve() if url.path else path
            target = target / "index.html" if target.is_dir() else target
            anchor = unquote(url.fragment)
            if not (target.is_relative_to(root) and target.is_file()):
                found.append(f"{path.relative_to(root).as_posix()}: {link}: no such file")
            elif anchor and target in pages and anchor not in pages[target].anchors:
                found.append(f"{path.relative_to(root).as_posix()}: {link}: no such anchor")
    return found


def _part(path: Path, root: Path) -> str:
    """The folder or file directly below ``root`` in which a page is."""
    return path.relative_to(root).parts[0]
