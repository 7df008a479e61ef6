"""The page: driving in a browser and, as one of its tabs or as a file of its own, the explorer of fronts.

The site is an ``index.html`` beside the files that ``docs/page_files.md`` describes; it asks for nothing else. The
explorer alone is one HTML file with its data and its code in it.
"""

from __future__ import annotations

import html
import json
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from algorithms.reporting.style import COLOURS
from mo_deepdrive import __version__
from mo_deepdrive.support.atomic_io import atomic_write

if TYPE_CHECKING:
    from collections.abc import Sequence

    from algorithms.reporting.page.data import ExplorableFront

EXPLORER_FILE = "explore.html"
FORMAT = 3  # of the data, which the page checks
SOURCES = resources.files("algorithms.reporting.page")
# Between shared.js, map.js and start.js, in this order, as one module.
EXPLORER = ("rules.js", "plots.js", "model.js", "explorer.js")
DRIVING = ("world.js", "stage.js", "questions.js")
WORLDS = SOURCES / "worlds"
# Colours of COLOURS of the chosen policy and of those that it is compared with: on white, and on black.
LIGHT_SERIES, DARK_SERIES = (0, 1, 2, 7), (5, 4, 2, 3)


def explorer_page(fronts: Sequence[ExplorableFront], title: str) -> str:
    """The HTML of the explorer for some fronts, the first of which is shown first.

    It needs no network, which its content security policy forbids. Data are data: they are in a block of JSON that no
    browser runs, and the page writes them as text.
    """
    return _page(
        sources="script-src 'unsafe-inline'",
        title=html.escape(title),
        heading="Explorer of fronts",
        tabs="",
        data=_fronts(fronts),
        script=_script(EXPLORER),
    )


def write_site(directory: str | Path) -> None:
    """Write ``index.html`` with all tabs, and the package's worlds and policies beside it.

    An OSError if the directory cannot be written.
    """
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    for file in WORLDS.iterdir():
        if file.is_file():
            atomic_write(folder / file.name, file.read_bytes())
    page = _page(
        sources="script-src 'unsafe-inline' 'wasm-unsafe-eval'; connect-src 'self'",
        title="MO-DeepDrive: drive in the browser",
        heading="MO-DeepDrive",
        tabs=_read("drive.html"),
        data="",
        script=_script((*EXPLORER, *DRIVING)),
    )
    atomic_write(folder / "index.html", page.encode())


def write_fronts(path: str | Path, fronts: Sequence[ExplorableFront]) -> None:
    """Write the data of the site's explorer, one of the files that are shipped."""
    atomic_write(path, _fronts(fronts).encode())


def _fronts(fronts: Sequence[ExplorableFront]) -> str:
    return as_json({"format": FORMAT, "fronts": [front.to_json() for front in fronts]})


def _script(parts: Sequence[str]) -> str:
    code = "\n".join(_read(name) for name in ("shared.js", "map.js", *parts, "start.js"))
    return code.replace("/* format */ 0", str(FORMAT)).replace('/* version */ ""', json.dumps(__version__))


def _page(**parts: str) -> str:
    """The page with its parts, which are named in its order, so that no part is searched for another's mark."""
    series = " ".join(
        f"--{page}-{number}: {COLOURS[colour]};"
        for page, colours in (("light", LIGHT_SERIES), ("dark", DARK_SERIES))
        for number, colour in enumerate(colours)
    )
    style = _read("page.css").replace("/* series */", series)
    page = _read("page.html").replace("<!-- style -->", style)
    pieces = []
    for name, text in parts.items():
        before, _, page = page.partition(f"<!-- {name} -->")
        pieces += [before, text]
    return "".join([*pieces, page])


def write_page(fronts: Sequence[ExplorableFront], path: str | Path, title: str) -> None:
    """Write :func:`explorer_page` to a file."""
    atomic_write(path, explorer_page(fronts, title).encode())


def as_json(data: Any) -> str:
    """``data`` as JSON that can be inside a ``script`` element; a number that is not finite is a ValueError."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _read(name: str) -> str:
    return (SOURCES / name).read_text(encoding="utf-8")
