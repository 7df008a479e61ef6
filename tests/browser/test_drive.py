"""The page to drive on, in a browser: by keyboard and by touch, on a desktop and on a phone."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from selenium.webdriver import ActionChains, Keys

from algorithms.reporting.page.page import write_site
from algorithms.runs.web import Link
from tests.browser.explorer_page import Page

pytestmark = [pytest.mark.slow, pytest.mark.browser]

DESKTOP, PHONE = (1280, 800), (390, 844)
FIRST_LOAD = 1_500_000  # bytes
TABS = ("drive", "preference", "against", "questions", "explorer")


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        pass


class Site:
    """The site on a server of this machine, as one sees it."""

    def __init__(self, page: Page, address: str):
        self.page, self.address = page, address

    def open(self, link: str = "#drive") -> None:
        self.page.browser.get("about:blank")
        self.page.browser.get(f"{self.address}index.html{link}")
        shown = "['stage-map', 'left-map', 'map'].some((id) => document.querySelector(`#${id} .vehicle`))"
        self.page.wait_for(f"return {shown} || !document.getElementById('message').hidden")

    def take(self, selector: str, text: str) -> None:
        """Choose an entry of a menu by what it says."""
        self.page.run(
            """window.dispatchEvent(new Event('pointerdown'));
            for (const each of document.querySelectorAll('#stage-map .vehicle')) each.dataset.old = '';"""
        )
        for option in self.page.all(f"{selector} option"):
            if option.text == text:
                option.click()
        self.page.wait_for("return document.querySelector('#stage-map .vehicle:not([data-old])') !== null")

    def finish(self) -> None:
        self.page.wait_for("return !document.getElementById('outcome').hidden")

    def link(self) -> str:
        self.page.run("navigator.clipboard.writeText = async (text) => { window.copied = text; }")
        self.page.run("document.getElementById('share').click()")
        return str(self.page.run("return window.copied"))

    def earned(self) -> list[float]:
        """The vector return that the bars show."""
        texts = [output.text for output in self.page.all("#bars output")]
        return [float(text.split()[0].replace("\N{MINUS SIGN}", "-")) for text in texts]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("site")
    write_site(path)
    return path


@pytest.fixture(scope="module")
def address(folder: Path) -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


@pytest.fixture
def site(page: Page, address: str) -> Site:
    page.size(*DESKTOP)
    return Site(page, address)


def hold(site: Site, *keys: str) -> None:
    actions = ActionChains(site.page.browser)
    for key in keys:
        actions.key_down(key)
    actions.perform()


def test_a_drive_by_keyboard_earns_what_its_link_earns_in_python(site: Site) -> None:
    site.open()
    assert site.page.find("#prompt").is_displayed()
    hold(site, Keys.ARROW_UP, Keys.ARROW_RIGHT)
    site.page.wait_for("return parseInt(document.getElementById('speedometer').textContent) > 3")
    assert not site.page.find("#prompt").is_displayed()
    site.finish()
    earned, link = site.earned(), Link.read(site.link())
    driven, _ = link.replay()
    assert earned == pytest.approx(driven.returns[0, 0], abs=0.51, rel=0.01)
    ending = driven.ends[0, 0].replace("_", " ")
    assert site.page.text("#outcome-heading").lower().startswith(ending)
    assert site.page.text("#verdict")
    rows = [row.text for row in site.page.all("#rivals tbody tr")]
    assert sum(row.startswith("you ") for row in rows) == 1 < len(rows)
    # Whoever gets the link sees the same drive.
    site.open(site.link().partition("index.html")[2])
    site.finish()
    assert site.earned() == earned


def test_a_thumb_drives_on_a_phone(site: Site) -> None:
    site.page.size(*PHONE)
    site.open()
    pad = site.page.find("#pad").rect
    x, y = pad["x"] + pad["width"] / 2, pad["y"] + pad["height"] / 2
    assert pad["y"] + pad["height"] <= PHONE[1], "map and thumb are on the screen together"
    for kind, points in (
        ("touchStart", [{"x": x, "y": y}]),
        ("touchMove", [{"x": x, "y": y - 50}]),
    ):
        site.page.browser.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    site.page.wait_for("return parseInt(document.getElementById('speedometer').textContent) > 3")
    site.page.browser.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    assert site.page.find("#thumb").get_attribute("style").endswith("translate(0px, 0px);")


def test_eight_vehicles_move_sixty_times_a_second_each_with_its_own_preference(site: Site) -> None:
    site.open("#preference")
    site.take("#world", "Roundabout")
    vehicles = site.page.all("#stage-map .vehicle")
    assert len({vehicle.get_attribute("fill") for vehicle in vehicles}) == len(vehicles) == 8
    measure = """const done = arguments[0], times = [];
        const frame = (now) => { times.push(now); times.length < 150 ? requestAnimationFrame(frame) : done(times); };
        requestAnimationFrame(frame);"""
    # Other programs may have the machine for a while.
    tries = [site.page.browser.execute_async_script(measure) for _ in range(3)]
    assert min(np.median(np.diff(times)) for times in tries) < 17
    before = vehicles[3].get_attribute("fill")
    site.page.all("#riders button")[3].click()
    site.page.run(
        """const slider = document.querySelector('#wish-sliders input');
        slider.value = 0; slider.dispatchEvent(new Event('input'));"""
    )
    site.page.all("#wish-sliders input")[1].send_keys(Keys.END)
    assert site.page.all("#wish-sliders output")[0].text == "0%"
    assert site.page.all("#stage-map .vehicle")[4].get_attribute("fill") != before


def test_a_policy_drives_the_other_vehicle_once_one_starts(site: Site) -> None:
    site.open("#against")
    site.take("#world", "Intersection")
    where = "return document.querySelector('#stage-map [data-vehicle=\"1\"]').getAttribute('transform')"
    start = site.page.run(where)
    assert start == site.page.run(where)
    hold(site, "w")
    site.page.wait_for(f"{where} !== '{start}'")


def test_a_ghost_shows_the_best_known_drive(site: Site) -> None:
    site.open("#against")
    site.take("#world", "OneWaypoint")
    assert [vehicle.get_attribute("data-policy") for vehicle in site.page.all("#stage-map .vehicle")][::-1] == [
        "you",
        "the best known drive",
    ]


def test_seven_answers_lead_to_weights_and_a_policy(site: Site, folder: Path) -> None:
    site.open("#questions")
    for number in range(1, 8):
        site.page.wait_for(
            f"return document.getElementById('question').textContent.startsWith('Question {number} of 7')"
        )
        site.page.press("1" if number % 2 else Keys.ARROW_RIGHT)
    site.page.wait_for("return !document.getElementById('answer').hidden")
    (row,) = [row for row in json.loads((folder / "page.json").read_text())["worlds"] if row["questions"]][:1]
    questions = json.loads((folder / row["json"]).read_text())["questions"]
    found = questions["found"][0b0101010]
    assert f"Take {questions['drives'][found['best']]['label']}:" in site.page.text("#advice")
    shown = [float(output.text.split("%")[0]) for output in site.page.all("#weights-found output")]
    assert shown == pytest.approx([100 * weight for weight in found["weights"]], abs=0.51)
    site.page.find("#take").click()
    site.page.wait_for("return document.querySelector('#tab-preference').ariaSelected === 'true'")


@pytest.mark.parametrize("size", [DESKTOP, PHONE])
@pytest.mark.parametrize("colours", ["light", "dark"])
def test_every_tab_fits_the_screen(site: Site, size: tuple[int, int], colours: str) -> None:
    site.page.size(*size)
    site.page.colours(colours)
    for tab in TABS:
        site.open(f"#{tab}")
        wider = "return document.documentElement.scrollWidth - document.documentElement.clientWidth"
        assert site.page.run(wider) == 0, tab
        assert site.page.text("#message") == ""
        assert site.page.find(f"#tab-{tab}").get_attribute("aria-selected") == "true"


def test_the_first_picture_is_there_at_once_and_little_is_loaded(site: Site) -> None:
    paints = []
    for _ in range(3):  # other programs may have the machine for a while
        site.open()
        paints += site.page.run("return performance.getEntriesByName('first-contentful-paint').map((e) => e.startTime)")
    assert min(paints) < 1000
    loaded = site.page.run(
        """return [...performance.getEntriesByType('navigation'), ...performance.getEntriesByType('resource')]
        .reduce((total, entry) => total + entry.encodedBodySize, 0)"""
    )
    assert 0 < loaded < FIRST_LOAD


def test_all_files_of_the_site_together_are_small(folder: Path) -> None:
    files = [path for path in folder.iterdir() if path.name != "explorer.json"]  # which only its tab loads
    assert sum(path.stat().st_size for path in files) < FIRST_LOAD


@pytest.mark.parametrize(
    ("link", "message"),
    [
        ("#drive=eyJmb3JtYXQiOjB9.00000000", "This link was cut or edited."),
        ("#drive=abc", "This link was cut or edited."),
        ("#drive=eyJmb3JtYXQiOjB9.4634b936", "This link is of version"),
    ],
)
def test_a_link_that_holds_no_drive_says_so(site: Site, link: str, message: str) -> None:
    site.open(link)
    assert site.page.text("#message").startswith(message)


def test_without_webassembly_the_page_says_so(site: Site) -> None:
    run = site.page.browser.execute_cdp_cmd
    script = run("Page.addScriptToEvaluateOnNewDocument", {"source": "delete window.WebAssembly"})
    site.open()
    assert site.page.text("#message").startswith("This browser has no WebAssembly")
    run("Page.removeScriptToEvaluateOnNewDocument", script)


def test_a_module_of_another_version_is_refused(page: Page, folder: Path, tmp_path: Path) -> None:
    for file in folder.iterdir():
        text = file.read_bytes()
        (tmp_path / file.name).write_bytes(re.sub(rb'"version": ?"[^"]+"', b'"version":"0"', text))
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(tmp_path))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        site = Site(page, f"http://127.0.0.1:{server.server_port}/")
        site.open()
        assert "of version 0" in page.text("#message")
        server.shutdown()
