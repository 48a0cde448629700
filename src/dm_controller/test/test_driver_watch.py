"""What is made of a driver's reports, and of their absence."""

from __future__ import annotations

import time
from array import array

import pytest
from dm_msgs.msg import ActuatorCommand, ActuatorState, ErrorCode, FocusRequest

from dm_common.errors import Refusal
from dm_controller.driver_watch import DriverWatch

TIMEOUT = 2.0
HERE, THERE = array("d", [0.1] * 37), array("d", [0.2] * 37)


class SteadyClock:
    """Stands until it is told to go on."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SteadyClock:
    made = SteadyClock()
    monkeypatch.setattr(time, "monotonic", made)
    return made


def report(requested: array[float] = HERE, sequence: int = 1, **fields: object) -> ActuatorState:
    fields.setdefault("driver_state", ActuatorState.STATE_ACTIVE)
    return ActuatorState(requested=requested, applied=requested, sequence=sequence, **fields)


def watch(timeout: float = TIMEOUT) -> DriverWatch:
    made = DriverWatch({"driver_timeout": timeout})
    made.observe(report())
    made.sent(ActuatorCommand(signals=THERE), FocusRequest(curvature=0.01))
    return made


def test_a_driver_that_never_reported_is_unavailable(clock: SteadyClock) -> None:
    with pytest.raises(Refusal, match="is the driver running"):
        DriverWatch({"driver_timeout": TIMEOUT}).check()


@pytest.mark.parametrize(("timeout", "refused"), [(TIMEOUT, True), (0.0, False)])
def test_reports_grow_old(clock: SteadyClock, timeout: float, refused: bool) -> None:
    driver = watch(timeout)
    clock.now += TIMEOUT
    driver.check()
    clock.now += 0.1
    assert bool(driver.silent) == bool(driver.stopped) == refused
    if refused:
        with pytest.raises(Refusal, match=r"has not reported for 2.1 s \(driver_timeout 2 s\)") as caught:
            driver.check()
        assert caught.value.error_code == ErrorCode.DRIVER_UNAVAILABLE
    else:
        driver.check()


def test_a_command_that_is_confirmed_is_not_told_of(clock: SteadyClock) -> None:
    driver = watch()
    clock.now += 0.5
    driver.observe(report(THERE))
    clock.now += 10.0
    assert driver.untaken() is None


@pytest.mark.parametrize(
    ("last", "code", "words"),
    [
        (report(), ErrorCode.PREEMPTED, "follows another one"),
        (report(error_code=ErrorCode.STALE, message="too old"), ErrorCode.STALE, "too old"),
        (report(driver_state=ActuatorState.STATE_INACTIVE), ErrorCode.DRIVER_INACTIVE, "not active"),
        (None, ErrorCode.DRIVER_UNAVAILABLE, "has not reported"),
    ],
)
def test_a_command_that_is_not_confirmed_is_told_of_once(
    clock: SteadyClock, last: ActuatorState | None, code: int, words: str
) -> None:
    driver = watch()
    assert driver.untaken() is None
    clock.now += TIMEOUT + 0.1
    if last is not None:
        driver.observe(last)
    told = driver.untaken()
    assert told is not None
    request, refusal = told
    assert request is not None and request.curvature == 0.01
    assert refusal.error_code == code
    assert words in str(refusal)
    assert driver.untaken() is None


def test_a_driver_that_was_started_anew_is_noticed(clock: SteadyClock) -> None:
    driver = watch()
    driver.observe(report(sequence=7))
    assert driver.starts == 0
    driver.observe(report(sequence=2))
    assert driver.starts == 1
