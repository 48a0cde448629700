"""What the actions `converge` and `build_recipes` work with, for tests: a host, stand-in driver and interferometer."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from dm_msgs.msg import ActuatorState, Calibration, FocusRequest, MirrorInfo, ZernikeCoefficients
from dm_msgs.srv import Degauss, Measure, SetSignals
from rclpy.node import Node

from dm_common.errors import ErrorCode, Refusal
from dm_common.hysteresis.model import HysteresisState
from dm_common.messages import doubles
from dm_common.ros import qos
from dm_common.ros.parameters import declare
from dm_controller.focus_actions import LOOP_PARAMETERS, serve_loops
from dm_controller.planning.active_calibration import ActiveCalibration, active_calibration
from dm_controller.planning.target import FocusTarget
from linear_mirror import RADIUS, LinearMirror, hexagon, make_mirror

X, Y = hexagon()


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
        self.degauss_steps: list[int] = []
        self.state = node.create_publisher(ActuatorState, "actuator_state", qos.STATE)
        self.node = node
        node.create_service(SetSignals, "set_signals", self._set)
        node.create_service(Degauss, "degauss", self._degauss)
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

    def _degauss(self, request: Any, response: Any) -> Any:
        self.degauss_steps.append(request.steps)
        self.signals = np.zeros(37)
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
    pairs = make_mirror().limits.pairs
    return MirrorInfo(
        actuators=37, actuator_x=doubles(X), actuator_y=doubles(Y), signal_min=-1.0, signal_max=1.0,
        neighbour_a=[int(a) for a, _b in pairs], neighbour_b=[int(b) for _a, b in pairs], neighbour_difference_max=2.0,
        working_aperture_diameter=2.0 * RADIUS,
    )  # fmt: skip


class Host(Node):
    """What the focus controller does to host the action."""

    def __init__(self) -> None:
        super().__init__("converge_host")
        self.refuse = False
        self.calibration: Calibration | None = calibration()
        self.values = declare(self, LOOP_PARAMETERS)
        self.reserved: list[str] = []
        self.actions = serve_loops(self, self.values, self)

    def target(self, wanted: FocusRequest) -> FocusTarget:
        if self.refuse:
            raise Refusal(ErrorCode.STALE, "header.stamp: the request is 9 s old")
        return FocusTarget(wanted.curvature, wanted.conic_constant, tuple(wanted.zernike))

    def active_calibration(self) -> ActiveCalibration:
        return active_calibration(self.calibration, mirror_info(), 0.01)

    def hysteresis(self) -> HysteresisState | None:
        return None

    def reserve(self, text: str) -> None:
        self.reserved.append(text)
