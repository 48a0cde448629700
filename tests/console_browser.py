"""The bench console as a process, and a real browser to look at it."""

from __future__ import annotations

import base64
import contextlib
import os
import shutil
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from selenium import webdriver
from selenium.common.exceptions import StaleElementReferenceException
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from dm_tools.demo.demo_bench import free_ports
from support import wait_until

#: Whether every chart in sight is as wide as its place.
CHARTS_FILL = """
return [...document.querySelectorAll('[role=img]')].every((place) => {
  const svg = place.querySelector('svg');
  return !svg || !place.checkVisibility() || svg.getBoundingClientRect().width > 0.9 * place.clientWidth;
});
"""
BROWSERS = ("chromium", "google-chrome", "google-chrome-stable", "chromium-browser")
CHROMIUM, DRIVER = next(filter(None, map(shutil.which, BROWSERS)), None), shutil.which("chromedriver")
needs_browser = pytest.mark.skipif(
    not (CHROMIUM and DRIVER),
    reason="no chromium and chromedriver in PATH; run it with: sudo apt-get install chromium chromium-driver",
)
#: The accessibility engine axe-core, where somebody has installed it.
AXE = next(
    (
        path
        for folder in (Path(__file__).parents[1], Path("/usr/lib"), Path("/usr/local/lib"))
        if (path := folder / "node_modules" / "axe-core" / "axe.min.js").is_file()
    ),
    None,
)
needs_axe = pytest.mark.skipif(AXE is None, reason="no axe-core; run it with: npm install --no-save axe-core")
DESKTOP, PHONE = (1440, 1000), (390, 844)


@contextlib.contextmanager
def served(domain: int, folder: Path) -> Iterator[str]:
    """The console as a process; yields its address."""
    (port,) = free_ports(1)
    address = f"http://127.0.0.1:{port}/"
    with (folder / "console.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "dm_tools", "console", "--port", str(port)],
            stdout=log,
            stderr=subprocess.STDOUT,
            env=outside_pytest() | {"ROS_DOMAIN_ID": str(domain)},
        )
    try:
        wait_until(lambda: answers(address), 120, "the console to answer")
        yield address
    finally:
        process.terminate()
        process.wait(20)


def outside_pytest() -> dict[str, str]:
    """The environment without the variable by which NiceGUI would take the console for a test of its own."""
    return {name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"}


def answers(address: str) -> bool:
    with contextlib.suppress(urllib.error.URLError, TimeoutError), urllib.request.urlopen(address, timeout=5) as answer:
        return bool(answer.status == 200)
    return False


class Browser:
    """A page in headless Chromium, read as a person would: by names and visible text."""

    def __init__(self, address: str, width: int, height: int) -> None:
        options = webdriver.ChromeOptions()
        options.binary_location = str(CHROMIUM)
        for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu"):
            options.add_argument(argument)
        self.driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(str(DRIVER)))
        self.resize(width, height)
        self.driver.get(address)
        self.wait_for("Deformable mirror console")

    def resize(self, width: int, height: int) -> None:
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)

    @property
    def text(self) -> str:
        return str(self.driver.execute_script("return document.body.innerText"))

    def wait_for(self, words: str, timeout_s: float = 60.0) -> None:
        """Wait until the page shows `words`; fail with what it shows instead."""
        try:
            wait_until(lambda: words in self.text, timeout_s)
        except AssertionError:
            raise AssertionError(f"{words!r} not shown within {timeout_s:g} s, but:\n{self.text}") from None

    def find(self, name: str, kind: str = "*") -> Any:
        """The element with that accessible name, or that text."""
        quoted = f'"{name}"'
        path = f"//{kind}[@aria-label={quoted} or normalize-space(.)={quoted}]"
        return wait_until(lambda: self.driver.find_elements(By.XPATH, path), 60, f"{kind} named {name}")[0]

    def press(self, name: str) -> None:
        """Press a button once it is enabled."""
        wait_until(lambda: self.find(name, "button").is_enabled(), 60, f"button {name} to be enabled")
        button = self.find(name, "button")
        self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", button)
        # A click goes to a place; what appears above the button meanwhile moves it away from there.
        wait_until(lambda: self.stands_still(button), 60, f"button {name} to stand still")
        button.click()

    @staticmethod
    def stands_still(element: Any) -> bool:
        """Whether nothing moves it for a moment."""
        before = element.rect
        time.sleep(0.1)
        return bool(element.rect == before)

    def enter(self, name: str, value: str) -> None:
        """Type over the content of a field."""
        field = self.find(name, "input")
        field.send_keys(Keys.CONTROL, "a")
        field.send_keys(value)

    def unfold(self, title: str) -> None:
        """Open a card of details."""
        self.driver.execute_script("arguments[0].open = true", self.find(title, "details"))

    def prefer(self, scheme: str) -> None:
        """Have the system prefer `light` or `dark` pages."""
        feature = {"name": "prefers-color-scheme", "value": scheme}
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})

    def choose(self, name: str, option: str) -> None:
        """Choose from a list."""
        self.find(name, "input").click()
        self.find(option, "div").click()

    def picked(self, name: str) -> Any:
        """A radio button by its words, brought out from under the header."""
        button = self.find(name, "div")
        self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", button)
        return button

    def pictures(self, begin: str) -> list[str]:
        """Descriptions of the drawings in sight that begin with these words."""
        found = self.driver.find_elements(By.CSS_SELECTOR, f'[role="img"][aria-label^="{begin}"]')
        with contextlib.suppress(StaleElementReferenceException):
            return [str(picture.get_attribute("aria-label")) for picture in found if picture.is_displayed()]
        return []

    def hexagons(self) -> dict[int, Any]:
        """{number: its text on the command map, which a sign may follow}."""
        found = self.driver.find_elements(By.CSS_SELECTOR, '[role="img"][aria-label^="command map"] svg text')
        texts = [(element.text.split()[:1], element) for element in found]
        return {int(first[0]): element for first, element in texts if first and first[0].isdecimal()}

    def dismiss_all(self) -> None:
        """Take every refusal off the page."""
        while self.driver.find_elements(By.CSS_SELECTOR, ".failure:not(.missing) button"):
            with contextlib.suppress(StaleElementReferenceException, IndexError):
                self.driver.find_elements(By.CSS_SELECTOR, ".failure:not(.missing) button")[0].click()

    def violations(self) -> list[str]:
        """What axe-core finds against WCAG 2.2 AA and good practice, a line for each rule, with the elements."""
        assert AXE is not None
        self.driver.execute_script(AXE.read_text())
        found = self.driver.execute_async_script(
            "const done = arguments[0]; axe.run({resultTypes: ['violations']}).then((found) => done(found.violations))"
        )
        return [f"{rule['id']}: {rule['help']}: {[node['html'] for node in rule['nodes']]}" for rule in found]

    def alerts(self) -> str:
        return str(self.driver.execute_script("return document.querySelector('[role=alert]').innerText")).strip()

    def chosen(self) -> int:
        return int(self.find("Number", "input").get_attribute("value"))

    def shoot(self, path: Path) -> None:
        """The whole page as a PNG."""
        width, shown, height = self.driver.execute_script(
            "scrollTo(0, 0); return [innerWidth, innerHeight, Math.min(document.documentElement.scrollHeight, 8000)]"
        )
        # A window as high as the page: what Chromium takes beyond its window comes before the charts follow.
        self.resize(width, height)
        time.sleep(0.5)
        wait_until(lambda: self.driver.execute_script(CHARTS_FILL), 20, "the charts to fill their places")
        shot = self.driver.execute_cdp_cmd("Page.captureScreenshot", {})
        self.resize(width, shown)
        path.write_bytes(base64.b64decode(shot["data"]))


def shots_folder(fallback: Path) -> Path:
    """Where screenshots go: DM_SCREENSHOTS when it is set, made where it is not there."""
    folder = Path(os.environ.get("DM_SCREENSHOTS") or fallback)
    folder.mkdir(parents=True, exist_ok=True)
    return folder
