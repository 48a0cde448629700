"""The bench console's operations in a real browser, on the virtual bench with its memory identified."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path

import pytest
from dm_msgs.action import Calibrate

from console_browser import DESKTOP, PHONE, Browser, needs_browser, served, shots_folder
from dm_common.ros.domains import own_domain
from dm_tools.demo.demo_bench import bench_config
from studies.quick_trigger import quick_trigger
from support import CommonLawsSuite, Observer, wait_until

pytestmark = [pytest.mark.processes, needs_browser]

#: What of state and progress is not wholly seen; the row of badges begins with what is wrong, and its end may be.
CLIPPED = """
const header = document.querySelector('.header').getBoundingClientRect();
const inside = (at, row) => at.top >= Math.max(header.top, row.top) && at.left >= row.left &&
  at.bottom <= Math.min(header.bottom, row.bottom) && at.right <= row.right;
const badges = [...document.querySelectorAll('.header .badge')].sort((a, b) => a.offsetLeft - b.offsetLeft);
const rest = document.querySelectorAll('.header .now, .header .work .text, .header .work button');
return [badges[0], ...rest].filter((at) => at.checkVisibility() && !inside(
  at.getBoundingClientRect(), at.parentElement.closest('.line').getBoundingClientRect())).map((at) => at.innerText);
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the bench: logs, maps, calibrations."""
    return tmp_path_factory.mktemp("operations")


@pytest.fixture(scope="module")
def bench(folder: Path) -> Iterator[tuple[int, str]]:
    """ROS domain and address of the console of a bench of its own."""
    config = bench_config(folder, "prandtl_ishlinskii", 0.01, 5, 20.0)
    config["virtual_bench"] |= {"interferometer.pixels": 236, "clock.period": 0.05}
    config["interferometer"]["trigger_command"] = quick_trigger(config["virtual_bench"]["trigger.port"])
    with own_domain() as domain, CommonLawsSuite(config, folder, domain) as suite, served(domain, folder) as address:
        yield domain, address
        suite.check()


@pytest.fixture(scope="module")
def page(bench: tuple[int, str]) -> Iterator[Browser]:
    """Its page; the tests run in order and find what the ones before left."""
    browser = Browser(bench[1], *DESKTOP)
    yield browser
    browser.driver.quit()


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return shots_folder(tmp_path_factory.mktemp("shots"))


def test_the_length_of_a_hysteresis_plan_is_told_before_it_runs(page: Browser) -> None:
    page.wait_for("driver: active")
    page.enter("Length: commands of the plan", "80")
    page.press("How long?")
    page.wait_for("nothing was moved", 30)


def test_a_hysteresis_calibration_shows_the_loops(page: Browser) -> None:
    page.press("Calibrate")
    wait_until(lambda: page.pictures("residual of"), 60, "residuals of the run")
    page.wait_for(": held-out residual ", 900)
    page.wait_for("history: known")
    wait_until(lambda: page.pictures("hysteresis loop of actuator 1"), 60, "the loop")
    assert page.alerts() == ""


def test_the_report_of_a_calibration_lies_beside_it(page: Browser, folder: Path) -> None:
    (stored,) = (folder / "calibrations").glob("*.h5")
    for suffix in (".html", ".pdf"):
        wait_until(stored.with_suffix(suffix).is_file, 300, f"{suffix} beside the calibration")


def test_a_direct_move_stands(page: Browser) -> None:
    page.picked("Direct").click()
    page.enter("Curvature, 1/m", "0.015")
    page.press("Move")
    page.wait_for("Move: +0.0150 1/m reached after", 60)
    assert "Mode: direct." in page.text


def test_without_a_recipe_a_conditioned_move_is_refused(page: Browser) -> None:
    page.picked("Conditioned").click()
    page.wait_for("this calibration holds no recipes")
    page.press("Move")
    wait_until(lambda: "holds no recipes" in page.alerts(), 60, "the refusal")
    page.press("Dismiss: Move")
    wait_until(lambda: page.alerts() == "", 60, "the dismissal")


def test_recipes_are_built_and_a_conditioned_move_uses_them(page: Browser, shots: Path) -> None:
    page.unfold("Recipes")
    page.enter("First, 1/m", "0,015")  # as half of Europe writes it
    page.enter("Recipes", "1")
    page.enter("Added terms, nm", "coma=1")
    page.press("Build recipes")
    wait_until(lambda: "must be like 'coma sin=-50'" in page.alerts(), 60, "the refusal")
    page.press("Dismiss: Recipes")
    page.enter("Added terms, nm", "coma sin=1")
    page.press("Build recipes")
    page.wait_for("1 of 1 recipes stored", 900)
    page.wait_for("+0.0150")
    page.wait_for("coma sin +1 nm")
    page.press("Move")
    page.wait_for("Mode: conditioned.", 120)
    page.wait_for("Move: +0.0150 1/m reached after", 120)
    page.press("Measure")
    page.wait_for("Measure: rms", 60)
    page.shoot(shots / "console.png")


def test_the_surface_converges_on_the_interferometer(page: Browser) -> None:
    page.press("Converge")
    wait_until(lambda: page.text.startswith("Deformable") and "Converge: " in page.text, 120, "its outcome")
    page.press("Measure")
    page.wait_for("Measure: rms", 60)
    page.dismiss_all()


def test_the_surface_is_flattened(page: Browser) -> None:
    page.press("Flatten")
    page.wait_for("Flatten: Predicted residual", 60)


def test_a_degauss_leaves_the_mirror_at_mid_range(page: Browser) -> None:
    page.press("Degauss")
    page.wait_for("the mirror is at mid range", 120)


def test_the_loop_of_an_actuator_is_measured(page: Browser, shots: Path) -> None:
    page.enter("Number", "8")
    page.press("Measure its loop")
    page.wait_for("actuator 8: model and maps differ by at most", 180)
    wait_until(functools.partial(page.pictures, "hysteresis loop of actuator 8"), 60, "the loop")
    page.press("Measure")
    page.wait_for("Measure: rms", 60)
    page.resize(*PHONE)
    page.shoot(shots / "console-hysteresis-phone.png")
    page.resize(*DESKTOP)


def test_two_pages_show_the_same_and_either_dismisses(page: Browser, bench: tuple[int, str]) -> None:
    other = Browser(bench[1], *PHONE)
    try:
        page.enter("Curvature, 1/m", "0.9")
        page.press("Move")
        for browser in (page, other):
            wait_until(browser.alerts, 60, "the refusal on both pages")
        other.press("Dismiss: Move")
        wait_until(lambda: page.alerts() == "", 60, "the dismissal on both pages")
        assert other.chosen() == page.chosen() == 8
    finally:
        other.driver.quit()


def test_a_calibration_started_elsewhere_is_shown_and_can_be_cancelled(page: Browser, bench: tuple[int, str]) -> None:
    with Observer(bench[0]) as observer:
        # Two seconds a map: it still runs when a slow browser comes to cancel it, and leaves the browser time to.
        goal = Calibrate.Goal(plan=Calibrate.Goal.PLAN_POKES, settle_time=40.0)
        _, result = observer.send_goal(Calibrate, "calibrate", goal)
        page.wait_for("A calibration that was started elsewhere", 30)
        page.wait_for("Step ", 30)
        wait_until(lambda: "maps" in " ".join(page.pictures("residual of ")), 60, "its residuals")
        assert not page.find("Move", "button").is_enabled()
        page.resize(*PHONE)
        page.wait_for("calibration holds the mirror", 30)
        page.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", page.find("Poke", "button"))
        assert page.driver.execute_script(
            "const header = document.querySelector('.header'); return header.scrollHeight <= header.clientHeight"
        ), "the header holds what it shows"
        assert page.driver.execute_script(CLIPPED) == [], "state and progress are in sight"
        page.resize(*DESKTOP)
        page.press("Cancel calibration")
        wait_until(result.done, 60, "its end")
        assert "cancel" in result.result().result.message
        wait_until(lambda: "started elsewhere" not in page.text, 60, "its end on the page")
