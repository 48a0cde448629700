"""Node `autofocus`: turns images of a camera into focus requests; focus by object distance and by dioptre."""

import math
import sys
import time
from typing import Any

from dm_msgs.msg import AutofocusState, Capabilities, FocusRequest
from dm_msgs.srv import GetFocusRange, SetFocus, SetFocusDistance
from rclpy.clock import Clock, ClockType

from dm_autofocus.autofocus_action import AutofocusAction
from dm_autofocus.autofocus_parameters import PARAMETERS, check_changes, focus_optics, tolerance_of
from dm_autofocus.focus_probe import FocusProbe, SharpnessSample
from dm_autofocus.focus_stack_action import FocusStackAction
from dm_autofocus.images import exposure_fault
from dm_autofocus.optics import FocusOptics, dioptre_of, distance_of
from dm_autofocus.probe_action import ready_capabilities
from dm_autofocus.search.peak_search import Phase
from dm_autofocus.sharpness import check_region
from dm_common.errors import ErrorCode, Refusal
from dm_common.optics.conic import range_text
from dm_common.ros import qos
from dm_common.ros.clients import ServiceCallError, call
from dm_common.ros.executor import run_node
from dm_common.ros.lifecycle import OK, WARN, Health, ManagedNode
from dm_common.ros.worker import WorkerService
from dm_common.values import Fields, fill_with_nan, real

SET_FOCUS_DISTANCE = Fields(
    {"distance": real(0.0, 0.0, math.inf, "m", infinite=True), "dioptre": real(0.0, unit="1/m")}
)


class AutofocusNode(ManagedNode):
    """See docs/camera.md for the interfaces; optics, sharpness and search are in `dm_autofocus`."""

    def __init__(self, **keywords: Any) -> None:
        super().__init__("autofocus", PARAMETERS, check=check_changes, **keywords)
        self._optics: FocusOptics
        self._probe = FocusProbe(self, self._values)
        self._state = self.create_publisher(AutofocusState, "autofocus_state", qos.with_lease(qos.STATE))
        self._set_focus = self.create_client(SetFocus, "set_focus")
        for action in (AutofocusAction, FocusStackAction):
            action(self, self._probe, self._values, lambda: self._optics, self._publish)
        WorkerService(self, SetFocusDistance, "set_focus_distance", self._on_set_focus_distance, SET_FOCUS_DISTANCE)
        WorkerService(self, GetFocusRange, "get_focus_range", self._on_get_focus_range)
        self._watched: Any = None
        self._last_seen: tuple[Any, float] = None, 0.0  # in `health`: the newest image, and since when [s, steady]
        self._image_problem = ""
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(1.0, self._watch, clock=steady, autostart=False)

    def configure(self) -> None:
        self._optics = focus_optics(self._values)
        self._probe.subscribe()
        self._timer.cancel()
        self._image_problem, self._watched = "", None
        if rate := self._values["monitor_rate"]:
            self._timer.timer_period_ns = round(1e9 / rate)
            self._timer.reset()

    # --- focus by distance ---

    def _on_set_focus_distance(
        self, request: SetFocusDistance.Request, response: SetFocusDistance.Response
    ) -> SetFocusDistance.Response:
        fill_with_nan(response)  # until they are known
        if request.distance != 0 and request.dioptre != 0:
            raise Refusal(
                ErrorCode.INVALID_ARGUMENT,
                f"distance = {request.distance:g} m and dioptre = {request.dioptre:g} 1/m: give one of them",
            )
        if self._probe.user and not (request.take_over or request.dry_run):
            raise self._probe.busy()
        response.dioptre = dioptre_of(request.distance) or request.dioptre
        response.distance = distance_of(response.dioptre)
        response.curvature = self._optics.curvature_for(response.dioptre)
        response.power = 2 * response.curvature
        wanted = SetFocus.Request(dry_run=request.dry_run)
        wanted.request = FocusRequest(curvature=response.curvature, holder=request.holder, take_over=request.take_over)
        self._probe.controller.wait_for_return()
        lost_reason = self._probe.controller.since_now()
        try:
            answer = call(self._set_focus, wanted, self._values["move_timeout"], lost_reason)
        except ServiceCallError as error:
            raise Refusal(ErrorCode.TIMEOUT, lost_reason() or f"focus_controller: {error}") from error
        response.state = answer.state
        response.error_code, response.message = answer.error_code, answer.message
        able = self._probe.capabilities
        if answer.error_code == ErrorCode.UNREACHABLE and able is not None and able.error_code == ErrorCode.OK:
            response.message += f"; the camera focuses {self._range_text(able)}"
        return response

    def _on_get_focus_range(
        self, _request: GetFocusRange.Request, response: GetFocusRange.Response
    ) -> GetFocusRange.Response:
        capabilities = ready_capabilities(self._probe)
        response.curvature_min, response.curvature_max = capabilities.curvature_min, capabilities.curvature_max
        response.dioptre_min, response.dioptre_max = self._dioptres(capabilities)
        response.distance_far = distance_of(response.dioptre_min)
        response.distance_near = distance_of(response.dioptre_max) if response.dioptre_max > 0 else math.nan
        response.curvature_tolerance = tolerance_of(self._values, capabilities.aperture_radius)
        response.message = self._range_text(capabilities)
        return response

    def _dioptres(self, capabilities: Capabilities) -> tuple[float, float]:
        """Range of dioptres; its near end is inf if the focus reaches the reference point of object distances."""
        low, high = (self._optics.dioptre_for(c) for c in (capabilities.curvature_min, capabilities.curvature_max))
        return low, math.inf if math.isnan(high) else high

    def _range_text(self, capabilities: Capabilities) -> str:
        low, high = self._dioptres(capabilities)
        if high <= 0:
            return f"beyond infinity only ({range_text(low, high, 'dioptre')}): check optics.rest_distance"
        far = f"{1 / low:.2f} m" if low > 0 else "infinity"
        return f"from {1 / high:.2f} m to {far} ({range_text(low, high, 'dioptre')})"

    # --- state ---

    def _publish(self, phase: Phase, sample: SharpnessSample) -> None:
        curvature = self._probe.shape[0]
        state = AutofocusState(phase=int(phase), sharpness=sample.sharpness, curvature=curvature, power=2 * curvature)
        state.header = sample.image.header
        state.dioptre = self._optics.dioptre_for(curvature) if math.isfinite(curvature) else math.nan
        state.distance = distance_of(state.dioptre)
        self._state.publish(state)

    def _watch(self) -> None:
        """While idle, publish the sharpness of the newest image."""
        image = self._probe.newest
        if not self.active or self._probe.user or image is None or image is self._watched:
            return
        self._watched = image
        try:
            sample = self._probe.sharpness_of(image, check_region(self._values["region"]))
            self._publish(Phase.IDLE, sample)
            self._image_problem = exposure_fault(sample.regions[0])
        except (Refusal, ValueError) as error:
            self._image_problem = str(error)
            self.get_logger().warning(self._image_problem, throttle_duration_sec=5.0)

    def health(self) -> Health:
        values = {"images_counted": self._probe.counted, "images_dropped": self._probe.dropped}
        try:
            ready_capabilities(self._probe)
            if self._probe.newest is None:
                raise Refusal(ErrorCode.TIMEOUT, f"no image on {self._probe.topic} yet")
            (before, since), limit = self._last_seen, self._values["image_timeout"]
            if self._probe.newest is not before:
                self._last_seen = self._probe.newest, time.monotonic()
            elif time.monotonic() - since > limit:
                text = f"no image on {self._probe.topic} within image_timeout = {limit:g} s: is the camera running?"
                raise Refusal(ErrorCode.TIMEOUT, text)
            if problem := self._probe.several_cameras() or self._image_problem:
                raise Refusal(ErrorCode.INVALID_ARGUMENT, problem)
        except Refusal as error:
            return Health(WARN, str(error), values)
        return Health(OK, self._probe.user or "ready", values)


def main() -> int:
    """Entry point of the node."""
    return run_node(AutofocusNode, images=True)


if __name__ == "__main__":
    sys.exit(main())
