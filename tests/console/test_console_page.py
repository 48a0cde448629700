"""The bench console in a real browser, on the virtual bench: a calibration, a move, an error, the keyboard, a phone."""

from __future__ import annotations

import contextlib
import functools
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from selenium.common.exceptions import StaleElementReferenceException
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from console_browser import DESKTOP, PHONE, Browser, needs_browser, served, shots_folder
from dm_calibration.calibration_parameters import PARAMETERS
from dm_common.ros.domains import own_domain
from dm_tools.demo.demo_bench import bench_config
from fault_injection.rigs.forked_node import ForkedSuite
from studies.quick_trigger import quick_trigger
from support import Observer, wait_until

pytestmark = [pytest.mark.processes, needs_browser]


@dataclass
class RunningConsole:
    """A bench of its own with its console; `suite` may be replaced."""

    config: dict[str, dict[str, Any]]
    folder: Path
    domain: int
    address: str
    suite: ForkedSuite


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningConsole]:
    folder = tmp_path_factory.mktemp("console")
    config = bench_config(folder, "prandtl_ishlinskii", 0.01, 3, 20.0)
    config["virtual_bench"] |= {"interferometer.pixels": 236, "clock.period": 0.02}
    config["interferometer"]["trigger_command"] = quick_trigger(config["virtual_bench"]["trigger.port"])
    config["calibration"]["write_report"] = False
    with own_domain() as domain, served(domain, folder) as address:
        bench = RunningConsole(config, folder, domain, address, ForkedSuite(config, folder, domain).__enter__())
        try:
            yield bench
            bench.suite.check()
        finally:
            bench.suite.stop()


@contextlib.contextmanager
def settling(domain: int, seconds: float) -> Iterator[None]:
    """Calibrations wait so long before each map, s of the bench's time; afterwards as long as by default."""
    default = next(parameter.default for parameter in PARAMETERS if parameter.name == "settle_time")
    with Observer(domain) as observer:

        def put(value: float) -> None:
            told = [Parameter("settle_time", value=value).to_parameter_msg()]
            answer = observer.call(SetParameters, "calibration/set_parameters", SetParameters.Request(parameters=told))
            assert answer.results[0].successful, answer.results[0].reason

        put(seconds)
        yield
        put(default)


@pytest.fixture(scope="module")
def page(bench: RunningConsole) -> Iterator[Browser]:
    """Its page; the tests run in order and find what the ones before left."""
    browser = Browser(bench.address, *DESKTOP)
    yield browser
    browser.driver.quit()


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return shots_folder(tmp_path_factory.mktemp("shots"))


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


def test_a_calibration_that_is_cancelled_says_so(page: Browser, bench: RunningConsole) -> None:
    # The longest plan, two seconds a map: it must not end, and be fitted, before a busy browser cancels it.
    with settling(bench.domain, 40.0):
        page.press("Calibrate")
        page.wait_for("Step ", 30)
        page.press("Cancel calibration")
        wait_until(lambda: "cancel" in page.alerts(), 180, "the sentence of the node")
        assert "the mirror is back at mid range" in page.alerts()
        page.press("Dismiss: Calibration")
        wait_until(lambda: page.alerts() == "", 60, "the dismissal")


def test_a_calibration_shows_progress_and_residual_and_is_used(page: Browser, shots: Path) -> None:
    page.choose("Plan", "Pokes only")
    page.press("Calibrate")
    page.wait_for("Step ", 30)
    wait_until(lambda: page.find("Cancel calibration", "button").is_enabled(), 10, "the button")
    wait_until(lambda: page.pictures("residual of"), 60, "residuals of the run")
    page.shoot(shots / "console-calibrating.png")
    page.wait_for(": held-out residual ", 900)
    page.wait_for("Reachable ")
    assert page.alerts() == ""


def test_what_the_calibration_cannot_predict_is_no_warning(page: Browser, bench: RunningConsole) -> None:
    page.wait_for("Predicted residual", 60)
    assert "none of the surfaces p01 to p58" not in (bench.folder / "calibration.log").read_text()


def test_a_move_is_predicted_first_then_taken_and_measured(page: Browser, shots: Path) -> None:
    page.enter("Curvature, 1/m", "0.02004")
    page.wait_for("= +0.0401 dioptre")
    page.wait_for("Predicted residual")
    page.press("Move")
    page.wait_for("Move: +0.0200 1/m reached after", 60)
    page.press("Measure")
    page.wait_for("Measure: rms", 60)
    page.wait_for("The map is of the present shape.")
    for begin in ("measured surface", "predicted surface", "measured minus predicted", "Measured − predicted"):
        wait_until(functools.partial(page.pictures, begin), 60, begin)
    page.shoot(shots / "console-desktop.png")


def test_the_slider_follows_the_arrow_keys(page: Browser) -> None:
    field = page.find("Curvature, 1/m", "input")
    before = float(field.get_attribute("value"))
    page.driver.find_element(By.CSS_SELECTOR, '[role="slider"] [tabindex="0"]').send_keys(Keys.ARROW_RIGHT)
    wait_until(lambda: before < float(field.get_attribute("value")) <= before + 0.001, 60, "a larger curvature")


def test_an_unreachable_curvature_is_refused_in_a_sentence_that_stays(page: Browser, shots: Path) -> None:
    page.enter("Curvature, 1/m", "0.9")
    page.press("Move")
    wait_until(lambda: "curvature = +0.9000 1/m" in page.alerts(), 60, "the refusal")
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
    wait_until(lambda: page.alerts() == "", 60, "the dismissal")


def test_actuators_are_chosen_poked_and_released_by_keyboard(page: Browser) -> None:
    group = page.find("Actuators. Arrow keys choose, Enter pokes, Escape releases", "div")
    group.send_keys(Keys.ARROW_RIGHT)
    wait_until(lambda: page.chosen() != 1, 60, "another actuator")
    chosen = page.chosen()
    page.find("Actuators. Arrow keys choose, Enter pokes, Escape releases", "div").send_keys(Keys.ENTER)
    page.wait_for(f"Poke {chosen}: actuator {chosen} at ", 60)
    ActionChains(page.driver).send_keys(Keys.ESCAPE).perform()
    page.wait_for("Release: back at the shape before", 30)


def test_a_click_on_a_hexagon_chooses_it(page: Browser) -> None:
    def clicked() -> bool:
        with contextlib.suppress(StaleElementReferenceException, KeyError):
            page.hexagons()[12].click()
        return page.chosen() == 12

    wait_until(clicked, 60, "actuator 12")


def test_nodes_that_are_started_again_are_found_again(page: Browser, bench: RunningConsole) -> None:
    bench.suite.stop()
    page.wait_for("No node of the suite is heard.", 60)
    assert not page.find("Move", "button").is_enabled()
    bench.config["calibration"]["load_on_start"] = "newest"
    bench.suite = ForkedSuite(bench.config, bench.folder, bench.domain).__enter__()
    page.wait_for("driver: active", 90)
    page.wait_for(": approximate", 60)
    page.enter("Curvature, 1/m", "0.01")
    page.press("Move")
    page.wait_for("Move: +0.0100 1/m reached after", 60)
    page.press("Measure")
    page.wait_for("Measure: rms", 60)


def test_another_host_name_is_refused(bench: RunningConsole) -> None:
    request = urllib.request.Request(bench.address, headers={"Host": "mirror.example"})
    with pytest.raises(urllib.error.HTTPError) as refusal:
        urllib.request.urlopen(request, timeout=10)
    assert refusal.value.code == 400


def test_a_port_in_use_is_named(domain: int) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        command = [sys.executable, "-m", "dm_tools", "console", "--port", str(port)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert f"--port {port}" in done.stderr
