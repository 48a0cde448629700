"""Node `focus_controller` as a process over DDS; the test plays driver and calibration with an exactly known mirror."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from dm_msgs.action import MoveFocus
from dm_msgs.msg import (
    ActuatorCommand,
    ActuatorState,
    Calibration,
    Capabilities,
    ErrorCode,
    FocusRequest,
    FocusState,
    MirrorInfo,
)
from dm_msgs.srv import Flatten, SetFocus
from rclpy.time import Time

from dm_runtime import qos
from linear_mirror import RADIUS, LinearMirror, hexagon, make_mirror
from support import NodeProcess, Observer, wait_until

MIRROR = LinearMirror(*hexagon())


def mirror_info(serial: str = "T-1") -> MirrorInfo:
    x, y = hexagon()
    pairs = make_mirror().neighbours
    return MirrorInfo(
        name="PDM30-37",
        serial=serial,
        actuators=37,
        actuator_x=list(x),
        actuator_y=list(y),
        neighbour_a=[int(a) for a, _b in pairs],
        neighbour_b=[int(b) for _a, b in pairs],
        full_aperture_diameter=0.03,
        working_aperture_diameter=2 * RADIUS,
        signal_min=-1.0,
        signal_max=1.0,
        neighbour_difference_max=2.0,
        slew_rate_max=40.0,
    )


def calibration(serial: str = "T-1", radius: float = RADIUS) -> Calibration:
    points = MIRROR.points
    return Calibration(
        id="known",
        mirror_serial=serial,
        method="exact",
        aperture_radius=radius,
        actuators=37,
        terms=21,
        influence_zernike=MIRROR.fit_terms(MIRROR.influence.T).T.ravel().tolist(),
        zernike_offset=MIRROR.figure_coefficients.tolist(),
        points=len(points),
        sample_x=points.x.tolist(),
        sample_y=points.y.tolist(),
        sample_weight=points.weight.tolist(),
        influence_sag=MIRROR.influence.ravel().tolist(),
        sag_offset=(MIRROR.modes @ MIRROR.figure_coefficients).tolist(),
        in_sample_rms=1e-10,
        held_out_rms=2e-10,
        held_out_max_zernike=3e-10,
        maps_used=100,
        quality=Calibration.CALIBRATED,
    )


class Bench:
    """The controller under test with the stand-ins of its neighbours."""

    def __init__(self, observer: Observer, follow: bool = True) -> None:
        self.observer = observer
        node = observer.node
        self.info = node.create_publisher(MirrorInfo, "mirror_info", qos.LATCHED)
        self.calibration = node.create_publisher(Calibration, "calibration", qos.LATCHED)
        self.state = node.create_publisher(ActuatorState, "actuator_state", qos.STATE)
        self.request = node.create_publisher(FocusRequest, "focus_request", qos.COMMAND)
        self.commands: list[ActuatorCommand] = []
        self.follow = follow
        node.create_subscription(ActuatorCommand, "actuator_command", self._on_command, qos.COMMAND)
        self.focus_states = observer.record(FocusState, "focus_state", qos.STATE)
        self.capabilities: list[Capabilities] = observer.record(Capabilities, "capabilities", qos.LATCHED)

    def _on_command(self, command: ActuatorCommand) -> None:
        self.commands.append(command)
        if self.follow:
            self.publish_state(list(command.signals))

    def publish_state(self, applied: list[float], state: int = ActuatorState.STATE_ACTIVE) -> None:
        self.state.publish(ActuatorState(driver_state=state, requested=applied, applied=applied, history_known=True))

    def ready(self) -> Bench:
        """Mirror, calibration and an active driver are known to the controller."""
        self.info.publish(mirror_info())
        self.calibration.publish(calibration())
        wait_until(lambda: self.capabilities and self.capabilities[-1].calibration_id == "known")
        self.activate()
        return self

    def activate(self) -> None:
        wait_until(lambda: self.state.get_subscription_count() > 0)
        self.publish_state([0.0] * 37)

    def set_focus(self, dry_run: bool = False, **fields: Any) -> Any:
        return self.observer.call(
            SetFocus, "set_focus", SetFocus.Request(request=FocusRequest(**fields), dry_run=dry_run)
        )


@pytest.fixture
def bench(observer: Observer, start: Callable[..., NodeProcess]) -> Iterator[Bench]:
    made = Bench(observer)
    start("dm_controller", "focus_controller", {})
    yield made


def test_a_curvature_becomes_the_right_command(bench: Bench) -> None:
    bench.ready()
    response = wait_until(lambda: (r := bench.set_focus(curvature=0.02)).error_code == ErrorCode.OK and r)
    state = response.state
    wait_until(lambda: bench.commands)
    signals = np.asarray(bench.commands[-1].signals)
    np.testing.assert_array_equal(signals, np.asarray(state.signals))
    radius = RADIUS * np.hypot(MIRROR.points.x, MIRROR.points.y)
    error = MIRROR.fit_terms(MIRROR.sag(signals) - 0.02 * radius**2 / 2)
    assert np.abs(error[3:]).max() < 1e-10
    assert state.applied
    assert state.power == pytest.approx(0.04)
    assert state.calibration_id == "known"
    assert state.curvature_min < 0.02 < state.curvature_max
    assert state.predicted_rms < state.predicted_rms_upper
    assert state.history_known


def test_topic_requests_are_answered_on_focus_state(bench: Bench) -> None:
    bench.ready()
    wait_until(lambda: bench.request.get_subscription_count() > 0)
    bench.request.publish(FocusRequest(curvature=-0.01))
    state = wait_until(lambda: bench.focus_states and bench.focus_states[-1])
    assert state.error_code == ErrorCode.OK
    command = wait_until(lambda: bench.commands and bench.commands[-1])
    assert state.header.stamp == command.header.stamp


def test_dry_run_and_refusals_move_nothing(bench: Bench) -> None:
    bench.ready()
    preview = bench.set_focus(dry_run=True, curvature=0.01)
    assert preview.error_code == ErrorCode.OK
    assert not preview.state.applied
    far = bench.set_focus(curvature=1.0)
    assert far.error_code == ErrorCode.UNREACHABLE
    assert f"{far.state.curvature_max:+.4f}" in far.message
    assert "curvature = +1.0000" in far.message
    not_a_number = bench.set_focus(curvature=float("nan"))
    assert not_a_number.error_code == ErrorCode.INVALID_ARGUMENT
    assert "curvature = nan" in not_a_number.message
    two_terms = bench.set_focus(curvature=0.0, zernike=[1e-9, 2e-9])
    assert two_terms.error_code == ErrorCode.INVALID_ARGUMENT
    recipe = bench.set_focus(curvature=0.0, mode=FocusRequest.MODE_CONDITIONED)
    assert recipe.error_code == ErrorCode.NOT_SUPPORTED
    assert bench.set_focus(curvature=0.0, mode=77).error_code == ErrorCode.INVALID_ARGUMENT
    old = FocusRequest(curvature=0.01)
    old.header.stamp = Time(seconds=1000).to_msg()
    stale = bench.observer.call(SetFocus, "set_focus", SetFocus.Request(request=old))
    assert stale.error_code == ErrorCode.STALE
    assert bench.commands == []


def test_requests_without_calibration_driver_or_activation_are_refused(bench: Bench) -> None:
    assert bench.set_focus(curvature=0.01).error_code == ErrorCode.NOT_CALIBRATED
    bench.calibration.publish(calibration())
    wait_until(lambda: bench.set_focus(curvature=0.01).error_code == ErrorCode.DRIVER_UNAVAILABLE)
    bench.info.publish(mirror_info())
    wait_until(lambda: bench.capabilities[-1].calibration_id == "known")
    assert bench.set_focus(curvature=0.01).error_code == ErrorCode.DRIVER_UNAVAILABLE
    bench.publish_state([], ActuatorState.STATE_INACTIVE)
    wait_until(lambda: bench.set_focus(curvature=0.01).error_code == ErrorCode.DRIVER_INACTIVE)
    assert bench.commands == []


@pytest.mark.parametrize(
    ("wrong", "words"),
    [(calibration(serial="other"), "mirror serial 'other'"), (calibration(radius=0.0085), "radius 8.500 mm")],
)
def test_a_calibration_of_another_mirror_or_aperture_is_refused(bench: Bench, wrong: Any, words: str) -> None:
    bench.info.publish(mirror_info())
    bench.calibration.publish(wrong)
    bench.activate()
    response = wait_until(
        lambda: (r := bench.set_focus(curvature=0.01)).error_code == ErrorCode.CALIBRATION_MISMATCH and r
    )
    assert words in response.message
    assert bench.capabilities[-1].quality == Capabilities.UNCALIBRATED
    assert bench.commands == []


def test_capabilities_tell_range_in_curvature_and_dioptre(bench: Bench) -> None:
    bench.ready()
    message = bench.capabilities[-1]
    assert message.quality == Capabilities.CALIBRATED
    assert message.power_max == pytest.approx(2 * message.curvature_max)
    assert message.error_bound == pytest.approx(3e-10)
    assert "dioptre" in message.message
    assert message.settling == pytest.approx(2.0 / 40.0)


def test_flatten_removes_the_initial_figure(bench: Bench) -> None:
    bench.ready()
    response = wait_until(lambda: (r := bench.observer.call(Flatten, "flatten")).error_code == 0 and r)
    flat = MIRROR.fit_terms(MIRROR.sag(np.asarray(response.state.signals)))
    assert np.abs(flat[3:]).max() < 1e-10
    assert np.abs(MIRROR.figure_coefficients[3:]).max() > 1e-8


def test_move_focus_reports_when_the_shape_stands(bench: Bench) -> None:
    bench.ready()
    goal = MoveFocus.Goal(request=FocusRequest(curvature=0.015), settle_time=0.1)
    result = bench.observer.run_goal(MoveFocus, "move_focus", goal)
    assert result.status == GoalStatus.STATUS_SUCCEEDED
    assert result.result.error_code == ErrorCode.OK
    assert result.result.state.applied
    assert result.result.duration >= 0.1


def test_move_focus_refuses_a_tolerance_it_cannot_keep(bench: Bench) -> None:
    bench.ready()
    preview = bench.set_focus(dry_run=True, curvature=0.02)
    goal = MoveFocus.Goal(
        request=FocusRequest(curvature=0.02), tolerance=max(preview.state.predicted_max_zernike / 2, 1e-18)
    )
    result = bench.observer.run_goal(MoveFocus, "move_focus", goal)
    assert result.status == GoalStatus.STATUS_ABORTED
    assert result.result.error_code == ErrorCode.OUT_OF_RANGE
    assert bench.commands == []


def test_cancel_holds_the_shape_reached_and_the_newest_goal_preempts(bench: Bench) -> None:
    bench.follow = False  # the driver never gets there: the move lasts until it is told to stop
    bench.ready()
    half_way = [0.1] * 37
    handle, result = bench.observer.send_goal(
        MoveFocus, "move_focus", MoveFocus.Goal(request=FocusRequest(curvature=0.01))
    )
    wait_until(lambda: len(bench.commands) == 1)
    bench.publish_state(half_way)
    threading.Event().wait(0.1)
    handle.cancel_goal_async()
    wait_until(result.done)
    assert result.result().status == GoalStatus.STATUS_CANCELED
    assert result.result().result.error_code == ErrorCode.CANCELED
    wait_until(lambda: len(bench.commands) == 2)
    assert list(bench.commands[-1].signals) == half_way

    _, first = bench.observer.send_goal(MoveFocus, "move_focus", MoveFocus.Goal(request=FocusRequest(curvature=0.01)))
    wait_until(lambda: len(bench.commands) == 3)
    bench.follow = True
    _, second = bench.observer.send_goal(MoveFocus, "move_focus", MoveFocus.Goal(request=FocusRequest(curvature=0.02)))
    wait_until(first.done)
    assert first.result().result.error_code == ErrorCode.PREEMPTED
    wait_until(second.done)
    assert second.result().result.error_code == ErrorCode.OK


def test_move_is_aborted_when_the_driver_loses_its_electronics(bench: Bench) -> None:
    bench.follow = False
    bench.ready()
    _, result = bench.observer.send_goal(MoveFocus, "move_focus", MoveFocus.Goal(request=FocusRequest(curvature=0.01)))
    wait_until(lambda: bench.commands)
    bench.publish_state([0.0] * 37, ActuatorState.STATE_LINK_LOST)
    wait_until(result.done)
    assert result.result().result.error_code == ErrorCode.ELECTRONICS_UNREACHABLE
