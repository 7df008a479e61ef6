"""The HTML of the explorer's page, without a browser; tests/browser opens it in one."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from algorithms.reporting.explorer.data import ExplorableFront
from algorithms.reporting.explorer.page import FORMAT, SCRIPTS, SOURCES, as_json, explorer_page, write_page
from algorithms.reporting.style import COLOURS

HOSTILE = "</script><!-- <script>alert(1)</script> & \u2028 <!-- vega -->"


def front(title: str = "a front") -> ExplorableFront:
    """A front of two policies without drives."""
    return ExplorableFront(
        title=title,
        objectives=("gain", "loss"),
        returns=np.array([[[1.0, -2.0]], [[0.5, -1.0]]]),
        scales=np.ones(2),
        signs=np.ones(2),
        success=np.full(2, np.nan),
        lengths=np.array([4.0, 5.0]),
        command="mo-deepdrive choose RUN {preference}",
    )


class Scripts(HTMLParser):
    """The attributes of every element of a page, and the text of its scripts, as a browser divides them."""

    def __init__(self, page: str):
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[str] = []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag == "script":
            self.scripts.append("")

    def handle_data(self, data: str) -> None:
        if self.scripts and self.lasttag == "script":
            self.scripts[-1] += data


@pytest.fixture(scope="module")
def page() -> str:
    return explorer_page([front(HOSTILE)], HOSTILE)


def test_the_page_is_one_file(page: str) -> None:
    elements = Scripts(page).elements
    links = [attributes for _, attributes in elements if {"src", "href"} & attributes.keys()]
    assert links == []
    policies = [each["content"] for _, each in elements if each.get("http-equiv") == "Content-Security-Policy"]
    assert [str(policy).split(";")[0] for policy in policies] == ["default-src 'none'"]


def test_hostile_text_stays_inside_of_the_data(page: str) -> None:
    found = Scripts(page)
    data, vega, code = found.scripts[:3]
    assert json.loads(data)["fronts"][0]["title"] == HOSTILE
    assert json.loads(data)["format"] == FORMAT
    assert "window.vega" in vega
    assert "class Explorer" in code
    assert "alert(1)" not in vega + code
    assert len(found.scripts) == 3
    assert "&lt;script&gt;alert(1)" in page.partition("</title>")[0]


def test_every_part_is_in_its_place(page: str) -> None:
    code = Scripts(page).scripts[2]
    positions = [code.index((SOURCES / name).read_text(encoding="utf-8").splitlines()[0]) for name in SCRIPTS]
    assert positions == sorted(positions)
    assert f"const FORMAT = {FORMAT};" in code
    assert f"--light-0: {COLOURS[0]};" in page
    assert "/* series */" not in page
    assert re.search(r"<!--\nThis page contains Vega \d+\.\d+\.\d+ and", page)
    assert not re.search(r"<!-- (title|style|data|licences|vega|script) -->", page.replace(HOSTILE, ""))


def test_the_page_takes_less_than_a_megabyte_besides_its_data(page: str) -> None:
    assert len(page.encode()) < 1e6


def test_a_page_is_written_as_a_whole(tmp_path: Path, page: str) -> None:
    write_page([front(HOSTILE)], tmp_path / "explore.html", HOSTILE)
    assert (tmp_path / "explore.html").read_text(encoding="utf-8") == page
    with pytest.raises(OSError, match="nowhere"):
        write_page([front()], tmp_path / "nowhere" / "explore.html", "Explorer")


def test_json_cannot_end_its_script_and_has_only_numbers() -> None:
    text = as_json({"a": "</script>&<!--", "b": [1.5]})
    assert json.loads(text) == {"a": "</script>&<!--", "b": [1.5]}
    assert not re.search("[<>&]", text)
    with pytest.raises(ValueError, match="not JSON compliant"):
        as_json([float("nan")])
