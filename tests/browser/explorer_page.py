"""The explorer's page in a browser, in the words of the tests."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from selenium.webdriver import ActionChains, Keys
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

EPISODES, SEED = 4, 2_000_000
WIDE, NARROW = (1280, 900), (360, 740)


class Page:
    """The page that the browser shows."""

    def __init__(self, browser: Any):
        self.browser = browser
        self.size(*WIDE)
        self.colours("light")
        self.errors()

    def open(self, path: Path, link: str = "") -> None:
        self.browser.get("about:blank")  # a link alone would not load the page again
        self.browser.get(path.as_uri() + link)
        self.wait_for("return !document.getElementById('content').hidden || !document.getElementById('message').hidden")

    def errors(self) -> list[str]:
        """What the console has said since the last call."""
        return [entry["message"] for entry in self.browser.get_log("browser")]

    def size(self, width: int, height: int) -> None:
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)

    def colours(self, scheme: str) -> None:
        feature = {"name": "prefers-color-scheme", "value": scheme}
        self.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})

    def run(self, script: str, *arguments: Any) -> Any:
        return self.browser.execute_script(script, *arguments)

    def wait_for(self, script: str) -> None:
        WebDriverWait(self.browser, 30, 0.05).until(lambda browser: browser.execute_script(script))

    def find(self, selector: str) -> Any:
        return self.browser.find_element(By.CSS_SELECTOR, selector)

    def all(self, selector: str) -> list[Any]:
        return list(self.browser.find_elements(By.CSS_SELECTOR, selector))

    def press(self, *keys: str) -> None:
        ActionChains(self.browser).send_keys(*keys).perform()

    def text(self, selector: str) -> str:
        return str(self.find(selector).text)

    # ------------------------------------------------------------------------------------------------------- the choice

    def chosen(self) -> int:
        return int(self.find("#chosen").get_attribute("data-policy"))

    def slide(self, selector: str, values: Sequence[float]) -> None:
        """Set the sliders below ``selector``, as moving them does."""
        sliders = self.all(f"{selector} input[type=range]")
        assert len(sliders) == len(values)
        self.run(
            """arguments[0].forEach((slider, i) => {
                slider.value = arguments[1][i];
                slider.dispatchEvent(new Event("input", { bubbles: true }));
            })""",
            sliders,
            list(values),
        )

    def mode(self, name: str) -> None:
        self.find(f"input[name=mode][value={name}]").click()

    def command(self) -> list[str]:
        """The words of the command that evaluates the choice."""
        return shlex.split(str(self.find("#command").get_property("value")))

    def preference(self, option: str) -> dict[str, float]:
        """The numbers that the command names after ``option``, by objective."""
        words = self.command()
        rest = words[words.index(option) + 1 :]
        end = next((i for i, word in enumerate(rest) if word.startswith("--")), len(rest))
        return {name: float(value) for name, _, value in (word.partition("=") for word in rest[:end])}

    def link(self) -> str:
        self.run("return new Promise((resolve) => setTimeout(resolve, 300))")  # it is written after a pause
        return "#" + urlsplit(self.browser.current_url).fragment

    # ------------------------------------------------------------------------------------------------------- the front

    def brush(self, axis: int, low: float, high: float) -> None:
        """Drag along an upright axis from the share ``low`` to the share ``high`` of its height."""
        hit = self.all("#parallel .hit")[axis]
        rectangle = hit.rect
        height = rectangle["height"] - 12  # the area reaches 6 pixels beyond the axis at both ends

        def above_middle(share: float) -> int:
            return round((0.5 - share) * height)

        mouse = ActionChains(self.browser, duration=20)
        mouse.move_to_element_with_offset(hit, 0, above_middle(low)).click_and_hold()
        mouse.move_to_element_with_offset(hit, 0, above_middle(high)).release().perform()

    def set_range(self, objective: int, end: int, value: str) -> None:
        """Type a limit of a range, with the keyboard."""
        if not self.find("details").get_property("open"):
            self.find("summary").send_keys(Keys.ENTER)
        field = self.find(f"[data-range='{objective}/{end}']")
        field.clear()
        field.send_keys(value, Keys.TAB)

    def listed(self) -> list[int]:
        """The policies of the table."""
        rows = self.all("#policies tbody tr")
        return [int(row.get_attribute("data-policy")) for row in rows]

    # ------------------------------------------------------------------------------------------------------- the drives

    def scrub(self, step: int) -> None:
        self.run(
            "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('input'))",
            self.find("#time"),
            step,
        )

    def poses(self) -> dict[str, tuple[float, float, float]]:
        """x (m), y (m) and heading (degrees) of every vehicle on the map, by policy."""
        found = {}
        for vehicle in self.all("#map .vehicle"):
            pattern = r"translate\((\S+) (\S+)\) rotate\((\S+)\)"
            x, y, degrees = re.fullmatch(pattern, vehicle.get_attribute("transform")).groups()
            found[vehicle.get_attribute("data-policy")] = (float(x), float(y), float(degrees))
        return found
