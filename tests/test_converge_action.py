"""The action `converge` over DDS: a host node, and stand-ins for driver and interferometer around a known mirror."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from dm_msgs.action import Converge
from dm_msgs.msg import ActuatorState, Calibration, ErrorCode, FocusRequest, MirrorInfo, ZernikeCoefficients
from dm_msgs.srv import Measure, SetSignals
from rclpy.node import Node

from dm_controller.converge_action import CONVERGE_PARAMETERS, ConvergeAction
from dm_controller.conversions import doubles, target_of
from dm_controller.target import FocusTarget
from dm_runtime import qos
from dm_runtime.executor import BackgroundExecutor
from dm_runtime.parameters import declare
from linear_mirror import RADIUS, LinearMirror, hexagon, make_mirror
from support import Observer

X, Y = hexagon()


class Refused(Exception):
    """As the focus controller refuses."""

    error_code = ErrorCode.STALE


@dataclass
class Decision:
    target: FocusTarget


class Bench:
    """Driver and interferometer as services on the observer's node."""

    def __init__(self, node: Node) -> None:
        self.mirror = LinearMirror(X, Y)
        self.gain = 0.85  # the mirror answers more weakly than its calibration says
        self.signals = np.zeros(37)
        self.measured = 0
        self.failures = 0  # maps that still fail
        self.pause = 0.0
        self.driver_state = ActuatorState.STATE_ACTIVE
        self.state = node.create_publisher(ActuatorState, "actuator_state", qos.STATE)
        self.node = node
        node.create_service(SetSignals, "set_signals", self._set)
        node.create_service(Measure, "measure", self._measure)
        node.create_timer(0.05, self.publish)

    def publish(self) -> None:
        signals = doubles(self.signals)
        self.state.publish(ActuatorState(driver_state=self.driver_state, requested=signals, applied=signals))

    def _set(self, request: Any, response: Any) -> Any:
        self.signals = np.array(request.signals)
        response.applied = request.signals
        self.publish()
        return response

    def _measure(self, request: Any, response: Any) -> Any:
        time.sleep(self.pause)
        if self.failures:
            self.failures -= 1
            response.error_code, response.message = ErrorCode.MAP_TIMEOUT, "no new map"
            return response
        self.measured += 1
        points = self.mirror.points
        sag = self.mirror.sag(self.gain * self.signals)
        response.zernike.convention = ZernikeCoefficients.BORN_WOLF
        response.zernike.coefficients = doubles(self.mirror.fit_terms(sag))
        response.zernike.radius = RADIUS
        response.zernike.valid_fraction = 1.0
        response.samples.x, response.samples.y = doubles(points.x), doubles(points.y)
        response.samples.weight, response.samples.sag = doubles(points.weight), doubles(sag)
        response.zernike.header.stamp = self.node.get_clock().now().to_msg()
        return response


def calibration() -> Calibration:
    mirror = LinearMirror(X, Y)
    points = mirror.points
    return Calibration(
        id="known", aperture_radius=RADIUS, actuators=37, terms=21, points=len(points), maps_used=100,
        influence_zernike=doubles(mirror.fit_terms(mirror.influence.T).T.ravel()),
        zernike_offset=doubles(mirror.figure_coefficients),
        sample_x=doubles(points.x), sample_y=doubles(points.y), sample_weight=doubles(points.weight),
        influence_sag=doubles(mirror.influence.ravel()),
        sag_offset=doubles(mirror.modes @ mirror.figure_coefficients),
        in_sample_rms=1e-10, held_out_rms=1e-10, held_out_max_zernike=1e-10,
    )  # fmt: skip


def mirror_info() -> MirrorInfo:
    pairs = make_mirror().neighbours
    return MirrorInfo(
        actuators=37, actuator_x=doubles(X), actuator_y=doubles(Y), signal_min=-1.0, signal_max=1.0,
        neighbour_a=[int(a) for a, _b in pairs], neighbour_b=[int(b) for _a, b in pairs], neighbour_difference_max=2.0,
    )  # fmt: skip


class Host(Node):
    """What the focus controller does to host the action."""

    def __init__(self) -> None:
        super().__init__("converge_host")
        self.refuse = False
        self.calibration: Calibration | None = calibration()
        self.values = declare(self, CONVERGE_PARAMETERS)
        self.action = ConvergeAction(self, self.values, self.decide, lambda: (self.calibration, mirror_info()))

    def decide(self, request: FocusRequest) -> Decision:
        if self.refuse:
            raise Refused("header.stamp: the request is 9 s old")
        return Decision(target_of(request))


@pytest.fixture
def host(observer: Observer) -> Iterator[Host]:
    node = Host()
    background = BackgroundExecutor(node)
    yield node
    background.destroy_node()


@pytest.fixture
def bench(observer: Observer) -> Bench:
    return Bench(observer.node)


def goal(curvature: float = 0.02, **fields: Any) -> Converge.Goal:
    return Converge.Goal(request=FocusRequest(curvature=curvature), **fields)


def run(observer: Observer, wanted: Converge.Goal) -> tuple[int, Any]:
    ended = observer.run_goal(Converge, "converge", wanted, timeout_s=30.0)
    return ended.status, ended.result


def test_it_converges_and_tells_its_steps(observer: Observer, host: Host, bench: Bench) -> None:
    feedback: list[Any] = []
    handle, future = observer.send_goal(
        Converge, "converge", goal(tolerance=1e-9), lambda message: feedback.append(message.feedback)
    )
    assert handle.accepted
    deadline = time.monotonic() + 30
    while not future.done() and time.monotonic() < deadline:
        time.sleep(0.02)
    ended = future.result()
    assert ended.status == GoalStatus.STATUS_SUCCEEDED, ended.result.message
    result = ended.result
    assert result.error_code == ErrorCode.OK
    assert result.maps == bench.measured >= 2
    assert result.max_zernike < 1e-9
    assert result.residual_rms > 0
    np.testing.assert_allclose(result.signals, bench.signals)
    true = bench.mirror.fit_terms(bench.mirror.sag(0.85 * bench.signals)) - FocusTarget(0.02).coefficients(RADIUS)
    assert np.abs(true[3:]).max() == pytest.approx(result.max_zernike, rel=1e-6)
    assert [step.step for step in feedback] == list(range(1, result.maps + 1))
    assert feedback[0].max_zernike > feedback[-1].max_zernike


def test_the_map_limit_ends_it_with_the_best_command(observer: Observer, host: Host, bench: Bench) -> None:
    status, result = run(observer, goal(tolerance=1e-11, max_maps=2, method="pseudo_inverse"))
    assert status == GoalStatus.STATUS_ABORTED
    assert result.error_code == ErrorCode.NOT_CONVERGED
    assert result.maps == bench.measured == 2
    assert "not within the tolerance" in result.message
    assert len(result.signals) == 37


def test_a_failed_map_is_tried_again_then_given_up(observer: Observer, host: Host, bench: Bench) -> None:
    bench.failures = 1
    assert run(observer, goal())[1].error_code == ErrorCode.OK
    bench.failures = 2
    _, result = run(observer, goal(-0.02))
    assert result.error_code == ErrorCode.MAP_TIMEOUT
    assert "no new map" in result.message


def test_cancelling_leaves_the_last_command(observer: Observer, host: Host, bench: Bench) -> None:
    bench.pause = 0.5
    handle, future = observer.send_goal(Converge, "converge", goal(tolerance=1e-11, max_maps=50))
    deadline = time.monotonic() + 15
    while bench.measured < 1 and time.monotonic() < deadline:
        time.sleep(0.02)
    handle.cancel_goal_async()
    while not future.done() and time.monotonic() < deadline:
        time.sleep(0.02)
    ended = future.result()
    assert ended.status == GoalStatus.STATUS_CANCELED
    assert ended.result.error_code == ErrorCode.CANCELED
    assert "the mirror holds the last command" in ended.result.message
    assert ended.result.maps >= 1
    held = bench.signals.copy()
    time.sleep(1.0)
    np.testing.assert_array_equal(bench.signals, held)


@pytest.mark.parametrize(
    ("fields", "code", "words"),
    [
        ({"method": "SVD"}, ErrorCode.UNKNOWN_NAME, "method = 'SVD': unknown; must be one of pseudo_inverse"),
        ({"tolerance": -1.0}, ErrorCode.INVALID_ARGUMENT, "tolerance = -1.0 m: must be 0"),
        ({"tolerance": float("nan")}, ErrorCode.INVALID_ARGUMENT, "tolerance = nan"),
        ({"max_maps": 1000}, ErrorCode.INVALID_ARGUMENT, "max_maps = 1000: must be 0"),
        ({"curvature": 200.0}, ErrorCode.INVALID_ARGUMENT, "must be below 1"),
    ],
)
def test_bad_goals_are_refused_and_nothing_moves(
    observer: Observer, host: Host, bench: Bench, fields: dict[str, Any], code: int, words: str
) -> None:
    status, result = run(observer, goal(**fields))
    assert status == GoalStatus.STATUS_ABORTED
    assert result.error_code == code
    assert words in result.message
    assert bench.measured == 0
    assert not bench.signals.any()


def test_what_the_host_refuses_does_not_start(observer: Observer, host: Host, bench: Bench) -> None:
    host.refuse = True
    _, result = run(observer, goal())
    assert (result.error_code, result.message) == (ErrorCode.STALE, "header.stamp: the request is 9 s old")
    host.refuse, host.calibration = False, None
    assert run(observer, goal())[1].error_code == ErrorCode.NOT_CALIBRATED
    assert bench.measured == 0
