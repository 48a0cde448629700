"""The bench console with another mirror, with nodes that come later, and by the rules of accessibility."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from selenium.common.exceptions import StaleElementReferenceException
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from console_browser import DESKTOP, PHONE, Browser, needs_axe, needs_browser, served, shots_folder
from console_stand_in import StandIn
from dm_common.geometry import hexagonal_positions
from dm_common.ros.domains import own_domain
from support import Observer, wait_until

pytestmark = [pytest.mark.processes, needs_browser]

#: 19 actuators on a grid turned by 20 degrees.
X, Y = hexagonal_positions(19, pitch=3.5e-3, start_angle=np.radians(20.0))
#: Text with less contrast than WCAG 2.2 asks for: 4.5 to 1, 3 to 1 for large text; disabled controls are excepted.
#: Cards that are folded until somebody wants them.
DETAILS = ("Recipes", "Diagnostics", "Log")
LOW_CONTRAST = """
const parse = (text) => { const n = text.match(/[\\d.]+/g).map(Number); return n.length < 4 ? [...n, 1] : n; };
const over = (top, below) => [0, 1, 2].map((k) => top[3] * top[k] + (1 - top[3]) * below[k]);
const linear = (v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4;
const light = (c) => [0.2126, 0.7152, 0.0722].reduce((sum, share, k) => sum + share * linear(c[k] / 255), 0);
const poor = [];
let seen = 0;
const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
while (texts.nextNode()) {
  const element = texts.currentNode.parentElement, words = texts.currentNode.textContent.trim();
  if (!words || element.closest('svg, style, script, [disabled], .disabled, .q-field--disabled, [aria-hidden=true]'))
    continue;
  if (!element.checkVisibility({opacityProperty: true, visibilityProperty: true})) continue;
  const chain = [];
  for (let at = element; at; at = at.parentElement) chain.unshift(at);
  let back = [255, 255, 255], opacity = 1;
  for (const at of chain) {
    const style = getComputedStyle(at);
    back = over(parse(style.backgroundColor), back);
    opacity *= Number(style.opacity);
  }
  const style = getComputedStyle(element), colour = parse(style.color);
  const front = over([...colour.slice(0, 3), colour[3] * opacity], back);
  const [high, low] = [light(front), light(back)].sort((a, b) => b - a);
  const contrast = (high + 0.05) / (low + 0.05), size = parseFloat(style.fontSize);
  const large = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700);
  seen += 1;
  if (contrast < (large ? 3 : 4.5)) poor.push(`${words}: ${contrast.toFixed(2)}`);
}
return [seen, poor];
"""
#: Number of cells of the command map that are drawn before the outline of the chosen one.
OUTLINED = """
const cells = [...document.querySelectorAll('[aria-label^="command map"] svg path[stroke-linejoin=round]')];
return cells.findIndex((cell) => cell.getAttribute('stroke-width') === '4');
"""
#: Heights of controls of each kind, in folded cards and others; what of an unfolded card is wider than its card, or
#: touches what is above it.
LAID_OUT = """
const box = (at) => at.getBoundingClientRect();
const shown = (path) => [...document.querySelectorAll(path)].filter((at) => at.checkVisibility());
const height = (kind) => [...new Set(shown(`.card ${kind}`).map((at) => Math.round(box(at).height)))];
const beyond = shown('.unfolded *').filter((at) => box(at).right > box(at.closest('.card')).right);
const near = shown('.unfolded > * + *').filter((at) => box(at).top < box(at.previousElementSibling).bottom + 4);
return [Object.fromEntries(['.q-btn', '.q-toggle__inner'].map((kind) => [kind, height(kind)])),
  [...beyond, ...near].map((at) => at.outerHTML)];
"""
#: What has the focus: its name or words, and where it is.
FOCUSED = """
const at = document.activeElement, box = at.getBoundingClientRect();
return [at.tagName, at.getAttribute('aria-label') || at.innerText || '', box.width * box.height];
"""
CONTROLS = {"button", "textbox", "spinbutton", "combobox", "slider", "radio", "switch", "checkbox", "image", "img"}


@pytest.fixture(scope="module")
def console(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[int, str]]:
    """ROS domain and address of a console that is there before the nodes."""
    with own_domain() as domain, served(domain, tmp_path_factory.mktemp("other")) as address:
        yield domain, address


@pytest.fixture(scope="module")
def opened(console: tuple[int, str]) -> Iterator[Browser]:
    """Its page; the tests run in order and find what the ones before left."""
    browser = Browser(console[1], *PHONE)
    yield browser
    browser.driver.quit()


@pytest.fixture(scope="module")
def bench(console: tuple[int, str], opened: Browser) -> Iterator[tuple[Browser, StandIn]]:
    """That page, to which the nodes come."""
    opened.resize(*DESKTOP)
    opened.wait_for("No node of the suite is heard.")
    with Observer(console[0], "stand_in") as observer:
        yield opened, StandIn(observer.node, X, Y)


def named_nodes(browser: Browser) -> list[tuple[str, str]]:
    """(role, name) of every control and picture, as Chromium tells them to a screen reader."""
    browser.driver.execute_cdp_cmd("Accessibility.enable", {})
    nodes = browser.driver.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
    rows = [(n.get("role", {}).get("value", ""), n.get("name", {}).get("value", "")) for n in nodes if not n["ignored"]]
    return [(role, name) for role, name in rows if role in CONTROLS]


def test_without_nodes_the_page_says_what_is_missing(opened: Browser) -> None:
    opened.wait_for("No node of the suite is heard. Start them (./dm up)")
    assert "driver: not heard" in opened.text


def test_nodes_that_start_after_the_page_are_shown(bench: tuple[Browser, StandIn]) -> None:
    page = bench[0]
    page.wait_for("driver: active")
    page.wait_for("c19: calibrated")
    page.wait_for("Reachable -0.0500 to +0.0500 1/m")
    wait_until(lambda: "No node" not in page.alerts(), 60, "the nodes to be heard")


def test_nineteen_actuators_stand_where_the_driver_says(
    bench: tuple[Browser, StandIn], tmp_path_factory: pytest.TempPathFactory
) -> None:
    page = bench[0]
    (words,) = wait_until(lambda: page.pictures("command map of"), 60, "the map")
    assert words.startswith("command map of 19 actuators")

    def centres() -> Any:
        with contextlib.suppress(StaleElementReferenceException):
            boxes = {number: text.rect for number, text in page.hexagons().items()}
            return [[n, at["x"] + at["width"] / 2, at["y"] + at["height"] / 2] for n, at in boxes.items()]
        return []

    found = np.array(sorted(wait_until(lambda: len(centres()) == 19 and centres(), 60, "19 cells")))[:, 1:]
    # One scale and one origin take the places to the picture, y downwards.
    wanted = np.column_stack([X, -Y])
    scale = np.linalg.norm(found - found[0]) / np.linalg.norm(wanted - wanted[0])
    np.testing.assert_allclose(found - found[0], scale * (wanted - wanted[0]), atol=1.0)
    page.shoot(shots_folder(tmp_path_factory.mktemp("shots")) / "console-19.png")


def test_a_poke_moves_one_of_nineteen_and_is_released(bench: tuple[Browser, StandIn]) -> None:
    page, stand_in = bench
    page.find("Map after a poke", "*").click()
    page.enter("Number", "19")
    page.press("Poke")
    wait_until(lambda: stand_in.signals == [0.0] * 18 + [0.3], 60, "the poke")
    page.wait_for("Poke 19: actuator 19 at +0.300")
    page.press("Release (Esc)")
    wait_until(lambda: stand_in.signals == [0.0] * 19, 60, "the release")


def test_nothing_covers_the_outline_of_the_actuator_that_is_chosen_next(bench: tuple[Browser, StandIn]) -> None:
    page = bench[0]
    for number in ("5", "1"):
        page.enter("Number", number)
        page.wait_for(f"Actuator {number}, signal")
        wait_until(lambda: page.driver.execute_script(OUTLINED) == 18, 20, "it in front of the 18 others")


def test_a_decimal_comma_is_a_decimal_sign(bench: tuple[Browser, StandIn]) -> None:
    page = bench[0]
    page.wait_for("Predicted residual")
    before = page.find("Move", "button").rect
    page.enter("Curvature, 1/m", "0,02")
    page.wait_for("= +0.0400 dioptre")
    assert page.find("Move", "button").rect == before, "nothing moves while a prediction is made"
    page.enter("Curvature, 1/m", "0.0")


def test_the_slider_takes_the_mouse(bench: tuple[Browser, StandIn]) -> None:
    page = bench[0]
    page.wait_for("Reachable -0.0500 to +0.0500 1/m")
    slider, field = page.find("Curvature in 1 per metre", "div"), page.find("Curvature, 1/m", "input")

    def clicked() -> bool:  # again, where the page has moved meanwhile
        ActionChains(page.driver).move_to_element_with_offset(slider, slider.size["width"] // 4, 0).click().perform()
        return 0.02 < float(field.get_attribute("value")) < 0.03

    wait_until(clicked, 60, "the curvature where it was clicked")
    page.enter("Curvature, 1/m", "0.0")


def test_every_control_has_a_name(bench: tuple[Browser, StandIn]) -> None:
    for title in DETAILS:
        bench[0].unfold(title)
    rows = named_nodes(bench[0])
    assert {"button", "textbox", "slider", "radio", "switch", "combobox"} <= {role for role, _name in rows}
    assert [role for role, name in rows if not name.strip()] == []


def test_errors_are_announced_at_once_and_progress_when_there_is_time(bench: tuple[Browser, StandIn]) -> None:
    find = bench[0].driver.find_element
    assert find(By.CSS_SELECTOR, ".failures").get_attribute("aria-live") == "assertive"
    assert find(By.CSS_SELECTOR, ".failures").get_attribute("role") == "alert"
    assert {e.get_attribute("aria-live") for e in bench[0].driver.find_elements(By.CSS_SELECTOR, "[role=status]")} <= {
        "polite",
        None,
    }
    assert bench[0].driver.execute_script("return document.documentElement.lang").startswith("en")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_all_text_stands_out_from_its_ground(
    bench: tuple[Browser, StandIn], size: tuple[int, int], scheme: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    page = bench[0]
    page.resize(*size)
    page.prefer(scheme)
    for title in DETAILS:
        page.unfold(title)
    page.enter("Recipes", "1e9")
    page.wait_for("Predicted residual")
    move = page.find("Move", "button")
    wait_until(lambda: page.stands_still(move), 60, "button Move to stand still")  # what unfolds takes a moment
    before = move.rect
    page.press("Build recipes")
    wait_until(lambda: "recipes = 1e9: must be a whole number, 1 to 1000" in page.alerts(), 60, "a refusal")
    assert page.find("Move", "button").rect == before, "a message moves nothing"
    assert page.driver.execute_script("return document.querySelector('.header').getBoundingClientRect().height") <= 120
    seen, poor = page.driver.execute_script(LOW_CONTRAST)
    page.shoot(shots_folder(tmp_path_factory.mktemp("shots")) / f"console-{scheme}-{size[0]}.png")
    assert seen > 40
    assert poor == []
    ground = page.driver.execute_script("return getComputedStyle(document.body).backgroundColor")
    assert ("242" in ground) == (scheme == "light")
    page.dismiss_all()
    page.prefer("light")
    page.resize(*DESKTOP)


@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_what_was_folded_is_laid_out_as_other_cards_are(bench: tuple[Browser, StandIn], size: tuple[int, int]) -> None:
    page = bench[0]
    page.resize(*size)
    for title in DETAILS:
        summary = page.find(title, "details").find_element(By.TAG_NAME, "summary")
        assert summary.value_of_css_property("display") == "list-item", "a triangle says that there is more"
        page.unfold(title)
    heights, beyond = page.driver.execute_script(LAID_OUT)
    page.resize(*DESKTOP)
    assert {kind: len(found) for kind, found in heights.items()} == {".q-btn": 1, ".q-toggle__inner": 1}
    assert beyond == []


@needs_axe
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_axe_finds_nothing(bench: tuple[Browser, StandIn], size: tuple[int, int], scheme: str) -> None:
    page = bench[0]
    page.resize(*size)
    page.prefer(scheme)
    for title in DETAILS:
        page.unfold(title)
    found = page.violations()
    page.prefer("light")
    page.resize(*DESKTOP)
    assert "\n".join(found) == ""


def test_the_focus_goes_through_the_page_in_order_and_is_seen(bench: tuple[Browser, StandIn]) -> None:
    page = bench[0]
    for title in DETAILS:
        page.unfold(title)
    page.driver.execute_script("const top = document.querySelector('h1'); top.tabIndex = -1; top.focus()")
    names: list[str] = []
    for _press in range(80):
        ActionChains(page.driver).send_keys(Keys.TAB).perform()
        with contextlib.suppress(StaleElementReferenceException):
            tag, name, area = page.driver.execute_script(FOCUSED)
            if tag == "BODY":
                break
            assert area > 0 or tag == "INPUT", f"{name} has the focus and is not seen"
            names.append(" ".join(name.split()))
    order = ["Curvature, 1/m", "Move", "Degauss", "Plan", "Calibrate", "Build recipes", "Poke"]
    reached = [names.index(name) for name in order]
    assert reached == sorted(reached)
    assert len(names) > 25


def test_the_phone_page_needs_no_scrolling_sideways(bench: tuple[Browser, StandIn]) -> None:
    page = bench[0]
    page.resize(*PHONE)
    width, inner = page.driver.execute_script("return [document.documentElement.scrollWidth, innerWidth]")
    small = page.driver.execute_script(
        "return [...document.querySelectorAll('button')].filter((b) => b.checkVisibility() && "
        "b.getBoundingClientRect().height < 24).map((b) => b.innerText)"
    )
    page.resize(*DESKTOP)
    assert width <= inner == PHONE[0]
    assert small == []
