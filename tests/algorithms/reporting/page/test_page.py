"""The HTML of the explorer's page, without a browser; tests/browser opens it in one."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from algorithms.reporting.page.data import ExplorableFront
from algorithms.reporting.page.page import FORMAT, as_json, explorer_page

HOSTILE = "</script><!-- <script>alert(1)</script> & \u2028 <!-- script -->"


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
    data, code = found.scripts
    assert json.loads(data)["fronts"][0]["title"] == HOSTILE
    assert json.loads(data)["format"] == FORMAT
    assert "class Explorer" in code
    assert "alert(1)" not in code
    assert "&lt;script&gt;alert(1)" in page.partition("</title>")[0]


def test_json_cannot_end_its_script_and_has_only_numbers() -> None:
    text = as_json({"a": "</script>&<!--", "b": [1.5]})
    assert json.loads(text) == {"a": "</script>&<!--", "b": [1.5]}
    assert not re.search("[<>&]", text)
    with pytest.raises(ValueError, match="not JSON compliant"):
        as_json([float("nan")])
