"""Node `focus_controller`: curvature requests in, actuator commands out, with the prediction before the move."""

from __future__ import annotations

import sys
import threading
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

from dm_calibration.calibration_messages import stamp_ns
from dm_controller.capabilities import capabilities_message, settling_time
from dm_controller.conditioning import Conditioner, Waiting
from dm_controller.converge_action import ConvergeAction
from dm_controller.conversions import doubles
from dm_controller.decision import Decision, Situation, condition_steps, decide
from dm_controller.focus_parameters import PARAMETERS
from dm_controller.focus_report import fill_state, state_of
from dm_controller.hold import Hold
from dm_controller.latency import Latency
from dm_controller.memory_watch import CURE, MemoryWatch, same_law
from dm_controller.mirror_in_use import NO_CALIBRATION, MirrorInUse, mirror_in_use
from dm_controller.move_focus_action import MoveFocusAction
from dm_controller.prediction import ForecastClient
from dm_controller.refusal import Refusal
from dm_controller.request_checks import check_age, check_driver, check_reachable
from dm_controller.target import FocusTarget
from dm_runtime import diagnostics, qos
from dm_runtime.executor import run_node
from dm_runtime.parameters import declare


class FocusControllerNode(Node):
    """See README for the interfaces; the mathematics is in `dm_controller.model` and `dm_controller.open_loop`.

    Requests come from the executor and from the threads of move_focus and conditioning. They are judged and carried out
    one at a time, under `_turn`.
    """

    def __init__(self, **keywords: Any) -> None:
        super().__init__("focus_controller", **keywords)
        self._values = declare(self, PARAMETERS, on_change=lambda _changes: self._publish_capabilities())
        self._turn = threading.RLock()
        self._mirror_info: MirrorInfo | None = None
        self._calibration: Calibration | None = None
        self._use: MirrorInUse | None = None
        self._not_calibrated = Refusal(ErrorCode.NOT_CALIBRATED, NO_CALIBRATION)
        self._driver: ActuatorState | None = None
        self._watch, self._hold, self._latency = MemoryWatch(), Hold(self._values), Latency()
        self._told: tuple[object, ...] = ()  # what the last capabilities said of the driver
        self._counts = {"requests": 0, "refused": 0}

        self._command = self.create_publisher(ActuatorCommand, "actuator_command", qos.COMMAND)
        self._focus_state = self.create_publisher(FocusState, "focus_state", qos.STATE)
        self._capabilities = self.create_publisher(Capabilities, "capabilities", qos.LATCHED)
        self._conditioner = Conditioner(
            self, self._values, self._turn, self._carry_out_conditioned, self._refuse,
            lambda: self._watch.degausses, lambda: self._publish_capabilities(),
        )  # fmt: skip
        self._move = MoveFocusAction(
            self, self._carry_out, self._conditioner.drop, self._stop_at, lambda: self._driver, self._values
        )
        self._forecast = ForecastClient(self)
        self._converge = ConvergeAction(
            self, self._values, self._decide, lambda: (self._calibration, self._mirror_info),
            standing=lambda: self._watch.look(self._now()).state,
        )  # fmt: skip
        self.create_subscription(MirrorInfo, "mirror_info", self._on_mirror_info, qos.LATCHED)
        self.create_subscription(Calibration, "calibration", self._on_calibration, qos.LATCHED)
        self.create_subscription(ActuatorState, "actuator_state", self._on_actuator_state, qos.STATE)
        self.create_subscription(FocusRequest, "focus_request", self._on_focus_request, qos.COMMAND)
        self.create_service(SetFocus, "set_focus", self._on_set_focus)
        self.create_service(Flatten, "flatten", self._on_flatten)
        self.create_timer(self._values["hold.period"], self._correct_held_shape)
        self._diagnostics = diagnostics.Diagnostics(self, "", self._health)
        self._publish_capabilities()

    def _now_ns(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _now(self) -> float:
        """ROS time, s."""
        return 1e-9 * self._now_ns()

    # --- what the others say ---

    def _on_mirror_info(self, message: MirrorInfo) -> None:
        self._mirror_info = message
        self._diagnostics.hardware_id = message.serial
        self._take_calibration()

    def _on_calibration(self, message: Calibration) -> None:
        self._calibration = message
        self._take_calibration()

    def _take_calibration(self) -> None:
        """Use the calibration if it belongs to this mirror; else say why not, and refuse requests."""
        with self._turn:
            before = self._use
            try:
                use = mirror_in_use(self._calibration, self._mirror_info, self._values["aperture_tolerance"])
                # A new revision leaves the shape that stands as it is: so it can be held on.
                if before is None or before.calibration.id != use.calibration.id:
                    self._hold.end("another calibration is used")
                elif not same_law(before.loop.law, use.loop.law):
                    self._hold.end("the memory law changed")
                self.get_logger().info(f"using calibration {use.calibration.id} of {use.calibration.mirror_serial}")
                self._watch.use(use.loop.law, use.middle)
                self._use = use
            except Refusal as refusal:
                self._use, self._not_calibrated = None, refusal
                self._hold.end("there is no calibration to hold it with")
                if refusal.error_code in (ErrorCode.CALIBRATION_MISMATCH, ErrorCode.CALIBRATION_UNREADABLE):
                    self.get_logger().error(str(refusal))
        self._publish_capabilities()
        self._use_forecast()

    def _use_forecast(self) -> None:
        """Let the forecast fetch what it lacks for a calibration that does not know the memory itself."""
        use = self._use
        if use is None or use.loop.memory is not None:
            self._forecast.use("", None, (0.0, 0.0))
            return
        reachable = use.reachable_range(FocusTarget(0.0), self._values["reachable_tolerance"])
        self._forecast.use(use.calibration.id, use.mirror, reachable)

    def _on_actuator_state(self, message: ActuatorState) -> None:
        self._driver = message
        self._watch.observe(message)
        if message.driver_state != ActuatorState.STATE_ACTIVE:
            self._hold.end("the driver is not active")
        elif self._hold.active:
            self._hold.driver_requested(np.array(message.requested, dtype=np.float64), self._now())
        learnt = self._latency.observe(message)
        if learnt or self._told != (message.driver_state, self._watch.unknown):
            self._publish_capabilities()

    # --- judging and carrying out requests ---

    def _decide(self, request: FocusRequest, conditioned: int | None = None) -> Decision:
        """Judge a request, `conditioned` by a degauss of so many half-swings that has just ended. Raises Refusal."""
        if conditioned is None:
            check_age(stamp_ns(request.header.stamp), self._now_ns(), self._values["request_age"])
        use = self._use
        if use is None:
            raise self._not_calibrated
        now, wait = self._now(), 0.0
        if conditioned is None and self._conditioner.busy:
            conditioned, wait = self._conditioner.steps, self._conditioner.remaining(use.slew_rate, use.span)
        look = self._watch.look(now, use.slew_rate)
        situation = Situation(use, look, now, conditioned, wait, self._degauss_time)
        return decide(request, situation, self._values)

    def _degauss_time(self, steps: int) -> float:
        return self._conditioner.duration(steps, self._use.slew_rate, self._use.span) if self._use is not None else 0.0

    def _check_free(self) -> None:
        check_driver(self._driver)
        if self._converge.busy:
            raise Refusal(ErrorCode.BUSY, "a closed loop (action converge) is running; cancel it first")

    def _carry_out(self, request: FocusRequest, dry_run: bool = False) -> tuple[FocusState, Waiting | None]:
        """Judge a request and, unless it is a dry run or refused, send the command. Publishes the state.

        Where the mirror is conditioned first, the command follows later, and what waits for it is returned too.
        """
        with self._turn:
            self._counts["requests"] += 1
            state = state_of(request)
            waiting = None
            try:
                decision = self._judge(request, state)
                if not dry_run:
                    self._check_free()
                    if decision.condition is None and not self._conditioner.busy:
                        self._go(state, decision)
                    else:
                        waiting = self._condition(request, state, decision)
            except Refusal as refusal:
                return self._refuse(request, refusal, state, publish=not dry_run), None
            if not state.applied:
                state.header.stamp = self.get_clock().now().to_msg()
            if not dry_run:
                self._focus_state.publish(state)
            return state, waiting

    def _carry_out_conditioned(self, request: FocusRequest, steps: int) -> FocusState:
        """Carry out a request that waited for a degauss of `steps` half-swings. Publishes the state."""
        state = state_of(request)
        try:
            decision = self._judge(request, state, steps)
            self._check_free()
            self._go(state, decision)
        except Refusal as refusal:
            return self._refuse(request, refusal, state)
        self._focus_state.publish(state)
        return state

    def _judge(self, request: FocusRequest, state: FocusState, conditioned: int | None = None) -> Decision:
        decision = self._decide(request, conditioned)
        use = self._use
        assert use is not None
        self._use_forecast()
        forecast = self._forecast.forecast(decision.target.curvature, decision.move.plan.rms)
        fill_state(state, use.calibration.id, decision, forecast)
        state.creep_held = self._hold.would_keep(use.loop.law)
        state.message = self._remarks(use, decision.look.unknown)
        check_reachable(decision, self._values["reachable_tolerance"])
        return decision

    def _go(self, state: FocusState, decision: Decision) -> None:
        """Send the command of `decision` and hold its shape from now on."""
        assert self._use is not None
        signals = decision.move.plan.signals
        state.header.stamp = self._send(signals)
        state.applied = True
        self._hold.begin(self._use.loop, decision.move.effective, signals, self._now(), decision.look.known)

    def _condition(self, request: FocusRequest, state: FocusState, decision: Decision) -> Waiting:
        """Have the mirror degaussed before `request` is carried out."""
        self._conditioner.check_service()
        self._hold.end("the mirror is conditioned")
        remark = f"the mirror is degaussed first; the shape stands in about {decision.duration:.1f} s"
        state.message = "; ".join(filter(None, (remark, state.message)))
        return self._conditioner.submit(request, decision.condition or 0)

    def _refuse(
        self, request: FocusRequest, refusal: Refusal, state: FocusState | None = None, publish: bool = True
    ) -> FocusState:
        state = state or state_of(request)
        self._counts["refused"] += 1
        state.error_code, state.message = refusal.error_code, str(refusal)
        state.header.stamp = self.get_clock().now().to_msg()
        self.get_logger().warning(f"refused: {refusal}", throttle_duration_sec=1.0)
        if publish:
            self._focus_state.publish(state)
        return state

    def _send(self, signals: Any) -> Any:
        command = ActuatorCommand(signals=doubles(signals))
        command.header.stamp = self.get_clock().now().to_msg()
        self._command.publish(command)
        self._latency.sent(command)
        return command.header.stamp

    def _stop_at(self, signals: Any) -> None:
        """Leave the move under way at `signals` (N,)."""
        with self._turn:
            self._hold.end("the move was cancelled")
            self._send(signals)

    def _correct_held_shape(self) -> None:
        with self._turn:
            driver = self._driver
            if not self._hold.active or driver is None or driver.moving:
                return
            if self._converge.busy:
                self._hold.end("a closed loop is running")
                return
            now = self._now()
            signals = self._hold.correction(self._watch.look(now), now)
            if signals is not None:
                self._hold.sent(signals, now)
                self._send(signals)

    def _on_focus_request(self, request: FocusRequest) -> None:
        self._carry_out(request)

    def _on_set_focus(self, request: SetFocus.Request, response: SetFocus.Response) -> SetFocus.Response:
        response.state, _ = self._carry_out(request.request, request.dry_run)
        response.error_code, response.message = response.state.error_code, response.state.message
        return response

    def _on_flatten(self, request: Flatten.Request, response: Flatten.Response) -> Flatten.Response:
        response.state, _ = self._carry_out(FocusRequest(), request.dry_run)
        response.error_code, response.message = response.state.error_code, response.state.message
        return response

    # --- what this node says of itself ---

    def _publish_capabilities(self) -> None:
        use, unknown, tolerance = self._use, self._watch.unknown, self._values["reachable_tolerance"]
        if use is None:
            message = Capabilities(quality=Capabilities.UNCALIBRATED, residual_tolerance=tolerance)
            message.message = str(self._not_calibrated)
        else:
            steps = condition_steps(use, self._values["condition.degauss_steps"])
            message = capabilities_message(use, tolerance, unknown, self._stale(use), self._degauss_time(steps))
        message.header.stamp = self.get_clock().now().to_msg()
        message.latency = self._latency.typical
        if self._mirror_info is not None:
            message.settling = settling_time(self._mirror_info)
        self._told = (self._driver.driver_state if self._driver is not None else None, unknown)
        self._capabilities.publish(message)

    def _remarks(self, use: MirrorInUse, unknown: str) -> str:
        """What makes predictions worse than they could be, in words; "" = nothing."""
        history = f"the history of the actuators is not known ({unknown}): {CURE}" if unknown else ""
        return "; ".join(filter(None, (history if use.loop.memory is not None else "", self._stale(use))))

    def _stale(self, use: MirrorInUse) -> str:
        return use.stale(self._now_ns(), self._values["calibration_age_max"])

    def _health(self) -> diagnostics.Health:
        use, unknown = self._use, self._watch.unknown
        values: dict[str, object] = dict(self._counts)
        values |= {"history": unknown or "known", "held": self._hold.active, "corrections": self._hold.corrections}
        try:
            if use is None:
                raise self._not_calibrated
            check_driver(self._driver)
        except Refusal as refusal:
            return diagnostics.Health(diagnostics.WARN, str(refusal), values)
        warnings = self._remarks(use, unknown)
        if warnings:
            return diagnostics.Health(diagnostics.WARN, warnings, values)
        return diagnostics.Health(diagnostics.OK, "ready", values)


def main() -> int:
    """Entry point of the node."""
    return run_node(FocusControllerNode, sys.argv)


if __name__ == "__main__":
    sys.exit(main())
