"""The page of the explorer: one HTML file with its data, code and plotting library in it.

The plots are drawn by Vega, which the package vl-convert-python contains as JavaScript. It takes an eighth of the
space of plotly.js (0.6 MB instead of 4.8 MB), draws parallel coordinates as vectors, which needs no WebGL, and tells
the page which range of an axis is brushed.
"""

from __future__ import annotations

import functools
import html
import json
import re
from importlib import resources
from typing import TYPE_CHECKING, Any

from algorithms.reporting.style import COLOURS
from mo_deepdrive.support.atomic_io import atomic_write

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from algorithms.reporting.page.data import ExplorableFront

EXPLORER_FILE = "explore.html"
FORMAT = 3  # of the data, which the page checks
SOURCES = resources.files("algorithms.reporting.page")
# In this order, as one module.
SCRIPTS = ("shared.js", "rules.js", "views.js", "map.js", "model.js", "panels.js", "explorer.js", "start.js")
# Colours of COLOURS of the chosen policy and of those that it is compared with: on white, and on black.
LIGHT_SERIES, DARK_SERIES = (0, 1, 2, 7), (5, 4, 2, 3)


def explorer_page(fronts: Sequence[ExplorableFront], title: str) -> str:
    """The HTML of the explorer for some fronts, the first of which is shown first.

    It needs no network, which its content security policy forbids. Data are data: they are in a block of JSON that no
    browser runs, and the page writes them as text.
    """
    from vl_convert import get_vega_version  # not earlier: it starts a JavaScript engine

    series = " ".join(
        f"--{page}-{number}: {COLOURS[colour]};"
        for page, colours in (("light", LIGHT_SERIES), ("dark", DARK_SERIES))
        for number, colour in enumerate(colours)
    )
    version = get_vega_version()
    data = {"format": FORMAT, "fronts": [front.to_json() for front in fronts]}
    parts = {
        "title": html.escape(title),
        "style": _read("explorer.css").replace("/* series */", series),
        "data": as_json(data),
        "licences": _read("licences.txt").replace("@version@", version),
        "vega": _vega(version),
        "script": "\n".join(map(_read, SCRIPTS)).replace("/* format */ 0", str(FORMAT)),
    }
    page = _read("page.html")
    pieces = []
    for name, text in parts.items():  # in the page's order, so that no part is searched for another's mark
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


@functools.cache
def _vega(version: str) -> str:
    """Vega's runtime as JavaScript that sets ``window.vega``."""
    from vl_convert import javascript_bundle

    # The name that Vega-Embed's modules import it by, a file in vl-convert-python; nothing is fetched.
    bundle: str = javascript_bundle(
        f"import * as runtime from 'https://cdn.jsdelivr.net/npm/vega@{version}/+esm';"
        "window.vega = {View: runtime.View, parse: runtime.parse, Error: runtime.Error};"
    )
    if re.search("</script|<!--", bundle, flags=re.IGNORECASE):
        raise ValueError("Vega's code cannot be inside an HTML page: it holds the end of a script")
    return bundle


def _read(name: str) -> str:
    return (SOURCES / name).read_text(encoding="utf-8")
