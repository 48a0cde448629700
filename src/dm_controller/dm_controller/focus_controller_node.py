"""Node `focus_controller`: curvature requests in, actuator commands out, with the prediction before the move."""

from __future__ import annotations

import array
import math
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
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
from rclpy.node import Node
from rclpy.time import Time

from dm_controller.converge_action import CONVERGE_PARAMETERS, ConvergeAction
from dm_controller.conversions import doubles, limits_of, model_of, target_of
from dm_controller.model import CalibratedMirror, Plan
from dm_controller.move_focus_action import MoveFocusAction
from dm_controller.prediction import ForecastClient
from dm_controller.target import FocusTarget, TargetError
from dm_runtime import diagnostics, qos
from dm_runtime.executor import run_node
from dm_runtime.parameters import Parameter, declare

PARAMETERS = (
    Parameter(
        "reachable_tolerance",
        float,
        2e-8,
        "largest predicted Zernike coefficient error at which a curvature still counts as reachable",
        "m",
        1e-10,
        1e-5,
        live=True,
    ),
    Parameter("request_age", float, 1.0, "focus requests with an older stamp are refused; 0 = never", "s", 0.0, 3600.0),
    Parameter("settle_time", float, 0.05, "wait after the last write before a MoveFocus goal succeeds", "s", 0.0, 60.0),
    Parameter("move_timeout", float, 10.0, "longest time a move may take", "s", 0.1, 600.0),
    Parameter(
        "aperture_tolerance",
        float,
        0.01,
        "allowed relative difference of calibrated and working aperture",
        "",
        0.0,
        0.5,
    ),
    *CONVERGE_PARAMETERS,
)


class Refusal(Exception):
    """A request that is not carried out: an ErrorCode and a sentence."""

    def __init__(self, error_code: int, message: str) -> None:
        super().__init__(message)
        self.error_code = error_code


@dataclass(frozen=True)
class Decision:
    """A request that was judged: its target, the plan and the reachable range."""

    target: FocusTarget
    plan: Plan
    reachable: tuple[float, float]
    mode: int


class FocusControllerNode(Node):
    """See README for the interfaces; the mathematics is in `dm_controller.model`."""

    def __init__(self, **keywords: Any) -> None:
        super().__init__("focus_controller", **keywords)
        self._values = declare(self, PARAMETERS, on_change=lambda _changes: self._publish_capabilities())
        self._mirror_info: MirrorInfo | None = None
        self._calibration: Calibration | None = None
        self._calibrated: CalibratedMirror | None = None
        self._not_calibrated = (ErrorCode.NOT_CALIBRATED, "no calibration: run `./dm calibrate` or load_calibration")
        self._driver: ActuatorState | None = None
        self._counts = {"requests": 0, "refused": 0}

        self._command = self.create_publisher(ActuatorCommand, "actuator_command", qos.COMMAND)
        self._focus_state = self.create_publisher(FocusState, "focus_state", qos.STATE)
        self._capabilities = self.create_publisher(Capabilities, "capabilities", qos.LATCHED)
        self.create_subscription(MirrorInfo, "mirror_info", self._on_mirror_info, qos.LATCHED)
        self.create_subscription(Calibration, "calibration", self._on_calibration, qos.LATCHED)
        self.create_subscription(ActuatorState, "actuator_state", self._on_actuator_state, qos.STATE)
        self.create_subscription(FocusRequest, "focus_request", self._on_focus_request, qos.COMMAND)
        self.create_service(SetFocus, "set_focus", self._on_set_focus)
        self.create_service(Flatten, "flatten", self._on_flatten)
        self._move = MoveFocusAction(self, self._carry_out, self._send, lambda: self._driver, self._values)
        self._forecast = ForecastClient(self)
        self._converge = ConvergeAction(
            self, self._values, self._decide, lambda: (self._calibration, self._mirror_info)
        )
        self._diagnostics = diagnostics.Diagnostics(self, "", self._health)
        self._publish_capabilities()

    # --- what the others say ---

    def _on_mirror_info(self, message: MirrorInfo) -> None:
        self._mirror_info = message
        self._diagnostics.hardware_id = message.serial
        self._take_calibration()

    def _on_calibration(self, message: Calibration) -> None:
        self._calibration = message
        self._take_calibration()

    def _on_actuator_state(self, message: ActuatorState) -> None:
        changed = self._driver is None or self._driver.driver_state != message.driver_state
        self._driver = message
        if changed:
            self._publish_capabilities()

    def _take_calibration(self) -> None:
        """Use the calibration if it belongs to this mirror; else say why not, and refuse requests."""
        calibration, mirror = self._calibration, self._mirror_info
        self._calibrated = None
        if calibration is None or not calibration.id:
            self._not_calibrated = (
                ErrorCode.NOT_CALIBRATED,
                "no calibration: run `./dm calibrate` or load_calibration",
            )
        elif mirror is None:
            self._not_calibrated = (
                ErrorCode.DRIVER_UNAVAILABLE,
                "the mirror's limits are unknown: no mirror_info from pdm_driver yet",
            )
        elif (reason := self._mismatch(calibration, mirror)) is not None:
            self._not_calibrated = (ErrorCode.CALIBRATION_MISMATCH, f"calibration {calibration.id}: {reason}")
            self.get_logger().error(self._not_calibrated[1])
        else:
            try:
                self._calibrated = CalibratedMirror(model_of(calibration), limits_of(mirror))
                self.get_logger().info(f"using calibration {calibration.id} of mirror {calibration.mirror_serial}")
            except ValueError as error:
                self._not_calibrated = (ErrorCode.CALIBRATION_UNREADABLE, str(error))
                self.get_logger().error(str(error))
        self._publish_capabilities()
        self._use_forecast()

    def _use_forecast(self) -> None:
        """Let the forecast fetch what it lacks for the calibration in use."""
        if self._calibrated is None or self._calibration is None:
            self._forecast.use("", None, (0.0, 0.0))
            return
        reachable = self._calibrated.reachable_range(FocusTarget(0.0), self._values["reachable_tolerance"])
        self._forecast.use(self._calibration.id, self._calibrated, reachable)

    def _mismatch(self, calibration: Calibration, mirror: MirrorInfo) -> str | None:
        if calibration.mirror_serial != mirror.serial:
            return f"is of mirror serial {calibration.mirror_serial!r}, this one is {mirror.serial!r}"
        if calibration.actuators != mirror.actuators:
            return f"has {calibration.actuators} actuators, this mirror {mirror.actuators}"
        working = mirror.working_aperture_diameter / 2
        if abs(calibration.aperture_radius - working) > self._values["aperture_tolerance"] * working:
            return (
                f"was made over an aperture of radius {calibration.aperture_radius * 1e3:.3f} mm, "
                f"the working aperture's is {working * 1e3:.3f} mm"
            )
        return None

    # --- judging and carrying out requests ---

    def _decide(self, request: FocusRequest) -> Decision:
        """Judge a request: everything that can be known before anything moves. Raises Refusal."""
        self._check_age(request)
        if request.mode == FocusRequest.MODE_CONDITIONED:
            raise Refusal(
                ErrorCode.NOT_SUPPORTED, "mode CONDITIONED: this calibration holds no recipes; use AUTO or DIRECT"
            )
        if request.mode not in (FocusRequest.MODE_AUTO, FocusRequest.MODE_DIRECT):
            raise Refusal(
                ErrorCode.INVALID_ARGUMENT, f"mode = {request.mode}: must be AUTO (0), DIRECT (1) or CONDITIONED (2)"
            )
        if self._calibrated is None:
            raise Refusal(*self._not_calibrated)
        try:
            target = target_of(request)
            plan = self._calibrated.plan(target)
        except TargetError as error:
            raise Refusal(ErrorCode.INVALID_ARGUMENT, str(error)) from error
        tolerance = self._values["reachable_tolerance"]
        reachable = self._calibrated.reachable_range(target, tolerance)
        return Decision(target, plan, reachable, FocusRequest.MODE_DIRECT)

    def _check_age(self, request: FocusRequest) -> None:
        limit = self._values["request_age"]
        stamp = Time.from_msg(request.header.stamp, clock_type=self.get_clock().clock_type)
        if limit == 0.0 or stamp.nanoseconds == 0:
            return
        age = (self.get_clock().now() - stamp).nanoseconds * 1e-9
        if not -limit <= age <= limit:
            raise Refusal(ErrorCode.STALE, f"header.stamp: the request is {age:.3f} s old; allowed: {limit:g} s")

    def _check_reachable(self, decision: Decision) -> None:
        low, high = decision.reachable
        tolerance = self._values["reachable_tolerance"]
        if decision.plan.max_zernike <= tolerance:
            return
        if math.isnan(low):
            words = "no curvature is reachable with these added Zernike terms"
        else:
            words = f"reachable: {low:+.4f} to {high:+.4f} 1/m ({2 * low:+.3f} to {2 * high:+.3f} dioptre)"
        raise Refusal(
            ErrorCode.UNREACHABLE,
            f"curvature = {decision.target.curvature:+.4f} 1/m: the limits of the actuators leave a coefficient error "
            f"of {decision.plan.max_zernike * 1e9:.1f} nm (allowed {tolerance * 1e9:.1f} nm); {words}",
        )

    def _check_driver(self) -> None:
        if self._driver is None:
            raise Refusal(ErrorCode.DRIVER_UNAVAILABLE, "no actuator_state from pdm_driver yet: is the driver running?")
        if self._driver.driver_state != ActuatorState.STATE_ACTIVE:
            reason = f": {self._driver.message}" if self._driver.message else ""
            raise Refusal(ErrorCode.DRIVER_INACTIVE, f"pdm_driver is not active{reason}")

    def _carry_out(self, request: FocusRequest, dry_run: bool = False) -> FocusState:
        """Judge a request and, unless it is a dry run or refused, send the command. Publishes the state."""
        self._counts["requests"] += 1
        decision: Decision | None = None
        state = FocusState(curvature=request.curvature, power=2 * request.curvature)
        state.conic_constant = request.conic_constant
        state.mode = request.mode
        try:
            decision = self._decide(request)
            self._fill(state, decision)
            self._check_reachable(decision)
            if not dry_run:
                self._check_driver()
                if self._converge.busy:
                    raise Refusal(ErrorCode.BUSY, "a closed loop (action converge) is running; cancel it first")
                state.header.stamp = self._send(decision.plan.signals)
                state.applied = True
        except Refusal as refusal:
            self._counts["refused"] += 1
            state.error_code, state.message = refusal.error_code, str(refusal)
            self.get_logger().warning(f"refused: {refusal}", throttle_duration_sec=1.0)
        if not state.applied:
            state.header.stamp = self.get_clock().now().to_msg()
        if not dry_run:
            self._focus_state.publish(state)
        return state

    def _fill(self, state: FocusState, decision: Decision) -> None:
        plan = decision.plan
        state.calibration_id = self._calibration.id if self._calibration is not None else ""
        state.signals = doubles(plan.signals)
        state.predicted_rms = plan.rms
        state.predicted_rms_upper = plan.rms_upper
        self._use_forecast()
        forecast = self._forecast.forecast(decision.target.curvature, plan.rms)
        if forecast is not None:  # it knows of the actuators' memory, the influence function does not
            state.predicted_rms_upper = max(state.predicted_rms_upper, forecast.upper)
        state.predicted_max_zernike = plan.max_zernike
        state.predicted_max_zernike_upper = plan.max_zernike_upper
        state.saturated = bool(plan.saturated.any())
        state.saturated_actuators = array.array("I", (np.flatnonzero(plan.saturated) + 1).astype("uint32").tobytes())
        state.curvature_min, state.curvature_max = decision.reachable
        state.history_known = self._driver is not None and self._driver.history_known
        state.mode = decision.mode

    def _send(self, signals: Any) -> Any:
        command = ActuatorCommand(signals=doubles(signals))
        command.header.stamp = self.get_clock().now().to_msg()
        self._command.publish(command)
        return command.header.stamp

    def _on_focus_request(self, request: FocusRequest) -> None:
        self._carry_out(request)

    def _on_set_focus(self, request: SetFocus.Request, response: SetFocus.Response) -> SetFocus.Response:
        response.state = self._carry_out(request.request, request.dry_run)
        response.error_code, response.message = response.state.error_code, response.state.message
        return response

    def _on_flatten(self, request: Flatten.Request, response: Flatten.Response) -> Flatten.Response:
        response.state = self._carry_out(FocusRequest(), request.dry_run)
        response.error_code, response.message = response.state.error_code, response.state.message
        return response

    # --- what this node says of itself ---

    def _publish_capabilities(self) -> None:
        message = Capabilities(quality=Capabilities.UNCALIBRATED)
        message.header.stamp = self.get_clock().now().to_msg()
        message.residual_tolerance = self._values["reachable_tolerance"]
        if self._calibrated is None or self._calibration is None:
            message.message = self._not_calibrated[1]
        else:
            calibration = self._calibration
            low, high = self._calibrated.reachable_range(FocusTarget(0.0), message.residual_tolerance)
            message.calibration_id = calibration.id
            message.quality = calibration.quality
            message.curvature_min, message.curvature_max = low, high
            message.power_min, message.power_max = 2 * low, 2 * high
            message.aperture_radius = calibration.aperture_radius
            message.error_bound = calibration.held_out_max_zernike
            message.message = f"{low:+.4f} to {high:+.4f} 1/m ({2 * low:+.3f} to {2 * high:+.3f} dioptre)"
        if self._mirror_info is not None:
            span = self._mirror_info.signal_max - self._mirror_info.signal_min
            message.settling = span / self._mirror_info.slew_rate_max if self._mirror_info.slew_rate_max > 0 else 0.0
        self._capabilities.publish(message)

    def _health(self) -> diagnostics.Health:
        values = dict(self._counts)
        try:
            if self._calibrated is None:
                raise Refusal(*self._not_calibrated)
            self._check_driver()
        except Refusal as refusal:
            return diagnostics.Health(diagnostics.WARN, str(refusal), values)
        return diagnostics.Health(diagnostics.OK, "ready", values)


def main() -> int:
    """Entry point of the node."""
    return run_node(FocusControllerNode, sys.argv)


if __name__ == "__main__":
    sys.exit(main())
