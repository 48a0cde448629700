"""Node `pdm_driver` in its own process, over DDS on one side and a TCP drive unit on the other."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from dm_msgs.action import Degauss
from dm_msgs.msg import ActuatorCommand, ActuatorState, ErrorCode, MirrorInfo
from dm_msgs.srv import HoldMirror, SetSignals
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter

from dm_common.ros import qos
from drive_unit_servers import Edac40TcpUnit, signals_of
from support import NodeProcess, Observer, wait_until

#: Age of a command whose stamp is negative.
BEFORE_THE_EPOCH = float("inf")
CODE = 2.0 * 12 * 80 / 300 / 65535

Start = Callable[..., NodeProcess]


@pytest.fixture
def unit() -> Iterator[Edac40TcpUnit]:
    with Edac40TcpUnit() as server:
        assert isinstance(server, Edac40TcpUnit)
        yield server


def parameters(unit: Edac40TcpUnit, **changes: Any) -> dict[str, Any]:
    """A whole configuration; keyword `a__b` sets the parameter `a.b`, None removes it."""
    values: dict[str, Any] = {
        "mirror.serial": "07-123",
        "state_folder": "",
        "electronics.kind": "edac40_tcp",
        "electronics.address": "127.0.0.1",
        "electronics.port": unit.port,
        "volts.dac_at_zero": -6.0,
        "volts.dac_at_full": 6.0,
        "volts.amplifier_gain": 80.0,
        "volts.min": 0.0,
        "volts.max": 300.0,
    }
    values.update({name.replace("__", "."): value for name, value in changes.items()})
    return {name: value for name, value in values.items() if value is not None}


class Driver:
    """The driver as seen by its neighbours."""

    def __init__(self, observer: Observer, unit: Edac40TcpUnit) -> None:
        self.observer = observer
        self.unit = unit
        self.states = observer.record(ActuatorState, "actuator_state", qos.STATE)
        self.infos = observer.record(MirrorInfo, "mirror_info", qos.LATCHED)
        self.diagnostics = observer.record(DiagnosticArray, "/diagnostics")
        self._publisher = observer.node.create_publisher(ActuatorCommand, "actuator_command", qos.COMMAND)

    def command(self, signals: Any, age_s: float | None = None, expected_turns: int = 0) -> None:
        wait_until(lambda: self._publisher.get_subscription_count() > 0, what="the driver's subscription")
        message = ActuatorCommand(signals=[float(value) for value in signals], expected_turns=expected_turns)
        if age_s is not None:
            now_ns = self.observer.node.get_clock().now().nanoseconds
            stamp_ns = -1_000_000_000 if age_s == BEFORE_THE_EPOCH else now_ns - round(age_s * 1e9)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
        self._publisher.publish(message)

    def wait_for_state(self, condition: Callable[[ActuatorState], Any], what: str) -> ActuatorState:
        """The first state, from the newest one on, that meets the condition."""
        seen = max(0, len(self.states) - 1)

        def find() -> ActuatorState | None:
            return next((state for state in self.states[seen:] if condition(state)), None)

        return wait_until(find, 60, what)

    def wait_for_refusal(self, code: int, words: str) -> ActuatorState:
        return self.wait_for_state(lambda state: state.error_code == code and words in state.message, words)

    def wait_active(self) -> None:
        self.wait_for_state(
            lambda state: state.driver_state == ActuatorState.STATE_ACTIVE and state.sequence >= 1, "active"
        )

    def change(self, transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(self.observer.call(ChangeState, "pdm_driver/change_state", request).success)

    def set_parameter(self, name: str, value: Any) -> str:
        """Set a parameter; the reason why it was refused, "" = it was not."""
        change = Parameter(name, value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[change])
        return str(self.observer.call(SetParameters, "pdm_driver/set_parameters", request).results[0].reason)

    def set_signals(self, signals: Any, **fields: Any) -> Any:
        request = SetSignals.Request(signals=[float(value) for value in signals], **fields)
        return self.observer.call(SetSignals, "set_signals", request)


@pytest.fixture
def driver(start: Start, observer: Observer, unit: Edac40TcpUnit) -> Driver:
    start("dm_driver", "pdm_driver", parameters(unit))
    result = Driver(observer, unit)
    result.wait_active()
    return result


def test_a_correction_counts_only_for_the_shape_that_it_corrects(driver: Driver) -> None:
    def overtaken() -> bool:
        values = {item.key: item.value for message in driver.diagnostics[-1:] for item in message.status[0].values}
        return values.get("overtaken") == "1"

    shape = np.full(37, -0.95)
    driver.command(shape)
    state = driver.wait_for_state(lambda state: state.sequence == 2, "the shape")
    driver.command(-shape, expected_turns=state.turns + 1)
    wait_until(overtaken, what="a correction that was left out")
    driver.command(shape + 0.01, expected_turns=state.turns)
    state = driver.wait_for_state(lambda state: state.sequence == 3, "the correction")
    assert list(state.requested) == pytest.approx(list(shape + 0.01))
    assert state.error_code == ErrorCode.OK


def test_commands_reach_the_wire_and_the_state_tells(driver: Driver) -> None:
    unit = driver.unit
    wait_until(lambda: len(unit.frames) == 1)
    assert signals_of(unit.frames)[0] == pytest.approx(-1.0, abs=CODE)

    info = wait_until(lambda: driver.infos)[-1]
    assert (info.name, info.serial, info.actuators) == ("PDM30-37", "07-123", 37)
    assert (info.wiring, info.electronics) == ("trihex", "edac40_tcp")
    assert len(info.neighbour_a) == len(info.neighbour_b) == 90
    assert max(np.hypot(info.actuator_x, info.actuator_y)) == pytest.approx(12.9e-3)
    assert (info.volts_min, info.volts_max) == (0.0, 300.0)
    assert list(info.safe_signals) == [-1.0] * 37

    small = -1.0 + 0.1 * np.linspace(0, 1, 37)
    driver.command(small, age_s=0.0)
    state = driver.wait_for_state(lambda state: state.sequence == 2, "the second write")
    assert list(state.requested) == pytest.approx(small)
    assert list(state.applied) == pytest.approx(small, abs=CODE)
    assert list(state.volts) == pytest.approx((small + 1) * 150, abs=CODE * 150)
    assert not state.moving and not state.history_known
    assert state.error_code == ErrorCode.OK and state.message == ""
    assert state.flags[0] == ActuatorState.FLAG_AT_LIMIT and state.flags[36] == 0
    assert len(unit.frames) == 2
    assert signals_of(unit.frames)[1] == pytest.approx(small, abs=CODE)

    driver.command(np.full(37, 1.0))  # without a stamp: now
    state = driver.wait_for_state(lambda state: not state.moving and state.applied[0] > 0.9, "the end of the ramp")
    wait_until(lambda: len(unit.frames) == state.sequence)
    on_wire = signals_of(unit.frames)
    assert len(on_wire) == 2 + 20
    assert on_wire[-1] == pytest.approx(1.0, abs=CODE)
    assert np.abs(np.diff(on_wire, axis=0)).max() <= 0.1 + CODE
    ramping = [state for state in driver.states if state.moving]
    assert ramping and ramping[0].sequence in (2, 3)  # 2: told between acceptance and first write
    assert all(flag & ActuatorState.FLAG_RAMPING for flag in ramping[0].flags)


def test_refused_commands_leave_the_wire_alone(driver: Driver) -> None:
    good = np.zeros(37)
    assert driver.set_signals(good, wait=True).error_code == ErrorCode.OK
    wait_until(lambda: signals_of(driver.unit.frames)[-1] == pytest.approx(0.0, abs=CODE), what="the last frame")
    frames = len(driver.unit.frames)
    nan, outside, neighbours = good.copy(), good.copy(), good.copy()
    nan[4] = np.nan
    outside[6] = 1.01
    neighbours[0], neighbours[2] = 0.6, -0.6
    cases: list[tuple[Any, float | None, int, list[int], str]] = [
        (good[:36], None, ErrorCode.INVALID_LENGTH, [], "36 values: must have 37"),
        (nan, None, ErrorCode.NOT_FINITE, [4], "actuator 5 = nan"),
        (outside, None, ErrorCode.OUT_OF_RANGE, [6], "actuator 7 = 1.01: must be -1 to 1"),
        (neighbours, None, ErrorCode.NEIGHBOUR_DIFFERENCE, [0, 2], "actuators 1 and 3"),
        (good, 5.0, ErrorCode.STALE, [], "s old: must be at most 1 s"),
        (good, -5.0, ErrorCode.STALE, [], "in the future"),
        (good, BEFORE_THE_EPOCH, ErrorCode.STALE, [], "s old: must be at most 1 s"),
    ]
    for signals, age_s, code, actuators, words in cases:
        driver.command(signals, age_s)
        state = driver.wait_for_refusal(code, words)
        assert [i for i, flag in enumerate(state.flags) if flag & ActuatorState.FLAG_REFUSED] == actuators
        assert list(state.requested) == pytest.approx([0.0] * 37)
        assert state.driver_state == ActuatorState.STATE_ACTIVE
        if age_s is None:
            answer = driver.set_signals(signals)
            assert answer.error_code == code and words in answer.message
    # A refused dry run is answered; an accepted one moves nothing.
    assert driver.set_signals(outside, dry_run=True).error_code == ErrorCode.OUT_OF_RANGE
    answer = driver.set_signals(np.full(37, 0.8), dry_run=True)
    assert answer.error_code == ErrorCode.OK and answer.ramp_time == pytest.approx(0.7 / 40)
    assert len(driver.unit.frames) == frames

    def counted() -> bool:
        values = {pair.key: pair.value for pair in driver.diagnostics[-1].status[0].values}
        return values.get("refused STALE") == "3" and values.get("refused OUT_OF_RANGE") == "2"

    wait_until(lambda: driver.diagnostics and counted(), what="the counts in the diagnostics")
    assert driver.diagnostics[-1].status[0].level == b"\x01"
    driver.command(np.full(37, 0.05))
    state = driver.wait_for_state(lambda state: state.error_code == ErrorCode.OK, "recovery")
    wait_until(lambda: len(driver.unit.frames) == frames + 1)


def test_set_signals_answers_when_the_shape_stands(driver: Driver) -> None:
    answer = driver.set_signals(np.full(37, 0.5), wait=True)
    assert answer.error_code == ErrorCode.OK
    assert list(answer.applied) == pytest.approx([0.5] * 37, abs=CODE)
    assert answer.ramp_time == pytest.approx(1.4 / 40)
    wait_until(lambda: len(driver.unit.frames) == 16)
    assert signals_of(driver.unit.frames)[-1] == pytest.approx(0.5, abs=CODE)


def test_a_later_set_signals_takes_over_from_one_that_waits(
    start: Start, observer: Observer, unit: Edac40TcpUnit
) -> None:
    start("dm_driver", "pdm_driver", parameters(unit, limits__slew_rate=0.7))
    driver = Driver(observer, unit)
    driver.wait_active()
    client = observer.node.create_client(SetSignals, "set_signals")
    first = client.call_async(SetSignals.Request(signals=[1.0] * 37, wait=True))
    driver.wait_for_state(lambda state: state.moving, "the first ramp")
    assert driver.set_signals(np.full(37, -1.0), wait=True).error_code == ErrorCode.OK
    wait_until(first.done)
    assert first.result().error_code == ErrorCode.PREEMPTED
    assert signals_of(unit.frames).max() < 0.9


def test_degauss_makes_the_history_known(driver: Driver) -> None:
    goal = Degauss.Goal(steps=6, end_signals=[0.1] * 37)
    answer = driver.observer.run_goal(Degauss, "degauss", goal).result
    assert answer.error_code == ErrorCode.OK and answer.duration > 0 and "history" not in answer.message
    state = driver.wait_for_state(lambda state: state.history_known and not state.moving, "history known")
    assert list(state.applied) == pytest.approx([0.1] * 37, abs=CODE)
    on_wire = signals_of(driver.unit.frames)
    assert np.abs(np.diff(on_wire, axis=0)).max() <= 0.1 + CODE
    bad = driver.observer.run_goal(Degauss, "degauss", Degauss.Goal(amplitude=1.5)).result
    assert bad.error_code == ErrorCode.OUT_OF_RANGE and "must be float, 0 to 1" in bad.message


@pytest.mark.parametrize("goal", [Degauss.Goal(steps=4), Degauss.Goal(steps=6, amplitude=0.5)])
def test_a_degauss_that_wipes_too_little_says_so(driver: Driver, goal: Degauss.Goal) -> None:
    answer = driver.observer.run_goal(Degauss, "degauss", goal).result
    assert answer.error_code == ErrorCode.OK
    assert "the history is known only after 5 or more over the whole range" in answer.message


def test_a_degauss_has_feedback_and_a_bound_and_is_cancelled_to_the_shape_before(driver: Driver) -> None:
    assert driver.set_signals(np.full(37, 0.25), wait=True).error_code == ErrorCode.OK
    long = driver.observer.run_goal(Degauss, "degauss", Degauss.Goal(steps=9999)).result
    assert long.error_code == ErrorCode.OUT_OF_RANGE and "degauss.duration_max" in long.message
    feedback: list[Degauss.Feedback] = []
    handle, result = driver.observer.send_goal(
        Degauss, "degauss", Degauss.Goal(steps=2000), lambda message: feedback.append(message.feedback)
    )
    wait_until(lambda: len(feedback) > 2)
    handle.cancel_goal_async()
    wait_until(result.done)
    cancelled = result.result().result
    assert cancelled.error_code == ErrorCode.CANCELED and "back in the shape" in cancelled.message
    assert feedback[-1].steps == 2000 and feedback[0].step < feedback[-1].step and feedback[-1].remaining > 30
    state = driver.wait_for_state(lambda state: not state.moving, "rest")
    assert list(state.applied) == pytest.approx([0.25] * 37, abs=CODE) and not state.history_known


def test_one_owner_of_the_mirror_at_a_time(driver: Driver) -> None:
    def hold(operation: int, holder: str = "calibration", **fields: Any) -> Any:
        request = HoldMirror.Request(operation=operation, holder=holder, **fields)
        return driver.observer.call(HoldMirror, "hold_mirror", request)

    assert hold(HoldMirror.Request.HOLD, purpose="cancel calibrate to end it", lease=60.0).error_code == ErrorCode.OK
    assert driver.set_signals(np.zeros(37), wait=True, holder="calibration").error_code == ErrorCode.OK
    busy = driver.set_signals(np.full(37, 0.5))
    assert busy.error_code == ErrorCode.BUSY and "cancel calibrate" in busy.message
    _, ours = driver.observer.send_goal(
        Degauss, "degauss", Degauss.Goal(steps=60, end_signals=[0.0] * 37, holder="calibration")
    )
    driver.wait_for_state(lambda state: state.moving, "the degauss of the holder")
    strange = driver.observer.run_goal(Degauss, "degauss", Degauss.Goal(steps=6)).result
    assert strange.error_code == ErrorCode.BUSY and not ours.done()
    wait_until(ours.done)
    assert ours.result().result.error_code == ErrorCode.OK
    driver.command(np.full(37, 0.5))
    state = driver.wait_for_refusal(ErrorCode.BUSY, "actuator_command refused: calibration has held")
    assert list(state.applied) == pytest.approx([0.0] * 37, abs=CODE) and state.holder == "calibration"
    bad = driver.set_signals(np.full(37, 5.0), take_over=True)
    assert bad.error_code == ErrorCode.OUT_OF_RANGE and driver.states[-1].holder == "calibration"
    assert driver.set_signals(np.full(37, 0.5), wait=True, take_over=True).error_code == ErrorCode.OK
    assert hold(HoldMirror.Request.RENEW).error_code == ErrorCode.PREEMPTED
    driver.wait_for_state(lambda state: state.holder == "" and state.holding == "", "nobody holds it")
    assert hold(HoldMirror.Request.HOLD, holder="autofocus").error_code == ErrorCode.OK
    taking = Degauss.Goal(steps=6, take_over=True)
    assert driver.observer.run_goal(Degauss, "degauss", taking).result.error_code == ErrorCode.OK
    assert hold(HoldMirror.Request.RENEW, holder="autofocus").error_code == ErrorCode.PREEMPTED


def test_unit_unplugged_during_a_ramp_and_its_return(start: Start, observer: Observer, unit: Edac40TcpUnit) -> None:
    node = start("dm_driver", "pdm_driver", parameters(unit, limits__slew_rate=2.0))
    driver = Driver(observer, unit)
    driver.wait_active()
    driver.command(np.full(37, 1.0))
    wait_until(lambda: len(unit.frames) > 5)
    unit.unplug()
    state = driver.wait_for_state(lambda state: state.driver_state == ActuatorState.STATE_LINK_LOST, "link lost")
    assert state.error_code == ErrorCode.ELECTRONICS_UNREACHABLE
    assert f"127.0.0.1:{unit.port}" in state.message
    assert not state.history_known
    answer = driver.set_signals(np.zeros(37))
    assert answer.error_code == ErrorCode.ELECTRONICS_UNREACHABLE
    wait_until(
        lambda: driver.diagnostics and driver.diagnostics[-1].status[0].level == b"\x02",
        what="an error in the diagnostics",
    )
    assert "link lost" in driver.diagnostics[-1].status[0].message

    applied = list(driver.states[-1].applied)
    before = len(unit.frames)
    unit.plug()
    driver.wait_for_state(lambda state: state.driver_state == ActuatorState.STATE_ACTIVE, "active again")
    wait_until(lambda: len(unit.frames) > before)
    assert signals_of(unit.frames)[before] == pytest.approx(applied, abs=1e-9)
    answer = driver.set_signals(np.full(37, -1.0), wait=True)
    assert answer.error_code == ErrorCode.OK

    unit.unplug()
    driver.wait_for_state(lambda state: state.driver_state == ActuatorState.STATE_LINK_LOST, "link lost again")
    for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE) * 2:
        assert driver.change(transition)
    wait_until(lambda: node.output.count("the safe shape was not reached") == 2, what="both reports")


def test_a_unit_that_is_off_at_the_start_is_taken_when_it_comes(
    start: Start, observer: Observer, unit: Edac40TcpUnit
) -> None:
    unit.unplug()
    start("dm_driver", "pdm_driver", parameters(unit))
    driver = Driver(observer, unit)
    state = driver.wait_for_state(
        lambda state: (
            state.driver_state == ActuatorState.STATE_LINK_LOST
            and state.error_code == ErrorCode.ELECTRONICS_UNREACHABLE
        ),
        "link lost",
    )
    assert "cannot open EDAC40" in state.message and list(state.applied) == []
    unit.plug()
    driver.wait_active()
    wait_until(lambda: unit.frames)
    assert signals_of(unit.frames)[0] == pytest.approx(-1.0, abs=CODE)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ramps_to_the_safe_shape(
    start: Start, observer: Observer, unit: Edac40TcpUnit, number: signal.Signals
) -> None:
    safe = np.linspace(-0.9, -0.5, 37)
    node = start("dm_driver", "pdm_driver", parameters(unit, safe_signals=[float(value) for value in safe]))
    driver = Driver(observer, unit)
    driver.wait_active()
    assert driver.set_signals(np.full(37, 0.8), wait=True).error_code == ErrorCode.OK
    assert node.stop(number) == 0
    wait_until(lambda: signals_of(unit.frames[-1:])[0] == pytest.approx(safe, abs=CODE), what="safe shape")
    on_wire = signals_of(unit.frames)
    assert np.abs(np.diff(on_wire, axis=0)).max() <= 0.1 + CODE
    assert "Traceback" not in node.output
    assert "the mirror stands in the safe shape" in node.output


def test_the_mirror_is_described_again_when_another_driver_of_this_name_has_ended(driver: Driver) -> None:
    node = driver.observer.node
    wait_until(lambda: driver.infos, what="the driver's own description")  # it would come after the other otherwise
    other = node.create_publisher(MirrorInfo, "mirror_info", qos.LATCHED)
    wait_until(lambda: other.get_subscription_count() > 0)
    other.publish(MirrorInfo(serial="another"))
    wait_until(lambda: driver.infos[-1].serial == "another")
    seen = len(driver.states)
    wait_until(lambda: len(driver.states) > seen + 1, what="reports, with which the driver looks for others")
    node.destroy_publisher(other)
    wait_until(lambda: driver.infos[-1].serial != "another", what="the description of the mirror")


def test_a_degauss_is_answered_when_the_process_ends(start: Start, observer: Observer, unit: Edac40TcpUnit) -> None:
    node, driver = start("dm_driver", "pdm_driver", parameters(unit)), Driver(observer, unit)
    driver.wait_active()
    _, result = observer.send_goal(Degauss, "degauss", Degauss.Goal(steps=2000))
    wait_until(lambda: driver.states[-1].moving)
    assert node.stop() == 0
    wait_until(result.done)
    assert result.result().result.error_code == ErrorCode.DRIVER_INACTIVE and "Traceback" not in node.output


def test_lifecycle_by_hand(start: Start, observer: Observer, unit: Edac40TcpUnit) -> None:
    start("dm_driver", "pdm_driver", parameters(unit, autostart=False))
    driver = Driver(observer, unit)
    driver.wait_for_state(lambda state: state.driver_state == ActuatorState.STATE_UNCONFIGURED, "unconfigured")
    answer = driver.set_signals(np.zeros(37))
    assert answer.error_code == ErrorCode.DRIVER_INACTIVE
    assert answer.message.endswith("`ros2 lifecycle set /pdm_driver configure`, then `activate`")
    assert driver.change(Transition.TRANSITION_CONFIGURE)
    driver.wait_for_state(lambda state: state.driver_state == ActuatorState.STATE_INACTIVE, "inactive")
    answer = driver.set_signals(np.zeros(37))
    assert answer.error_code == ErrorCode.DRIVER_INACTIVE and "activate" in answer.message
    assert answer.message == "pdm_driver is not active: `ros2 lifecycle set /pdm_driver activate`"
    driver.wait_for_state(lambda state: state.message == answer.message, "the reason")
    driver.command(np.zeros(37))

    def refused() -> bool:
        values = {item.key: item.value for message in driver.diagnostics[-1:] for item in message.status[0].values}
        return values.get("refused DRIVER_INACTIVE") == "3"  # with the two calls

    wait_until(refused, what="refusal")
    assert unit.raw == b"" and driver.states[-1].error_code == ErrorCode.DRIVER_INACTIVE

    assert driver.change(Transition.TRANSITION_ACTIVATE)
    driver.wait_active()
    assert driver.set_signals(np.full(37, 0.4), wait=True).error_code == ErrorCode.OK
    assert "cleanup" in driver.set_parameter("mirror.serial", "another")
    assert driver.change(Transition.TRANSITION_DEACTIVATE)
    state = driver.wait_for_state(lambda state: state.driver_state == ActuatorState.STATE_INACTIVE, "inactive")
    assert list(state.applied) == pytest.approx([-1.0] * 37, abs=CODE)
    assert any(state.driver_state == ActuatorState.STATE_SAFING for state in driver.states)
    on_wire = signals_of(unit.frames)
    assert on_wire[-1] == pytest.approx(-1.0, abs=CODE)
    assert np.abs(np.diff(on_wire, axis=0)).max() <= 0.1 + CODE
    assert driver.change(Transition.TRANSITION_CLEANUP)
    state = driver.wait_for_state(lambda state: state.driver_state == ActuatorState.STATE_UNCONFIGURED, "unconfigured")
    assert "configure`, then `activate`" in state.message
    assert driver.set_parameter("mirror.serial", "another") == ""
    assert driver.change(Transition.TRANSITION_CONFIGURE)
    wait_until(lambda: driver.infos[-1].serial == "another", what="the new serial number")
    assert driver.change(Transition.TRANSITION_ACTIVATE)
    assert driver.set_signals(np.full(37, -0.5), wait=True).error_code == ErrorCode.OK
    # Straight from active to finalized: the safe shape again.
    assert driver.change(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    wait_until(lambda: signals_of(unit.frames[-1:])[0] == pytest.approx(-1.0, abs=CODE), what="safe shape")


def test_another_state_period_holds_at_once(start: Start, observer: Observer, unit: Edac40TcpUnit) -> None:
    start("dm_driver", "pdm_driver", parameters(unit, autostart=False))
    driver = Driver(observer, unit)
    for period in (60.0, 0.05):
        assert driver.set_parameter("state_period", period) == ""
        assert driver.change(Transition.TRANSITION_CONFIGURE)
        assert driver.change(Transition.TRANSITION_CLEANUP)
    before = len(driver.states)
    wait_until(lambda: len(driver.states) > before + 10, 20, "states in the new period")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"mirror__wiring": "hexagon"}, ["mirror.wiring = 'hexagon'", "trihex, 37ch_30mm, 37ch_30mm_v2005, custom"]),
        (
            {"mirror__serial": None, "electronics__kind": None, "volts__min": None, "volts__amplifier_gain": None},
            ["required", "mirror.serial", "electronics.kind", "volts.min", "volts.amplifier_gain"],
        ),
        ({"volts__max": 500.0}, ["volts.max = 500 V needs 6.25 V"]),
        ({"safe_signals": [0.0] * 36}, ["safe_signals has 36 values: must have 37"]),
        ({"limits__step": 5.0}, ["limits.step", "5.0"]),
        ({"limits__neighbour_differnce": 2.0}, ["limits.neighbour_differnce", "did you mean limits.neighbour_diff"]),
        ({"electronics__address": ""}, ["electronics.address is empty"]),
        ({"limits__slew_rate": 0.5}, ["degauss.steps = 100", "limits.slew_rate = 0.5", "degauss.duration_max"]),
    ],
)
def test_wrong_configurations_are_refused_in_words(
    start: Start, observer: Observer, unit: Edac40TcpUnit, changes: dict[str, Any], words: list[str]
) -> None:
    node = start("dm_driver", "pdm_driver", parameters(unit, **changes))
    driver = Driver(observer, unit)
    state = driver.wait_for_state(lambda state: state.message, "the reason")
    assert state.driver_state == ActuatorState.STATE_UNCONFIGURED
    assert state.error_code == ErrorCode.INVALID_ARGUMENT
    for word in words:
        assert word in state.message
        assert word in node.output
    answer = driver.set_signals(np.zeros(37))
    assert answer.error_code == ErrorCode.DRIVER_INACTIVE and all(word in answer.message for word in words)
    assert node.running and unit.clients == 0
    assert node.stop() == 0


def test_watchdog_over_dds(start: Start, observer: Observer, unit: Edac40TcpUnit) -> None:
    start("dm_driver", "pdm_driver", parameters(unit, limits__watchdog=1.0))
    driver = Driver(observer, unit)
    driver.wait_active()
    assert driver.set_signals(np.full(37, 0.2), wait=True).error_code == ErrorCode.OK
    state = driver.wait_for_state(lambda state: not state.moving and state.applied[0] < -0.99, "safe shape")
    assert state.driver_state == ActuatorState.STATE_ACTIVE
    assert driver.set_signals(np.full(37, -0.9), wait=True).error_code == ErrorCode.OK
