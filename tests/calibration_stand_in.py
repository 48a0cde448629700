"""Driver and interferometer as the nodes above them meet them, with a linear mirror behind."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable
from typing import Any

import numpy as np
from dm_msgs.action import Degauss
from dm_msgs.msg import ActuatorState, ErrorCode, MirrorInfo, SurfaceMapInfo, SurfaceSamples, ZernikeCoefficients
from dm_msgs.srv import HoldMirror, Measure, SetSignals

from dm_common.errors import Refusal
from dm_common.messages import mirror_info_of
from dm_common.mirror import Mirror
from dm_common.ros import qos
from dm_common.ros.worker import WorkerActionServer, WorkerService
from dm_driver.commands.mirror_hold import MirrorHold
from linear_mirror import RADIUS, LinearMirror


def doubles(values: np.ndarray) -> array[float]:
    return array("d", np.ascontiguousarray(values, dtype=np.float64).tobytes())


class StandIn:
    """Driver and interferometer on the observer's node."""

    def __init__(self, node: Any, mirror: Mirror, plant: LinearMirror) -> None:
        self.node, self.mirror, self.plant = node, mirror, plant
        self.signals = mirror.rest
        self.degaussed = 0
        self.degauss_steps: list[int] = []  # as asked for
        self.measured: list[str] = []
        self.failures = 0  # maps that still fail
        self.pause = 0.0  # s that a map takes
        self.failing: set[str] = set()
        self.other_wavelength: set[str] = set()
        self.other_aperture: set[str] = set()
        self.disturbed_at = ""
        self.on_label: dict[str, Callable[[], object]] = {}  # called as a map of the label is asked for
        self.on_degauss_done: Callable[[], object] | None = None
        self.other: dict[str, Any] = {}  # what the maps say of aperture and instrument, where not as usual
        self.bump: dict[str, float] = {}  # tilt (m), shift_px, figure (m) of a mirror that was bumped
        self.driver_state, self.history_known = ActuatorState.STATE_ACTIVE, True
        self.hold = MirrorHold(time.monotonic)
        self.turns, self.turned_at, self.written = 0, mirror.rest, node.get_clock().now()
        self.info = node.create_publisher(MirrorInfo, "mirror_info", qos.LATCHED)
        self.state = node.create_publisher(ActuatorState, "actuator_state", qos.STATE)
        self.zernike = node.create_publisher(ZernikeCoefficients, "zernike", qos.STATE)
        self.samples = node.create_publisher(SurfaceSamples, "surface_samples", qos.STATE)
        self.map_info = node.create_publisher(SurfaceMapInfo, "surface_map_info", qos.with_lease(qos.STATE))
        node.create_timer(0.1, self.publish_state)  # a driver reports in any case
        WorkerService(node, SetSignals, "set_signals", self.on_set_signals)
        WorkerActionServer(node, Degauss, "degauss", lambda handle: self.on_degauss(handle.request.steps))
        WorkerService(node, HoldMirror, "hold_mirror", self.on_hold_mirror)
        WorkerService(node, Measure, "measure", self.on_measure)
        self.publish_info(mirror)
        self.publish_state()

    def publish_info(self, mirror: Mirror) -> None:
        message = mirror_info_of(mirror)
        message.header.frame_id = "mirror"
        self.info.publish(message)

    def publish_state(self, driver_state: int | None = None) -> None:
        """Report, as from now on in `driver_state`."""
        self.driver_state = self.driver_state if driver_state is None else driver_state
        message = ActuatorState(driver_state=self.driver_state, history_known=self.history_known)
        message.requested = message.applied = doubles(self.signals)
        message.holder, message.holding = self.hold.holder, self.hold.sentence
        message.header.stamp = self.written.to_msg()
        message.turns, message.degausses, message.turned_at = self.turns, self.degaussed, doubles(self.turned_at)
        self.state.publish(message)

    def move(self, signals: np.ndarray) -> None:
        self.turns, self.turned_at = self.turns + 1, self.signals
        self.signals, self.written = np.array(signals), self.node.get_clock().now()
        self.publish_state()

    def on_hold_mirror(self, request: Any, response: Any) -> Any:
        try:
            self.hold.handle(request.operation, request.holder, request.purpose, request.duration, request.lease)
        except Refusal as refusal:
            response.error_code, response.message = refusal.error_code, str(refusal)
        response.holder = self.hold.holder
        self.publish_state()
        return response

    def on_set_signals(self, request: Any, response: Any) -> Any:
        if self.driver_state == ActuatorState.STATE_INACTIVE:
            response.error_code, response.message = ErrorCode.DRIVER_INACTIVE, "pdm_driver is not active"
            return response
        self.move(np.array(request.signals))
        response.applied = doubles(self.signals)
        return response

    def on_degauss(self, steps: int) -> tuple[str, Any]:
        self.degauss_steps.append(steps)
        self.degaussed += 1
        self.history_known = True
        self.move(self.mirror.rest)
        if self.on_degauss_done is not None:
            self.on_degauss_done()
        return "succeed", Degauss.Result()

    def on_measure(self, request: Any, response: Any) -> Any:
        time.sleep(self.pause)
        if self.failures:
            self.failures -= 1
            return self.no_map(response)
        self.measured.append(request.label)
        if request.label in self.on_label:
            self.on_label[request.label]()
        if request.label == self.disturbed_at:
            self.move(np.full(self.mirror.actuators, 0.3))
        if request.label in self.failing:
            return self.no_map(response)
        response = self.map(response)
        if request.label in self.other_aperture:
            response.zernike.radius = 10e-3
        if request.label in self.other_wavelength:
            response.zernike.wavelength = 635e-9
        self.fill_instrument(response)
        response.info.file, response.info.sha256 = f"/maps/{request.label}.dat", "00"
        return response

    def no_map(self, response: Any) -> Any:
        response.error_code, response.message = ErrorCode.MAP_TIMEOUT, "no new file within 5 s"
        return response

    def fill_instrument(self, response: Any) -> None:
        """What the file would say of the instrument, and what a bump does to it."""
        info, zernike = response.info, response.zernike
        info.instrument, info.pitch, info.width, info.height = "Verifire, serial 1", 25e-6, 944, 944
        info.centre_x = info.centre_y = 471.5
        info.centre_x += self.bump.get("shift_px", 0.0)
        info.aperture_radius_px = RADIUS / info.pitch
        for name, value in self.other.items():
            target = zernike if name in ("wavelength", "radius") else info
            setattr(target, name, value)
        zernike.coefficients[1] += self.bump.get("tilt", 0.0)
        zernike.coefficients[4] += self.bump.get("figure", 0.0)

    def map(self, response: Any = None, bump: float = 0.0) -> Any:
        """A map of what stands at the mirror; `bump` (m) is astigmatism that the mirror does not have."""
        response = response if response is not None else Measure.Response()
        sag = self.plant.sag(self.signals) + bump * self.plant.modes[:, 4]
        zernike, samples = response.zernike, response.samples
        response.info.header.stamp = zernike.header.stamp = samples.header.stamp = self.node.get_clock().now().to_msg()
        zernike.radius = RADIUS
        zernike.wavelength = 632.8e-9
        zernike.coefficients = doubles(self.plant.fit_terms(sag))
        zernike.residual_rms, response.info.valid_fraction = 3e-9, 0.97
        samples.x, samples.y = doubles(self.plant.points.x), doubles(self.plant.points.y)
        samples.weight, samples.sag = doubles(self.plant.points.weight), doubles(sag)
        return response

    def publish_map(self, message: Any) -> None:
        """As the interferometer does after each map."""
        self.zernike.publish(message.zernike)
        self.samples.publish(message.samples)
        self.map_info.publish(message.info)
