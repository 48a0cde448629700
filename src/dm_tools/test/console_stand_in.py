"""The nodes of a suite as the console meets them: any number of actuators, a calibration at once, no waiting."""

from __future__ import annotations

from array import array
from types import SimpleNamespace
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from dm_msgs.msg import ActuatorEstimate, ActuatorState, Calibration, Capabilities, FocusState, MirrorInfo
from dm_msgs.srv import ListCalibrations, SetFocus, SetSignals
from numpy.typing import NDArray

from dm_common.geometry import neighbour_pairs
from dm_common.hysteresis.observer import HysteresisObserver
from dm_common.limits import Limits
from dm_common.messages import applied_from, estimate_message, mirror_info_of
from dm_common.mirror import Mirror
from dm_common.optics.sampling import edge_clustered_points
from dm_common.optics.zernike import basis
from dm_common.ros import qos
from dm_common.ros.worker import WorkerService
from dm_tools.running_suite import NEEDED

RADIUS = 8e-3
#: Of goals, as action_msgs/GoalStatus has them.
EXECUTING, SUCCEEDED = 2, 4


class StandIn:
    """Driver, calibration and controller on one node.

    Args:
        node: publishes and serves.
        x, y: (N,) places of the actuators, m.
    """

    def __init__(self, node: Any, x: NDArray[np.float64], y: NDArray[np.float64]) -> None:
        self.node, self.signals = node, [0.0] * x.size
        self._state = node.create_publisher(ActuatorState, "actuator_state", qos.STATE)
        self._observer = HysteresisObserver()
        self._estimate = node.create_publisher(ActuatorEstimate, "actuator_estimate", qos.LATCHED)
        self._health = node.create_publisher(DiagnosticArray, "/diagnostics", qos.STATE)
        for message, topic in (
            (mirror_info(x, y), "mirror_info"),
            (calibration(x.size), "calibration"),
            (Capabilities(calibration_id="c19", curvature_min=-0.05, curvature_max=0.05), "capabilities"),
        ):
            publisher = node.create_publisher(type(message), topic, qos.LATCHED)
            publisher.publish(message)
        WorkerService(node, SetSignals, "set_signals", self._on_set_signals)
        WorkerService(node, ListCalibrations, "list_calibrations", lambda _request, response: response)
        WorkerService(node, SetFocus, "set_focus", self._on_set_focus)
        node.create_timer(0.2, self._publish)

    def _publish(self) -> None:
        now = self.node.get_clock().now().to_msg()
        state = ActuatorState(driver_state=ActuatorState.STATE_ACTIVE, history_known=True)
        state.header.stamp = now
        state.applied = state.requested = array("d", self.signals)
        state.volts, state.flags = array("d", [150.0] * len(self.signals)), bytes(len(self.signals))
        self._state.publish(state)
        self._observer.observe(applied_from(state))
        estimate = estimate_message(self._observer)
        estimate.calibration_id = "c19"
        self._estimate.publish(estimate)
        health = DiagnosticArray(status=[DiagnosticStatus(name=name, message="well") for name in NEEDED])
        health.header.stamp = now
        self._health.publish(health)

    def _on_set_signals(self, request: Any, response: Any) -> Any:
        self.signals = list(request.signals)
        self._publish()
        return response

    def _on_set_focus(self, request: Any, response: Any) -> Any:
        response.state = FocusState(curvature=request.request.curvature, predicted_rms=5e-9, history_known=True)
        return response


def mirror_info(x: NDArray[np.float64], y: NDArray[np.float64], radius: float = RADIUS) -> MirrorInfo:
    return mirror_info_of(Mirror("MIRROR", "7", x, y, radius, Limits(pairs=neighbour_pairs(x, y))))


def calibration(actuators: int, radius: float = RADIUS) -> Calibration:
    """Of random surfaces made of the 21 terms."""
    points = edge_clustered_points(300)
    influence = np.random.default_rng(5).normal(size=(21, actuators)) * 1e-7
    sag = basis(points.x, points.y) @ influence
    return Calibration(
        id="c19",
        actuators=actuators,
        aperture_radius=radius,
        quality=Capabilities.CALIBRATED,
        influence_zernike=array("d", influence.ravel()),
        zernike_offset=array("d", np.zeros(21)),
        sample_x=array("d", points.x),
        sample_y=array("d", points.y),
        sample_weight=array("d", points.weight),
        influence_sag=array("d", sag.ravel()),
        sag_offset=array("d", np.zeros(300)),
    )


class FakeNode:
    """Hands out the callbacks that a node would call."""

    def __init__(self) -> None:
        self.callbacks: dict[str, Any] = {}
        self.servers = ["first"]

    def create_subscription(self, _kind: Any, topic: str, callback: Any, _qos: Any) -> None:
        self.callbacks[topic] = callback

    def create_client(self, _kind: Any, _name: str) -> Any:
        return SimpleNamespace(call_async=lambda request: setattr(self, "asked", request))

    def get_publishers_info_by_topic(self, _topic: str) -> list[Any]:
        return [SimpleNamespace(endpoint_gid=name.encode()) for name in self.servers]


class Goal:
    """A goal with its messages."""

    def __init__(self, node: FakeNode, number: int) -> None:
        self.node, self.identity = node, SimpleNamespace(uuid=[number] * 16)

    def publish_status(self, status: int) -> None:
        entry = SimpleNamespace(goal_info=SimpleNamespace(goal_id=self.identity), status=status)
        self.node.callbacks["calibrate/_action/status"](SimpleNamespace(status_list=[entry]))

    def feed(self, step: int, residual: float) -> None:
        feedback = SimpleNamespace(step=step, residual_rms=residual)
        self.node.callbacks["calibrate/_action/feedback"](SimpleNamespace(goal_id=self.identity, feedback=feedback))
