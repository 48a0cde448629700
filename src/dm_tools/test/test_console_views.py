"""What the bench console draws, from messages alone."""

from __future__ import annotations

import asyncio
import base64
import io
import json
import math
import re
import time
from collections.abc import Iterator
from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from dm_msgs.msg import (
    ActuatorEstimate,
    ActuatorState,
    Calibration,
    Capabilities,
    MirrorInfo,
    SurfaceMapInfo,
    ZernikeCoefficients,
)
from dm_msgs.srv import ListCalibrations, Measure, SetSignals
from matplotlib.image import imread
from nicegui import Client, background_tasks
from nicegui.page import page as nicegui_page
from sensor_msgs.msg import Image

import console_stand_in
from dm_common.geometry import hexagonal_positions
from dm_common.hysteresis.model import HysteresisModel
from dm_common.hysteresis.observer import HysteresisObserver
from dm_common.messages import applied_from, estimate_from, estimate_message
from dm_common.optics.zernike import basis
from dm_tools.console import console_node, operations, status, view_models
from dm_tools.console.charts.command_map import command_map, outlines
from dm_tools.console.charts.plots import INK, SAG_COLOURS, heat_map, loop_chart, residual_chart, zernike_chart
from dm_tools.console.console_node import ConsoleNode, Snapshot
from dm_tools.console.loops import effective_change, modelled_loop, modelled_way, way
from dm_tools.console.session import SHOWN_S, Session
from dm_tools.console.state_observer import EffectiveSignals, StateObserver
from dm_tools.console.style import CSS
from dm_tools.console.surface_view import SurfaceView
from dm_tools.console.surfaces import SHOWN, SurfaceModel, difference, measured_surface
from dm_tools.console.widgets.actuators import ActuatorCards
from dm_tools.console.widgets.calibration import CalibrationCard, RecipesCard
from dm_tools.console.widgets.components import DecimalField, WholeNumberField
from dm_tools.console.widgets.focus import FocusCard
from dm_tools.running_suite import NEEDED
from dm_tools.verify import map_of
from ros_fixtures import Observer
from waiting import wait_until

COUNT = 7
RADIUS = 11e-3
LAW = HysteresisModel(np.array([0.0, 0.1, 0.3]), np.array([[0.8], [0.1], [0.1]]), np.zeros(0), 0.0, 0.0, np.zeros(0))


def mirror_info() -> MirrorInfo:
    return console_stand_in.mirror_info(*hexagonal_positions(COUNT), RADIUS)


def state(applied: list[float], **fields: Any) -> ActuatorState:
    return ActuatorState(
        driver_state=ActuatorState.STATE_ACTIVE, applied=applied, requested=applied, flags=bytes(COUNT), **fields
    )


def calibration() -> tuple[Calibration, np.ndarray]:
    """A calibration whose surfaces are sums of the 21 terms, and its (21, N) influence."""
    message = console_stand_in.calibration(COUNT, RADIUS)
    return message, np.array(message.influence_zernike).reshape(21, COUNT)


def map_of_terms(coefficients: np.ndarray, pixels: int = 300) -> tuple[np.ndarray, SurfaceMapInfo]:
    """A map over the aperture with these coefficients, off the middle of the frame."""
    info = SurfaceMapInfo(
        width=pixels,
        height=pixels,
        centre_x=pixels / 2 + 3,
        centre_y=pixels / 2 - 2,
        aperture_radius_px=0.45 * pixels,
        aperture_radius=RADIUS,
    )
    x = (np.arange(pixels) - info.centre_x) / info.aperture_radius_px
    y = (info.centre_y - np.arange(pixels)) / info.aperture_radius_px
    grid_x, grid_y = np.meshgrid(x, y)
    return np.where(np.hypot(grid_x, grid_y) <= 1.0, basis(grid_x, grid_y) @ coefficients, np.nan), info


def test_cells_carry_signal_limit_and_grade() -> None:
    message, _ = calibration()
    message.actuator_grade = ["dead", *["good"] * (COUNT - 1)]
    shape = state([0.0, 1.0, -0.5, 0.0, 0.0, 0.0, 0.0])
    shape.flags = bytes([0, ActuatorState.FLAG_AT_LIMIT, ActuatorState.FLAG_REFUSED, 0, 0, 0, 0])
    first, second, third, *_ = view_models.cells(mirror_info(), shape, message)
    assert first.text == "actuator 1, signal +0.000, graded dead"
    assert (second.mark, second.remarks) == ("▲", ("at its upper limit",))
    assert third.mark == "!"
    assert second.fill != third.fill


def test_cells_without_a_command_have_no_signal() -> None:
    assert [cell.signal for cell in view_models.cells(mirror_info(), None, None)] == [None] * COUNT


def test_the_command_map_has_every_actuator_where_it_is() -> None:
    found = view_models.cells(mirror_info(), state([0.0] * COUNT), None)
    drawing = command_map(found, 3, 11.0, -0.25, 1.0)
    assert drawing.options["visualMap"]["text"] == ["+1", "signal -0.25"]
    cells, circle = drawing.options["series"]
    assert sorted(number for _x, _y, number in (item["value"] for item in cells["data"])) == list(range(1, COUNT + 1))
    embedded = re.search(r"cell = (\[.*\])\[params", cells[":renderItem"])
    assert embedded
    drawn = json.loads(embedded[1])
    assert [cell["label"] for cell in drawn if cell["z2"]] == ["3"], "nothing covers its outline"
    assert [cell["label"] for cell in drawn] == [str(item["value"][2]) for item in cells["data"]]
    for cell, item in zip(drawn, cells["data"], strict=True):
        assert np.mean(cell["corners"], axis=0) == pytest.approx(item["value"][:2], abs=2e-3)
    assert np.hypot(*np.array(circle["data"]).T) == pytest.approx(11.0, abs=2e-3)
    assert drawing.description == f"command map of {COUNT} actuators; no flags"


@pytest.mark.parametrize(("direction", "axis", "sign"), [(0.0, "x", 1), (np.pi, "x", -1), (np.pi / 2, "y", 1)])
def test_arrows_go_to_the_nearest_actuator_that_way(direction: float, axis: str, sign: int) -> None:
    found = view_models.cells(mirror_info(), None, None)
    target = found[view_models.towards(found, 1, direction) - 1]
    assert sign * getattr(target, axis) > 0
    assert np.hypot(target.x, target.y) == pytest.approx(4.3)


def test_measured_and_predicted_surface_agree_on_terms() -> None:
    message, influence = calibration()
    effective = np.linspace(-0.8, 0.9, COUNT)
    measured = measured_surface(*map_of_terms(influence @ effective))
    predicted = SurfaceModel(message).surface(effective)
    assert np.isfinite(measured.sag).sum() == np.isfinite(predicted.sag).sum()
    assert difference(measured, predicted).peak_to_valley < 0.02 * predicted.peak_to_valley
    assert SurfaceModel(message).coefficients(effective) == pytest.approx(influence @ effective)


def test_a_coarse_map_has_no_holes() -> None:
    surface = measured_surface(*map_of_terms(np.eye(21)[3] * 1e-7, pixels=60))
    inner = np.hypot(*np.meshgrid(np.linspace(-1, 1, 101), np.linspace(-1, 1, 101))) < 0.9
    assert np.isfinite(surface.sag[inner]).all()


def test_maps_of_another_aperture_are_not_compared() -> None:
    message, influence = calibration()
    sag, info = map_of_terms(influence[:, 0])
    info.aperture_radius = 10e-3
    with pytest.raises(ValueError, match=r"10\.00 mm, that of the calibration 11\.00 mm"):
        difference(measured_surface(sag, info), SurfaceModel(message).surface(np.zeros(COUNT)))


def test_an_image_of_another_kind_is_no_map() -> None:
    with pytest.raises(ValueError, match="encoding = 'mono8': a surface map is 32FC1"):
        map_of(Image(encoding="mono8", height=2, width=2, step=2, data=bytes(4)))


def test_a_calibration_that_does_not_fit_together_names_the_field() -> None:
    message, _ = calibration()
    message.influence_sag = message.influence_sag[:-1]
    with pytest.raises(ValueError, match="influence_sag"):
        SurfaceModel(message)


def test_bars_leave_out_tilt_and_hold_the_interval() -> None:
    measured = np.linspace(0.0, 20e-9, 21)
    message = ZernikeCoefficients(coefficients=measured.tolist(), sigma=np.full(21, 1e-9).tolist())
    found = view_models.bars(message, measured - 2e-9, True)
    assert len(found) == 18
    assert {round(bar.value_nm, 6) for bar in found} == {2.0}
    assert found[0].reach_nm == pytest.approx(1.96)
    assert view_models.bars(message, None, True) == []
    assert view_models.bars(message, measured, False)[0].predicted_nm == pytest.approx(3.0)


def test_what_is_missing_is_told_with_its_effect() -> None:
    assert "No node" in status.missing(frozenset(), False)[0]
    (line,) = status.missing(frozenset({"pdm_driver", "calibration", "focus_controller"}), True)
    assert line == "The node interferometer is not heard: no maps can be measured."


def test_a_button_tells_why_it_cannot_be_pressed() -> None:
    everything = dict.fromkeys(NEEDED, DiagnosticStatus())
    active = Snapshot(actuator_state=state([0.0] * COUNT), health=everything)
    assert status.reason_against("move", active, "") == ""
    assert status.reason_against("move", active, "Calibration") == "Calibration is under way."
    assert "not calibrated" in status.reason_against("focus", active, "")
    calibrated = Snapshot(
        actuator_state=active.actuator_state, capabilities=Capabilities(calibration_id="c1"), health=everything
    )
    assert status.reason_against("focus", calibrated, "") == ""
    lost = ActuatorState(driver_state=ActuatorState.STATE_LINK_LOST, message="no route to 10.0.0.7")
    assert status.reason_against("move", Snapshot(actuator_state=lost, health=everything), "") == (
        "The driver is link lost: no route to 10.0.0.7."
    )
    assert status.reason_against("measure", Snapshot(health={"pdm_driver": DiagnosticStatus()}), "") == (
        "The node interferometer is not heard."
    )


def test_badges_warn_of_an_unknown_history() -> None:
    message, _ = calibration()
    message.hysteresis.play_radius = [0.0, 0.1]
    snapshot = Snapshot(
        mirror_info=mirror_info(),
        actuator_state=state([0.0] * COUNT),
        calibration=message,
        health={"pdm_driver": DiagnosticStatus()},
    )
    assert ("history: not known", "doubt") in status.badges(snapshot, "moves were lost")
    assert ("history: known", "") in status.badges(snapshot, "")
    assert ("calibrated: c19", "") in status.badges(snapshot, "")  # a phone shows the beginning only


def test_the_worst_diagnostics_come_first() -> None:
    good = DiagnosticStatus(level=DiagnosticStatus.OK, name="a", message="fine")
    bad = DiagnosticStatus(level=DiagnosticStatus.ERROR, name="b", message="no link")
    rows = status.diagnostic_rows({"a": good, "b": bad})
    assert [row[:2] for row in rows] == [("error", "b"), ("ok", "a")]


def test_the_log_can_be_narrowed_to_what_went_wrong() -> None:
    lines = [("12:00:00", level, "n", "said") for level in ("INFO", "ERROR")]
    assert [row[1] for row in status.log_rows(lines, True)] == ["ERROR", "INFO"]
    assert [row[1] for row in status.log_rows(lines, False)] == ["ERROR"]


def test_messages_have_their_time_and_the_log_keeps_them(monkeypatch: pytest.MonkeyPatch) -> None:
    lines: list[tuple[object, ...]] = []
    ros: Any = SimpleNamespace(take_log=lambda *line: lines.append(line), snapshot=Snapshot)
    session = Session(ros)
    session.fail("Move", "too far")
    session.snapshot()
    assert [failure.sentence for failure in session.failures] == ["too far"]
    later = time.monotonic() + SHOWN_S + 1.0
    monkeypatch.setattr(time, "monotonic", lambda: later)
    session.snapshot()
    assert session.failures == []
    assert [line[1:] for line in lines] == [("ERROR", "console", "Move: too far")]


def test_the_page_says_where_the_mirror_stands() -> None:
    values = {"curvature": 0.05, "age": "40.0", "predicted": 0.0, "bound": 1.3e-9, "held": False, "conditioned": False}
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    heard = {"pdm_driver": DiagnosticStatus(), "focus_controller": DiagnosticStatus(values=pairs)}
    snapshot = Snapshot(actuator_state=ActuatorState(), health=heard)
    assert status.now_text(snapshot) == "now: +0.0500 1/m for 40 s, within 1.3 nm (95 %)"
    assert status.now_text(replace(snapshot, actuator_state=ActuatorState(moving=True))) == "now: moving"
    others = replace(snapshot, actuator_state=ActuatorState(holder="alignment script"))
    assert status.now_text(others).endswith("(95 %); alignment script holds the mirror")
    silent = replace(snapshot, health=dict.fromkeys(heard, DiagnosticStatus()))
    assert "not at a curvature" in status.now_text(silent)
    assert "not heard" in status.now_text(Snapshot())


@pytest.mark.parametrize(("namespace", "own"), [("left", "left/"), ("", "")])
def test_the_nodes_of_another_mirror_are_not_taken_for_those_of_this_one(
    observer: Observer, domain: int, namespace: str, own: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = ConsoleNode(namespace, domain)
    publisher = observer.node.create_publisher(DiagnosticArray, "/diagnostics", 10)
    names = ("left/focus_controller", "right/pdm_driver", "pdm_driver", "left/calibration", "interferometer")
    statuses = DiagnosticArray(status=[DiagnosticStatus(name=name, message=name) for name in names])
    robot = DiagnosticArray(status=[DiagnosticStatus(name="robot/arm")])  # whose time is another
    statuses.header.stamp.sec, robot.header.stamp.sec = 50, 10**9

    def heard() -> bool:
        publisher.publish(statuses)
        publisher.publish(robot)
        return len(node.snapshot().diagnostics) == len(names) + 1

    try:
        wait_until(heard, 30.0)
        health = node.snapshot().health
        assert node.snapshot().bench_time == 50.0
        monkeypatch.setattr(console_node, "SILENCE_S", -1.0)
        assert {each.level for each in node.snapshot().diagnostics.values()} == {DiagnosticStatus.STALE}
    finally:
        node.close()
    of_it = [name.removeprefix(own) for name in names if name.rpartition("/")[0] == namespace]
    assert {name: status.message for name, status in health.items()} == {name: own + name for name in of_it}


@pytest.mark.parametrize(
    ("text", "value"),
    [("0,02", 0.02), (" -0.02 ", -0.02), ("−1", -1.0), ("", None), ("1,2,3", None), ("nan", None), ("1_0", None)],
)
def test_numbers_are_taken_as_people_write_them(text: str, value: float | None) -> None:
    assert view_models.decimal(text) == value


def test_the_reachable_range_needs_a_calibration() -> None:
    range_known = Capabilities(calibration_id="c", curvature_min=-0.05, curvature_max=0.06)
    assert view_models.reachable(range_known) == (-0.05, 0.06)
    assert view_models.reachable(Capabilities(curvature_min=-0.05, curvature_max=0.06)) is None
    nowhere = Capabilities(calibration_id="c", curvature_min=float("nan"), curvature_max=float("nan"))
    assert view_models.reachable(nowhere) is None


def test_a_poke_turns_back_where_the_range_ends() -> None:
    assert view_models.poke_signals([0.0, 0.9], 1, 0.3, -1.0, 1.0) == [0.3, 0.9]
    assert view_models.poke_signals([0.0, 0.9], 2, 0.3, -1.0, 1.0) == pytest.approx([0.0, 0.6])
    with pytest.raises(ValueError, match="actuator = 3: must be 1 to 2"):
        view_models.poke_signals([0.0, 0.0], 3, 0.3, -1.0, 1.0)
    with pytest.raises(ValueError, match=r"amplitude = 30: from \+0\.000 both ways leave the range -1 to \+1"):
        view_models.poke_signals([0.0, 0.0], 2, 30.0, -1.0, 1.0)
    with pytest.raises(ValueError, match="amplitude = 0: must not be 0"):
        view_models.poke_signals([0.0, 0.0], 2, 0.0, -1.0, 1.0)


def test_the_loop_opens_as_the_law_says() -> None:
    loop = modelled_loop(LAW, 4, -1.0, 1.0)
    # Half-widths 0.1 and 0.3 with weight 0.1 each lag by their half-width on both branches.
    middle = len(loop.signals) // 2
    assert loop.falling[middle] - loop.rising[middle] == pytest.approx(2 * (0.1 * 0.1 + 0.1 * 0.3))
    assert "of the span apart" in loop.text
    assert "hysteresis loop of actuator 4" in loop_chart(loop).description


def test_the_loop_is_that_of_the_actuator_that_was_chosen() -> None:
    own = replace(LAW, play_weight=np.arange(1.0, COUNT + 1.0)[:, None, None] * LAW.play_weight)
    for actuator in (1, 4):
        shared = modelled_loop(LAW, actuator, -1.0, 1.0)
        assert modelled_loop(own, actuator, -1.0, 1.0).rising == pytest.approx(actuator * np.array(shared.rising))


def test_a_measured_way_comes_back_and_stays_inside() -> None:
    signals = way(0.8, 0.5, -1.0, 1.0)
    assert max(signals) == 1.0 and signals[-1] == pytest.approx(0.8)
    with pytest.raises(ValueError, match="amplitude = 2"):
        way(0.8, 2.0, -1.0, 1.0)
    values = modelled_way(LAW, LAW.demagnetised(COUNT, 0.0), 2, way(0.0, 1.0, -1.0, 1.0))
    assert values[0] < values[2]  # the same signal, rising and falling


def test_the_change_of_an_effective_signal_is_read_off_two_maps() -> None:
    message, _ = calibration()
    influence = np.array(message.influence_sag).reshape(-1, COUNT)
    x, y = np.array(message.sample_x), np.array(message.sample_y)
    before = SimpleNamespace(x=x, y=y, sag=np.zeros(len(influence)))
    after = SimpleNamespace(x=x, y=y, sag=0.37 * influence[:, 2] + 1e-6 + 3e-7 * x - 2e-7 * y)
    after.sag[5] = np.nan
    assert effective_change(before, after, message, 3) == pytest.approx(0.37)
    with pytest.raises(ValueError, match="299 points"):
        effective_change(before, SimpleNamespace(x=x[1:], y=y[1:], sag=x[1:]), message, 3)


def estimates(law: HysteresisModel, values: tuple[float, ...], calibration: Calibration) -> list[ActuatorEstimate]:
    """What the controller publishes of a mirror that takes one signal a second."""
    observer, found = HysteresisObserver(), []
    observer.use(law, 0.0)
    for second, value in enumerate(values, start=1):
        shape = state([value] * COUNT, turns=second, degausses=1, history_known=True)
        shape.header.stamp.sec = second
        observer.observe(applied_from(shape))
        message = estimate_message(observer)
        message.calibration_id, message.revision = calibration.id, calibration.revision
        found.append(message)
    return found


def test_an_estimate_survives_its_message() -> None:
    observer = HysteresisObserver()
    observer.use(LAW, 0.0)
    observer.observe(applied_from(state([0.5] * COUNT)))
    sent, found = observer.state, estimate_from(estimate_message(observer))
    assert sent is not None and found.state is not None and found.unknown == observer.unknown
    for item in fields(sent):
        assert np.array_equal(getattr(found.state, item.name), getattr(sent, item.name)), item.name
    assert estimate_from(ActuatorEstimate(message="no report")) == (None, "no report")
    for name in ("position", "fading", "crept", "crept_sigma"):
        torn = estimate_message(observer)
        getattr(torn, name).append(0.0)
        with pytest.raises(ValueError, match="reshape"):
            estimate_from(torn)


def test_a_console_that_comes_late_knows_what_stands() -> None:
    message, _ = calibration()
    earlier, later = estimates(HysteresisModel.linear(), (0.5, -0.5), message)
    observer = StateObserver()
    assert observer.now(9.0).effective is None and "has not said" in observer.now(9.0).doubt
    observer.take(earlier)
    assert "does not use this calibration" in observer.now(9.0).doubt
    observer.use(message)
    observer.take(later)
    assert observer.at(1.4).effective == pytest.approx([0.5] * COUNT)
    assert observer.now(9.0).effective == pytest.approx([-0.5] * COUNT)
    assert observer.at(0.5).effective is None and observer.at(0.5).doubt
    message.revision += 1  # published again with what a map has shown
    observer.use(message)
    assert observer.at(1.5).effective == pytest.approx([0.5] * COUNT)


def test_a_move_that_the_controller_does_not_follow_is_doubtful() -> None:
    message, _ = calibration()
    observer = StateObserver()
    observer.use(message)
    (estimate,) = estimates(HysteresisModel.linear(), (0.5,), message)
    estimate.history_known, estimate.message = True, ""
    observer.take(estimate)
    observer.observe(state([0.5] * COUNT))
    assert not observer.now(9.0).doubt
    observer.observe(state([0.4] * COUNT))
    assert "has not followed" in observer.now(9.0).doubt
    estimate.play = estimate.play[:-1]  # of no mirror at all
    observer.take(estimate)
    assert "actuator_estimate" in observer.now(9.0).doubt


@pytest.fixture
def page() -> Iterator[None]:
    """A page that no browser shows."""
    with Client(nicegui_page("")):
        yield


def session_of(observer: Any) -> tuple[Session, list[str]]:
    """A console without nodes, and the titles of what it was asked to do."""
    ros: Any = SimpleNamespace(observer=observer, external_action="", snapshot=bench, take_log=lambda *_line: None)
    session, begun = Session(ros), []
    session.begin = lambda title, *_others, **_more: begun.append(title)  # type: ignore[method-assign]
    return session, begun


def bench(message: Calibration | None = None) -> Snapshot:
    """An active bench, with this calibration."""
    everything = dict.fromkeys(NEEDED, DiagnosticStatus())
    able = Capabilities(calibration_id="c19")
    shape = state([0.0] * COUNT)
    return Snapshot(
        mirror_info=mirror_info(), actuator_state=shape, calibration=message, capabilities=able, health=everything
    )


@pytest.mark.usefixtures("page")
def test_a_poke_moves_the_actuator_in_the_field_of_its_page() -> None:
    session, begun = session_of(StateObserver())
    here, there = ActuatorCards(session), ActuatorCards(session)
    for cards in (here, there):
        cards.refresh(bench())
    here._number.set_value("5")
    there._poke()  # its field says 1 until it is refreshed
    here._start_loop()
    there.refresh(bench())
    assert there._number.value == "5"
    there._poke()
    assert begun == ["Poke 1", "Loop of actuator 5", "Poke 5"]
    here._number.set_value("9")
    here._poke()
    here._number.set_value("")
    here._start_loop()
    here._number.set_value("5")
    here._amplitude.set_value("far")
    here._poke()
    assert len(begun) == 3
    assert [failure.sentence for failure in session.failures] == [
        "number = 9: must be a whole number, 1 to 7",
        "number: must be a whole number, 1 to 7",
        "amplitude = far: must be a number",
    ]


@pytest.mark.usefixtures("page")
def test_the_loop_comes_back_with_its_law_and_its_doubt_follows() -> None:
    settled = EffectiveSignals(np.zeros(COUNT), "moves were lost")
    observer = SimpleNamespace(law=LAW, fault="", now=lambda _time: settled)
    cards = ActuatorCards(session_of(observer)[0])
    message, _ = calibration()
    cards.refresh(bench(message))
    assert cards._loop_text.text.endswith("is a guess: moves were lost.") and cards._loop_picture._shown is not None
    settled = settled._replace(doubt="")
    cards.refresh(bench(message))
    assert cards._loop_text.text.endswith("marks its present state.")
    observer.law = HysteresisModel.linear()
    cards.refresh(bench(message))
    assert cards._loop_picture._shown is None
    observer.law = LAW
    cards.refresh(bench(message))
    assert cards._loop_picture._shown is not None


@pytest.mark.usefixtures("page")
def test_a_prediction_goes_with_its_inputs() -> None:
    session, _ = session_of(StateObserver())
    focus = FocusCard(session)
    focus._predicting = True  # nothing is asked of nodes
    focus._inputs = focus._predicted = (0.0, 0.0, focus._mode.value)
    focus._prediction.show("Predicted residual 5.0 nm rms")
    focus.refresh(bench())
    assert focus._prediction.text
    for text in ("up", "down"):
        focus._number.set_value(text)
        focus.refresh(bench())
        assert not focus._prediction.text
        focus._predicted = focus._inputs[:3]
        focus._prediction.show(f"curvature = {text}: must be a number")
    focus._number.set_number(-0.04)
    focus.refresh(replace(bench(), health={}))
    assert focus._prediction.text == "No prediction. The node pdm_driver is not heard."


@pytest.mark.usefixtures("page")
def test_without_a_calibration_there_is_no_prediction_but_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    session, _ = session_of(StateObserver())
    focus = FocusCard(session)
    focus._number.set_number(0.03)
    focus._predicting = True  # nothing is asked of nodes
    focus.refresh(bench())
    focus._prediction.show("Predicted residual 5.0 nm rms")  # of a request that was answered late
    focus.refresh(replace(bench(), capabilities=Capabilities()))
    assert focus._prediction.text == ("No prediction. The mirror is not calibrated: run a calibration or load one.")
    focus.refresh(bench())
    assert focus._prediction.text == ""
    focus._predicting, asked = False, []
    monkeypatch.setattr(background_tasks, "create", lambda request: asked.append(request.close()))
    focus.refresh(bench())
    assert len(asked) == 1, "it is asked for again"


@pytest.mark.usefixtures("page")
def test_the_slider_goes_where_the_field_says_once_the_range_is_known() -> None:
    focus = FocusCard(session_of(StateObserver())[0])
    focus._predicting = True  # nothing is asked of nodes
    focus._number.set_number(0.03)
    able = Capabilities(calibration_id="c19", curvature_min=-0.05, curvature_max=0.05)
    focus.refresh(replace(bench(), capabilities=able))
    assert focus._slider.value == 0.03


def test_nothing_is_subtracted_from_a_map_of_another_aperture() -> None:
    message, influence = calibration()
    settled = EffectiveSignals(np.zeros(COUNT), "")
    observer: Any = SimpleNamespace(creep_unseen=False, at=lambda _time: settled, now=lambda _time: settled)
    sag, info = map_of_terms(influence[:, 0])
    image = Image(encoding="32FC1", height=300, width=300, step=1200, data=sag.astype(np.float32).tobytes())
    view = SurfaceView(observer)
    view.update(replace(bench(message), surface_map=image, surface_map_info=info))
    assert view.predicted_zernike is not None
    info.aperture_radius = 10e-3
    view = SurfaceView(observer)
    view.update(replace(bench(message), surface_map=image, surface_map_info=info))
    assert "Not comparable" in str(view.difference) and view.predicted_zernike is None


def test_charts_are_described_and_have_axes() -> None:
    surface = measured_surface(*map_of_terms(np.eye(21)[3] * 4e-7))
    drawing = heat_map(surface, surface.extent, SAG_COLOURS, "measured surface")
    said = re.search(r"peak to valley (\d+) nm", drawing.description)
    assert said and float(said[1]) == pytest.approx(800.0 * SHOWN**2, rel=0.01)
    axes = [*drawing.options["xAxis"], *drawing.options["yAxis"]]
    assert [axis["name"] for axis in axes if "name" in axis] == ["x, mm", "y, mm", "sag, nm"]
    message = ZernikeCoefficients(coefficients=(np.arange(21) * 1e-9).tolist(), sigma=[])
    zernike = zernike_chart(view_models.bars(message, None, False), "Coefficient")
    assert "largest pentafoil sin Z5,5: 20.00 nm" in zernike.description
    assert "residual of 2 maps, the last 3.0 nm" in residual_chart([2.0, 3.0]).description


def test_what_charts_draw_in_ink_is_light_in_the_dark() -> None:
    dark = CSS[CSS.index("prefers-color-scheme: dark") :]
    assert f'.chart svg [fill="{INK}"]' in dark and f'.chart svg [stroke="{INK}"]' in dark  # marks as well as text


def test_a_heat_map_is_a_picture_of_the_surface_the_right_way_up() -> None:
    surface = measured_surface(*map_of_terms(np.eye(21)[2] * 4e-7 + np.eye(21)[4] * 4e-7))
    options = heat_map(surface, surface.extent, "gray", "measured surface").options
    (image,) = options["series"]
    assert image["data"] == [pytest.approx([-11.0, 11.0, 11.0, -11.0])]
    grey, opaque = pixels(image)[..., 0] / 255.0, pixels(image)[..., 3] > 0
    np.testing.assert_array_equal(opaque, np.isfinite(surface.sag))  # row 0 is the top
    np.testing.assert_allclose(2.0 * grey[opaque] - 1.0, surface.sag[opaque] / surface.extent, atol=0.02)
    stops = options["grid"][1]["backgroundColor"]["colorStops"]
    assert (stops[0]["color"], stops[-1]["color"]) == ("#ffffff", "#000000")


def pixels(series: dict[str, Any]) -> np.ndarray:
    """RGBA of the picture that a series draws."""
    found = re.search(r"base64,([^']+)'", series[":renderItem"])
    assert found
    return (imread(io.BytesIO(base64.b64decode(found[1]))) * 255).round().astype(int)


def areas(cells: list[np.ndarray]) -> np.ndarray:
    """Areas of polygons, by the shoelace formula."""
    after = [np.roll(cell, -1, axis=0) for cell in cells]
    return np.array([abs(np.sum(c[:, 0] * a[:, 1] - c[:, 1] * a[:, 0])) / 2 for c, a in zip(cells, after, strict=True)])


@pytest.mark.parametrize("turned", [0.0, 0.3, np.pi / 6])
def test_cells_of_a_hexagonal_grid_fill_it_however_it_is_turned(turned: float) -> None:
    x, y = hexagonal_positions(19, pitch=4.0, start_angle=turned)
    cells = [corners for corners, _size in outlines(tuple(zip(x.tolist(), y.tolist(), strict=True)))]
    assert [len(cell) for cell in cells] == [6] * 19
    assert areas(cells) == pytest.approx(np.sqrt(3) / 2 * 4.0**2)


def test_cells_of_scattered_actuators_do_not_cover_each_other() -> None:
    places = np.random.default_rng(3).uniform(-10.0, 10.0, size=(40, 2))
    cells = outlines(tuple(map(tuple, places.tolist())))
    for number, (cell, size) in enumerate(cells):
        assert size > 0.0
        middle = cell.mean(axis=0)
        inside = middle + 0.99 * (cell - middle)
        distance = np.hypot(*(inside[:, None, :] - places).transpose(2, 0, 1))
        assert (distance.argmin(axis=1) == number).all()


def test_a_lone_actuator_has_a_cell() -> None:
    ((corners, _size),) = outlines(((1.0, 2.0),))
    assert len(corners) == 6


@pytest.mark.parametrize("grey", range(0, 256, 15))
def test_the_ink_stands_out_from_every_colour(grey: int) -> None:
    colour = f"#{grey:02x}{255 - grey:02x}{grey:02x}"
    light, ink = view_models.luminance(colour), view_models.luminance(view_models.ink_on(colour))
    assert (max(light, ink) + 0.05) / (min(light, ink) + 0.05) >= 4.5


def test_paths_are_shortened_and_topics_are_not() -> None:
    words = "map /home/lab/bench/maps/m_1.dat on /mirror_a/surface_map, see (/tmp/x/y.log)"
    assert status.shortened(words) == "map …/m_1.dat on /mirror_a/surface_map, see (…/y.log)"


def test_recipes_are_spread_evenly() -> None:
    assert view_models.evenly(-0.02, 0.02, 5) == [-0.02, -0.01, 0.0, 0.01, 0.02]
    assert view_models.evenly(0.01, 0.05, 1) == [0.01]


def test_recipes_that_would_all_be_the_same_are_refused() -> None:
    with pytest.raises(ValueError, match=r"first = last = 0\.02 1/m: must differ"):
        view_models.evenly(0.02, 0.02, 3)


@pytest.mark.parametrize("text", ["2.5", "0", "-3", "1001", "1e9", "many", "nan", "inf"])
@pytest.mark.usefixtures("page")
def test_a_whole_number_out_of_its_range_stays_as_typed_and_is_refused(text: str) -> None:
    field = WholeNumberField("Recipes", 11, range(1, 1001))
    field.set_value(text)
    with pytest.raises(ValueError, match=rf"^recipes = {re.escape(text)}: must be a whole number, 1 to 1000$"):
        field.valid_number  # noqa: B018
    assert (field.value, field.error) == (text, "whole, 1 to 1000")


@pytest.mark.usefixtures("page")
def test_a_field_that_holds_no_number_is_named() -> None:
    curvature = DecimalField("Curvature, 1/m", 0.0)
    for text, words in (("", "curvature: must be a number"), ("up", "curvature = up: must be a number")):
        curvature.set_value(text)
        with pytest.raises(ValueError, match=f"^{words}$"):
            curvature.valid_number  # noqa: B018
    length = WholeNumberField("Length: commands of the plan", None, range(60, 2001))
    length.set_value("300")
    assert (length.valid_number, length.error) == (300, None)
    length.set_value(" ")
    assert length.error is None, "as configured"


@pytest.mark.usefixtures("page")
def test_arrow_keys_count_inside_the_range() -> None:
    field = WholeNumberField("Number", 1, range(1, 3))
    for step, value in ((1, "2"), (1, "2"), (-1, "1"), (-1, "1")):
        field._count(step)
        assert field.value == value


@pytest.mark.parametrize(
    ("remarks", "offered"),
    [(["damaged", "", ""], "c2"), (["", "in use", ""], None), (["of another mirror", "damaged", "damaged"], None)],
)
@pytest.mark.usefixtures("page")
def test_while_no_calibration_is_in_use_the_newest_that_can_be_is_offered(
    remarks: list[str], offered: str | None
) -> None:
    async def call(_name: str, _request: Any) -> ListCalibrations.Response:
        return ListCalibrations.Response(ids=["c3", "c2", "c1"], held_out_rms=[1e-9, 1e-9, 1e-9], remarks=remarks)

    session, _ = session_of(StateObserver())
    session.ros.call = call  # type: ignore[assignment]
    stored = CalibrationCard(session)
    asyncio.run(stored._list())
    assert stored._choice.value == offered


@pytest.mark.parametrize(("field", "text"), [("_number", "1e9"), ("_conic", ""), ("_first", "x")])
@pytest.mark.usefixtures("page")
def test_no_recipes_are_built_from_a_wrong_field(field: str, text: str) -> None:
    recipes = RecipesCard(session_of(StateObserver())[0])
    assert len(recipes._goal().curvatures) == 11
    getattr(recipes, field).set_value(text)
    with pytest.raises(ValueError, match="must be a"):
        recipes._goal()


def test_a_map_is_waited_for_as_long_as_the_interferometer_is_told_to_take() -> None:
    waits: list[float] = []

    async def call(_name: str, request: Measure.Request, timeout_s: float) -> Measure.Response:
        waits.append(timeout_s)
        assert request.timeout == 0.0, "as configured"
        return Measure.Response(zernike=ZernikeCoefficients(coefficients=[0.0] * 21))

    text = asyncio.run(operations.measure(SimpleNamespace(ros=SimpleNamespace(call=call))))  # type: ignore[arg-type]
    assert waits == [math.inf] and "rms beyond tilt 0.0 nm" in text


def test_signals_are_waited_for_as_long_as_the_way_takes_and_sent_again_to_a_driver_that_lost_them() -> None:
    asked: list[tuple[str, float, bool]] = []

    async def call(name: str, request: SetSignals.Request, timeout_s: float, again: bool) -> None:
        asked.append((name, timeout_s, again))
        assert request.wait and list(request.signals) == [0.5]

    snapshot = SimpleNamespace(mirror_info=MirrorInfo(), actuator_state=ActuatorState(requested=[0.1]))
    ros: Any = SimpleNamespace(call=call, snapshot=lambda: snapshot)
    session = Session(ros, poke=([0.5], [0.1]))
    assert session.base == [0.5]
    assert asyncio.run(operations.release(session)) == "back at the shape before"
    assert asked == [("set_signals", math.inf, True)] and session.base is None


def test_a_poke_has_settled_when_its_map_is_taken() -> None:
    asked: list[tuple[str, float]] = []

    async def call(name: str, _request: Any, _timeout_s: float, again: bool = False) -> Measure.Response:
        assert again == (name == "set_signals")
        asked.append((name, time.monotonic()))
        return Measure.Response(zernike=ZernikeCoefficients(coefficients=[0.0] * 21))

    session: Any = SimpleNamespace(ros=SimpleNamespace(call=call), base=None, snapshot=bench)
    assert "Map: rms" in asyncio.run(operations.poke(session, 1, 0.1, then_measure=True))
    (first, moved), (second, taken) = asked
    assert (first, second) == ("set_signals", "measure") and taken - moved >= operations.SETTLE_S


def test_nothing_is_poked_once_the_mirror_was_moved() -> None:
    """By whatever moved it, such as a calibration."""
    snapshot = SimpleNamespace(mirror_info=MirrorInfo(), actuator_state=ActuatorState(requested=[0.1]))
    ros: Any = SimpleNamespace(snapshot=lambda: snapshot)
    session = Session(ros, poke=([0.5], [0.1]))
    assert session.base == [0.5]
    snapshot.actuator_state = ActuatorState(requested=[0.0])
    assert session.base is None and asyncio.run(operations.release(session)) == "nothing is poked"
