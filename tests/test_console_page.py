"""The bench console in a real browser, on the virtual bench: a calibration, a move, an error, the keyboard, a phone."""

from __future__ import annotations

import base64
import contextlib
import functools
import os
import shutil
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from selenium import webdriver
from selenium.common.exceptions import StaleElementReferenceException
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from dm_controller.cli.demo import bench_config, free_ports
from dm_controller.suite import Suite
from support import own_domain, wait_until

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(
    not (CHROMIUM and DRIVER),
    reason="no chromium and chromedriver in PATH; on Debian: sudo apt-get install chromium chromium-driver",
)
DESKTOP, PHONE = (1440, 1000), (390, 844)


@contextlib.contextmanager
def served(domain: int, folder: Path) -> Iterator[str]:
    """The console as a process; yields its address."""
    (port,) = free_ports(1)
    address = f"http://127.0.0.1:{port}/"
    with (folder / "console.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "dm_controller.cli", "console", "--port", str(port)],
            stdout=log,
            stderr=subprocess.STDOUT,
            env=outside_pytest() | {"ROS_DOMAIN_ID": str(domain)},
        )
    try:
        wait_until(lambda: answers(address), 60, "the console to answer")
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

    def wait_for(self, words: str, timeout_s: float = 30.0) -> None:
        """Wait until the page shows `words`; fail with what it shows instead."""
        try:
            wait_until(lambda: words in self.text, timeout_s)
        except AssertionError:
            raise AssertionError(f"{words!r} not shown within {timeout_s:g} s, but:\n{self.text}") from None

    def find(self, name: str, kind: str = "*") -> Any:
        """The element with that accessible name, or that text."""
        quoted = f'"{name}"'
        path = f"//{kind}[@aria-label={quoted} or normalize-space(.)={quoted}]"
        return wait_until(lambda: self.driver.find_elements(By.XPATH, path), 20, f"{kind} named {name}")[0]

    def press(self, name: str) -> None:
        """Press a button once it is enabled."""
        wait_until(lambda: self.find(name, "button").is_enabled(), 60, f"button {name} to be enabled")
        button = self.find(name, "button")
        self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", button)
        button.click()

    def enter(self, name: str, value: str) -> None:
        """Type over the content of a field."""
        field = self.find(name, "input")
        field.send_keys(Keys.CONTROL, "a")
        field.send_keys(value)

    def pictures(self, begin: str) -> list[str]:
        """Descriptions of the drawings that begin with these words."""
        found = self.driver.find_elements(By.CSS_SELECTOR, f'svg[aria-label^="{begin}"]')
        with contextlib.suppress(StaleElementReferenceException):
            return [str(picture.get_attribute("aria-label")) for picture in found]
        return []

    def alerts(self) -> str:
        return str(self.driver.execute_script("return document.querySelector('[role=alert]').innerText")).strip()

    def chosen(self) -> int:
        return int(self.find("Number", "input").get_attribute("value"))

    def shoot(self, path: Path) -> None:
        """The whole page as a PNG."""
        width, height = self.driver.execute_script(
            "return [innerWidth, Math.min(document.documentElement.scrollHeight, 8000)]"
        )
        clip = {"x": 0, "y": 0, "width": width, "height": height, "scale": 1}
        self.driver.execute_script("scrollTo(0, 0)")
        shot = self.driver.execute_cdp_cmd("Page.captureScreenshot", {"captureBeyondViewport": True, "clip": clip})
        path.write_bytes(base64.b64decode(shot["data"]))


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """The console of a bench of its own; the tests run in order and find what the ones before left."""
    folder = tmp_path_factory.mktemp("console")
    config = bench_config(folder, "prandtl_ishlinskii", 0.01, 3, 20.0)
    with own_domain() as domain, Suite(config, folder, domain) as suite, served(domain, folder) as address:
        browser = Browser(address, *DESKTOP)
        try:
            yield browser
        finally:
            browser.driver.quit()
            suite.check()


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where screenshots go: DM_SCREENSHOTS when it is set."""
    named = os.environ.get("DM_SCREENSHOTS")
    return Path(named) if named else tmp_path_factory.mktemp("shots")


def test_before_a_calibration_the_page_says_why_nothing_can_be_focused(page: Browser) -> None:
    page.wait_for("driver: active")
    page.wait_for("The mirror is not calibrated: run a calibration or load one.")
    button = page.find("Move", "button")
    assert not button.is_enabled()
    shell = button.find_element(By.XPATH, "..")
    assert "not calibrated" in shell.get_attribute("title")


def test_nothing_is_fetched_from_elsewhere(page: Browser) -> None:
    names = page.driver.execute_script("return performance.getEntriesByType('resource').map((entry) => entry.name)")
    own = page.driver.current_url
    assert names and all(name.startswith(own) for name in names)


def test_a_calibration_shows_progress_and_residual_and_is_used(page: Browser, shots: Path) -> None:
    page.find("Plan", "input").click()
    page.find("Pokes only", "div").click()
    page.press("Calibrate")
    page.wait_for("Step ", 30)
    wait_until(lambda: page.pictures("residual of"), 60, "residuals of the run")
    assert page.find("Cancel calibration", "button").is_enabled()
    page.shoot(shots / "console-calibrating.png")
    page.wait_for(": held-out residual ", 240)
    page.wait_for("Reachable ")
    assert page.alerts() == ""


def test_a_move_is_predicted_first_then_taken_and_measured(page: Browser, shots: Path) -> None:
    page.enter("Curvature, 1/m", "0.02004")
    page.wait_for("= +0.0401 dioptre")
    page.wait_for("Predicted residual")
    page.press("Move")
    page.wait_for("Move: +0.0200 1/m stands after", 60)
    page.press("Measure")
    page.wait_for("Measure: rms", 60)
    page.wait_for("The map is of the present shape.")
    for begin in ("measured surface", "predicted surface", "measured minus predicted", "Measured − predicted"):
        wait_until(functools.partial(page.pictures, begin), 20, begin)
    page.shoot(shots / "console-desktop.png")


def test_the_slider_follows_the_arrow_keys(page: Browser) -> None:
    field = page.find("Curvature, 1/m", "input")
    before = float(field.get_attribute("value"))
    page.driver.find_element(By.CSS_SELECTOR, '[role="slider"] [tabindex="0"]').send_keys(Keys.ARROW_RIGHT)
    wait_until(lambda: before < float(field.get_attribute("value")) <= before + 0.001, 10, "a larger curvature")


def test_an_unreachable_curvature_is_refused_in_a_sentence_that_stays(page: Browser, shots: Path) -> None:
    page.enter("Curvature, 1/m", "0.9")
    page.press("Move")
    wait_until(lambda: "curvature = +0.9000 1/m" in page.alerts(), 30, "the refusal")
    page.resize(*PHONE)
    width, inner = page.driver.execute_script("return [document.documentElement.scrollWidth, innerWidth]")
    assert width <= inner == PHONE[0]
    page.driver.execute_script("scrollTo(0, document.documentElement.scrollHeight / 2)")
    covered = page.driver.execute_script(
        "const box = document.querySelector('.failure').getBoundingClientRect();"
        "const top = document.elementFromPoint(box.x + box.width / 2, box.y + box.height / 2);"
        "return !top || !top.closest('.failure')"
    )
    assert not covered
    page.shoot(shots / "console-phone.png")
    page.resize(*DESKTOP)
    page.press("Dismiss: Move")
    wait_until(lambda: page.alerts() == "", 10, "the dismissal")


def test_actuators_are_chosen_poked_and_released_by_keyboard(page: Browser) -> None:
    group = page.find("Actuators. Arrow keys choose, Enter pokes, Escape releases", "div")
    group.send_keys(Keys.ARROW_RIGHT)
    wait_until(lambda: page.chosen() != 1, 10, "another actuator")
    chosen = page.chosen()
    page.find("Actuators. Arrow keys choose, Enter pokes, Escape releases", "div").send_keys(Keys.ENTER)
    page.wait_for(f"Poke {chosen}: actuator {chosen} at ", 60)
    ActionChains(page.driver).send_keys(Keys.ESCAPE).perform()
    page.wait_for("Release: back at the shape before", 30)


def test_a_click_on_a_hexagon_chooses_it(page: Browser) -> None:
    def clicked() -> bool:
        with contextlib.suppress(StaleElementReferenceException):
            page.driver.find_element(By.CSS_SELECTOR, '[data-actuator="12"]').click()
        return page.chosen() == 12

    wait_until(clicked, 15, "actuator 12")


def test_without_nodes_the_page_says_what_is_missing(domain: int, tmp_path: Path) -> None:
    with served(domain, tmp_path) as address:
        browser = Browser(address, *PHONE)
        try:
            browser.wait_for("No node of the suite is heard. Start them (./dm up)")
            assert "driver: not heard" in browser.text
        finally:
            browser.driver.quit()


def test_another_host_name_is_refused(domain: int, tmp_path: Path) -> None:
    with served(domain, tmp_path) as address:
        request = urllib.request.Request(address, headers={"Host": "mirror.example"})
        with pytest.raises(urllib.error.HTTPError) as refusal:
            urllib.request.urlopen(request, timeout=10)
        assert refusal.value.code == 400


def test_a_port_in_use_is_named(domain: int) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        command = [sys.executable, "-m", "dm_controller.cli", "console", "--port", str(port)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert f"--port {port}" in done.stderr
