"""What is made of a driver's reports, and of their absence."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from dm_msgs.msg import ActuatorState, FocusRequest

from dm_common.errors import ErrorCode, Refusal
from dm_common.messages import doubles, time_message
from dm_controller.driver_monitor import CONFIRM_S, DriverMonitor
from dm_controller.focus_types import Moment, Order
from dm_controller.planning.planner import Move
from dm_controller.planning.target import FocusTarget

TIMEOUT = 2.0
HERE, THERE = np.full(37, 0.1), np.full(37, 0.2)
#: Steady time of the last report and the command after it, s.
BEGAN = 100.0


def report(requested: np.ndarray = HERE, sequence: int = 1, **fields: Any) -> ActuatorState:
    fields.setdefault("driver_state", ActuatorState.STATE_ACTIVE)
    stamp = time_message(fields.pop("stamp_ns", 0))
    made = ActuatorState(requested=doubles(requested), applied=doubles(requested), sequence=sequence, **fields)
    made.header.stamp = stamp
    return made


def command(driver: DriverMonitor, signals: np.ndarray) -> None:
    """A command goes out, one second after the epoch."""
    none: Any = None  # no prediction
    move, now = Move(FocusTarget(0.01), signals, signals, 0.0, True, 0.0, none), Moment(10**9, 1.0, BEGAN)
    driver.order = Order(FocusRequest(curvature=0.01), now, move=move)
    driver.order.send(signals, now)


def monitor(timeout: float = TIMEOUT) -> DriverMonitor:
    made = DriverMonitor({"driver_timeout": timeout})
    made.observe(report(), BEGAN)
    command(made, THERE)
    return made


def test_a_driver_that_never_reported_is_unavailable() -> None:
    with pytest.raises(Refusal, match="is the driver running"):
        DriverMonitor({"driver_timeout": TIMEOUT}).check(FocusRequest(), BEGAN)


@pytest.mark.parametrize(("timeout", "refused"), [(TIMEOUT, True), (0.0, False)])
def test_reports_grow_old(timeout: float, refused: bool) -> None:
    driver = monitor(timeout)
    driver.check(FocusRequest(), BEGAN + TIMEOUT)
    later = BEGAN + TIMEOUT + 0.1
    assert bool(driver.silent(later)) == bool(driver.stopped(later)) == refused
    if refused:
        with pytest.raises(Refusal, match=r"has not reported for 2.1 s \(driver_timeout 2 s\)") as caught:
            driver.check(FocusRequest(), later)
        assert caught.value.error_code == ErrorCode.DRIVER_UNAVAILABLE
    else:
        driver.check(FocusRequest(), later)


def test_a_command_that_is_confirmed_is_not_told_of() -> None:
    driver = monitor()
    driver.observe(report(THERE), BEGAN + 0.5)
    assert driver.unconfirmed(BEGAN + 10.5) is None


@pytest.mark.parametrize(
    ("last", "code", "text"),
    [
        (report(stamp_ns=2 * 10**9), ErrorCode.PREEMPTED, "follows another command"),
        (report(stamp_ns=10**9 - 1), ErrorCode.TIMEOUT, "holds the earlier shape"),
        (report(error_code=ErrorCode.STALE, message="too old"), ErrorCode.STALE, "too old"),
        (report(driver_state=ActuatorState.STATE_INACTIVE), ErrorCode.DRIVER_INACTIVE, "not active"),
        (report(driver_state=ActuatorState.STATE_LINK_LOST), ErrorCode.ELECTRONICS_UNREACHABLE, "lost the link"),
        (None, ErrorCode.DRIVER_UNAVAILABLE, "has not reported"),
    ],
)
def test_a_command_that_is_not_confirmed_is_told_of_once(last: ActuatorState | None, code: int, text: str) -> None:
    driver = monitor()
    assert driver.unconfirmed(BEGAN) is None
    later = BEGAN + TIMEOUT + 0.1
    if last is not None:
        driver.observe(last, later)
    refusal = driver.unconfirmed(later)
    assert refusal is not None
    assert refusal.error_code == code
    assert text in str(refusal)
    assert driver.unconfirmed(later) is None


def test_a_command_that_is_not_confirmed_is_told_of_where_silence_counts_for_nothing() -> None:
    driver = monitor(timeout=0.0)
    assert driver.unconfirmed(BEGAN + 0.9 * CONFIRM_S) is None
    unconfirmed = driver.unconfirmed(BEGAN + 1.1 * CONFIRM_S)
    assert unconfirmed is not None and "no command has reached it" in str(unconfirmed)
    driver = monitor(timeout=0.0)
    assert driver.order is not None and driver.order.command is not None
    driver.order.command.sent = Moment(10**9, 1.0, BEGAN + 1.0)  # no report has come since
    unconfirmed = driver.unconfirmed(BEGAN + 1.0 + 1.1 * CONFIRM_S)
    assert unconfirmed is not None and unconfirmed.error_code == ErrorCode.TIMEOUT


@pytest.mark.parametrize("later", [{"sequence": 2}, {"sequence": 9, "turns": 2}, {"sequence": 9, "degausses": 0}])
def test_a_driver_that_was_started_anew_is_noticed(later: dict[str, Any]) -> None:
    """Also if it is heard only once it has written more often than the one before."""
    driver = monitor()
    counts: dict[str, Any] = {"sequence": 7, "turns": 3, "degausses": 1}
    driver.observe(report(**counts), BEGAN)
    assert driver.starts == 0
    driver.observe(report(**(counts | later)), BEGAN)
    assert driver.starts == 1


@pytest.mark.parametrize(
    ("state", "stamp_ns", "lost"),
    [
        (ActuatorState.STATE_UNCONFIGURED, 0, True),
        (ActuatorState.STATE_ACTIVE, 2 * 10**9, True),
        (ActuatorState.STATE_ACTIVE, 10**9 - 1, False),  # it was active before the command, which may be on its way
    ],
)
def test_a_command_that_a_driver_started_anew_cannot_know_is_lost_at_once(
    state: int, stamp_ns: int, lost: bool
) -> None:
    driver = monitor()
    driver.observe(report(sequence=7), BEGAN)
    driver.observe(report(sequence=1, driver_state=state, stamp_ns=stamp_ns), BEGAN + 0.1)
    unconfirmed = driver.unconfirmed(BEGAN + 0.1)
    assert (unconfirmed is not None) == lost
    if unconfirmed is not None:
        assert unconfirmed.error_code == ErrorCode.DRIVER_UNAVAILABLE and "was restarted" in str(unconfirmed)


@pytest.mark.parametrize(
    ("sequence", "code", "text"),
    [(8, ErrorCode.PREEMPTED, "another command took over"), (1, ErrorCode.DRIVER_UNAVAILABLE, "was restarted")],
)
def test_a_shape_that_a_restarted_driver_has_left_was_not_taken_over(sequence: int, code: int, text: str) -> None:
    driver = monitor()
    driver.observe(report(THERE, sequence=7), BEGAN + 0.1)
    assert driver.order is not None and driver.progress(driver.order, BEGAN + 0.1).reached
    driver.observe(report(np.zeros(37), sequence=sequence, stamp_ns=2 * 10**9), BEGAN + 0.5)
    failed = driver.progress(driver.order, BEGAN + 0.5).failed
    assert failed is not None and failed.error_code == code and text in str(failed)


def test_the_latency_is_from_the_command_to_its_first_write() -> None:
    driver = monitor()
    assert driver.latency == 0.0
    assert driver.observe(report(THERE, stamp_ns=10**9 + 2_000_000), BEGAN)
    assert driver.latency == pytest.approx(2e-3)
    command(driver, HERE)
    assert not driver.observe(report(HERE, stamp_ns=10**9 + 4_000_000), BEGAN)
    assert driver.latency == pytest.approx(3e-3)


def test_who_reports_after_a_lease_lapsed_is_not_dead() -> None:
    driver = monitor()
    driver.lost("pdm_driver has died")
    assert driver.silent(BEGAN + 0.5) == "pdm_driver has died"
    driver.observe(report(), BEGAN + 1.0)
    assert driver.silent(BEGAN + 1.5) == ""
    assert "has not reported for 5.0 s" in driver.silent(BEGAN + 6.0)
    driver.check(FocusRequest(), BEGAN + 1.5)


@pytest.mark.parametrize("ahead", [-8.0, 0.0, 8.0])
def test_a_driver_whose_clock_is_ahead_is_not_one_whose_clock_jumps(ahead: float) -> None:
    driver, steady, here, there = monitor(), BEGAN, 1000.0, 1000.0 + ahead  # s, clocks less the steady one

    def idle_then_move() -> list[float]:
        """What was gained in 25 s of reports that repeat a stamp, and with the next one."""
        nonlocal steady
        gains = []
        for _ in range(25):
            moment = Moment(0, here + steady, steady)
            gains.append(driver.clock_gain(report(stamp_ns=written), moment))
            steady += 1.0
        return [max(gains), driver.clock_gain(report(stamp_ns=stamp()), Moment(0, here + steady, steady))]

    def stamp() -> int:
        return round(1e9 * (there + steady))

    written = stamp() - 30 * 10**9  # the controller was started after the driver
    for _ in range(3):
        assert idle_then_move() == [0.0, 0.0]
        written = stamp()
    there += 60.0
    assert idle_then_move() == [0.0, pytest.approx(60.0 + min(0.0, ahead))]
    written = stamp()
    here += 60.0
    assert idle_then_move() == [pytest.approx(60.0), 0.0]
    written = stamp()
    here -= 60.0
    assert idle_then_move() == [0.0, 0.0]
