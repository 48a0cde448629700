"""Node `focus_controller`: curvature requests in, actuator commands out, with the prediction before the move."""

from __future__ import annotations

import sys
import threading
import time
from typing import Any

import numpy as np
from dm_msgs.msg import ActuatorCommand, ActuatorState, Calibration, Capabilities, FocusRequest, FocusState, MirrorInfo
from dm_msgs.srv import Flatten, SetFocus
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from dm_common.errors import ErrorCode, Refusal
from dm_common.messages import doubles, stamp_ns, time_message
from dm_common.ros import diagnostics, qos
from dm_common.ros.executor import run_node
from dm_common.ros.parameters import declare
from dm_common.ros.worker import never_silent
from dm_controller.capabilities import capabilities_message, settling_time
from dm_controller.conditioning import Conditioner, Waiting
from dm_controller.converge.converge_action import ConvergeAction
from dm_controller.converge.loop_bench import LoopBench
from dm_controller.converge.recipe_action import BuildRecipesAction
from dm_controller.creep_hold import SAME_SIGNAL, CreepHold
from dm_controller.decision import Decision, PlanningContext, condition_steps, decide
from dm_controller.driver_watch import DriverWatch
from dm_controller.focus_parameters import PARAMETERS
from dm_controller.focus_report import Outcome, fill_state, health, state_of
from dm_controller.hysteresis_observer import CURE, HysteresisObserver, same_model
from dm_controller.latency import Latency
from dm_controller.move_focus_action import MoveFocusAction
from dm_controller.planning.active_calibration import NO_CALIBRATION, ActiveCalibration, active_calibration
from dm_controller.planning.target import FocusTarget
from dm_controller.prediction import ForecastClient
from dm_controller.request_checks import check_age, check_reachable

#: Time after a command until `focus_state` tells of it, s. Whoever waits for the command wakes up meanwhile: it may
#: have to on this very core (measured: 0.2 ms sooner).
TELL_S = 1e-3
#: How often a held shape is looked after while no correction can be due sooner, s.
SELDOM_S = 1.0
#: How often it is looked whether the driver took the last command, s.
LOOK_S = 0.5


class FocusControllerNode(Node):
    """See README for the interfaces; the mathematics is in `dm_controller.planning`.

    Requests come from the executor and from the threads of move_focus and conditioning. They are judged and carried out
    one at a time, under `_turn`.
    """

    def __init__(self, **keywords: Any) -> None:
        super().__init__("focus_controller", **keywords)
        self._values = declare(self, PARAMETERS, on_change=lambda _changes: self._publish_capabilities())
        self._turn = threading.RLock()
        self._mirror_info: MirrorInfo | None = None
        self._calibration: Calibration | None = None
        self._use: ActiveCalibration | None = None
        self._not_calibrated = Refusal(ErrorCode.NOT_CALIBRATED, NO_CALIBRATION)
        self._driver = DriverWatch(self._values)
        self._asked: Any = ()  # signals of the last request's command; () = the last command answers none
        self._sent: Any = ()  # signals of the last command: those, or with creep corrected
        self._watch, self._hold, self._latency = HysteresisObserver(), CreepHold(self._values), Latency()
        self._told: tuple[object, ...] = ()  # what the last capabilities said of the driver
        self._counts = {"requests": 0, "refused": 0}

        self._command = self.create_publisher(ActuatorCommand, "actuator_command", qos.COMMAND)
        self._focus_state = self.create_publisher(FocusState, "focus_state", qos.STATE)
        self._capabilities = self.create_publisher(Capabilities, "capabilities", qos.LATCHED)
        self._conditioner = Conditioner(
            self, self._values, self._turn, self._carry_out_conditioned, self._refuse,
            lambda: self._watch.degausses, self._driver, lambda: self._publish_capabilities(),
        )  # fmt: skip
        self._move = MoveFocusAction(
            self, self._carry_out, self._conditioner.drop, self._standing, self._stop, self._driver, self._values
        )
        self._forecast = ForecastClient(self)
        bench = LoopBench(self, self._values)
        self._converge = ConvergeAction(self, self._values, bench, self._decide, self._known)
        self._recipes = BuildRecipesAction(
            self, self._values, bench, self._decide, self._known, lambda: self._watch.look(self._now()).state
        )
        self._untold: tuple[FocusRequest, Outcome] | None = None
        self._teller = self.create_timer(TELL_S, self._tell, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.create_subscription(MirrorInfo, "mirror_info", self._on_mirror_info, qos.LATCHED)
        self.create_subscription(Calibration, "calibration", self._on_calibration, qos.LATCHED)
        self.create_subscription(ActuatorState, "actuator_state", self._on_actuator_state, qos.STATE)
        self.create_subscription(FocusRequest, "focus_request", self._on_focus_request, qos.COMMAND)
        for kind, name, answer in ((SetFocus, "set_focus", self._on_set_focus), (Flatten, "flatten", self._on_flatten)):
            self.create_service(kind, name, never_silent(self, name, answer), qos_profile=qos.SERVICE)
        self._often = self.create_timer(self._values["hold.period"], self._look_after_shape)
        self.create_timer(SELDOM_S, self._look_after_shape)
        self.create_timer(LOOK_S, self._look_for_untaken, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._diagnostics = diagnostics.Diagnostics(self, "", self._health)
        self._publish_capabilities()

    def _now_ns(self) -> int:
        """ROS time; without a simulator it is the system's, which costs a tenth."""
        clock = self.get_clock()
        return int(clock.now().nanoseconds) if clock.ros_time_is_active else time.time_ns()

    def _now(self) -> float:
        """ROS time, s."""
        return 1e-9 * self._now_ns()

    def _known(self) -> tuple[Calibration | None, MirrorInfo | None]:
        return self._calibration, self._mirror_info

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
            self._tell()
            before = self._use
            try:
                use = active_calibration(self._calibration, self._mirror_info, self._values["aperture_tolerance"])
                # A new revision leaves the shape that stands as it is: so it can be held on.
                if before is None or before.calibration.id != use.calibration.id:
                    self._hold.end("another calibration is used")
                elif not same_model(before.loop.law, use.loop.law):
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
        if use is None or use.loop.hysteresis is not None:
            self._forecast.use("", None, (0.0, 0.0))
            return
        reachable = use.reachable_range(FocusTarget(0.0), self._values["reachable_tolerance"])
        self._forecast.use(use.calibration.id, use.mirror, reachable)

    def _on_actuator_state(self, message: ActuatorState) -> None:
        self._driver.observe(message)
        self._watch.observe(message)
        if message.driver_state != ActuatorState.STATE_ACTIVE:
            self._hold.end("the driver is not active")
        elif self._hold.active:
            self._hold.driver_requested(np.array(message.requested, dtype=np.float64), self._now())
        self._watch.prepare(self._use.loop if self._use is not None else None)
        learnt = self._latency.observe(message)
        if learnt or self._told != (message.driver_state, self._watch.unknown):
            self._publish_capabilities()

    # --- judging and carrying out requests ---

    def _decide(self, request: FocusRequest, conditioned: int | None = None, now_ns: int | None = None) -> Decision:
        """Judge a request, `conditioned` by a degauss of so many half-swings that has just ended. Raises Refusal."""
        if now_ns is None:
            now_ns = self._now_ns()
        if conditioned is None:
            check_age(stamp_ns(request.header.stamp), now_ns, self._values["request_age"])
        use = self._use
        if use is None:
            raise self._not_calibrated
        now, wait = 1e-9 * now_ns, 0.0
        if conditioned is None and self._conditioner.busy:
            conditioned, wait = self._conditioner.steps, self._conditioner.remaining(use.slew_rate, use.span)
        look = self._watch.look(now, use.slew_rate)
        situation = PlanningContext(use, look, now, conditioned, wait, self._degauss_time)
        return decide(request, situation, self._values)

    def _degauss_time(self, steps: int) -> float:
        return self._conditioner.duration(steps, self._use.slew_rate, self._use.span) if self._use is not None else 0.0

    def _check_free(self) -> None:
        self._driver.check()
        if self._converge.busy:
            raise Refusal(ErrorCode.BUSY, "a closed loop (action converge) is running; cancel it first")
        if self._recipes.busy:
            raise Refusal(ErrorCode.BUSY, "recipes are being built (action build_recipes); cancel it first")

    def _carry_out(self, request: FocusRequest, dry_run: bool = False) -> tuple[FocusState, Waiting | None]:
        """Judge a request and, unless it is a dry run or refused, send the command. Publishes the state.

        Where the mirror is conditioned first, the command follows later, and what waits for it is returned too.
        """
        with self._turn:
            outcome = self._attempt(request, dry_run)
            state = self._state_after(request, outcome)
            if not dry_run:
                self._focus_state.publish(state)
            return state, outcome.waiting

    def _carry_out_conditioned(self, request: FocusRequest, steps: int) -> FocusState:
        """Carry out a request that waited for a degauss of `steps` half-swings. Publishes the state."""
        state = self._state_after(request, self._attempt(request, conditioned=steps))
        self._focus_state.publish(state)
        return state

    def _attempt(self, request: FocusRequest, dry_run: bool = False, conditioned: int | None = None) -> Outcome:
        """Judge a request, and send its command or have the mirror conditioned for it. Nothing is published of it.

        The command goes out before anything is worked out that only the state tells.
        """
        if self._untold is not None:
            self._tell()
        if conditioned is None:
            self._counts["requests"] += 1
        decision = stamp = waiting = refused = None
        now_ns = self._now_ns()
        try:
            decision = self._decide(request, conditioned, now_ns)
            check_reachable(decision, self._values["reachable_tolerance"])
            if not dry_run:
                self._check_free()
                if conditioned is not None or (decision.condition is None and not self._conditioner.busy):
                    stamp = self._go(request, decision, now_ns)
                else:
                    waiting = self._condition(request, decision)
        except Refusal as refusal:
            refused = refusal
        return Outcome(decision, stamp, waiting, refused)

    def _state_after(self, request: FocusRequest, outcome: Outcome) -> FocusState:
        """What came of a request."""
        decision, refusal = outcome.decision, outcome.refusal
        state = state_of(request) if decision is None else self._state_of(request, decision, outcome.stamp)
        if outcome.waiting is not None and decision is not None:
            remark = f"the mirror is degaussed first; the shape stands in about {decision.duration:.1f} s"
            state.message = "; ".join(filter(None, (remark, state.message)))
        if refusal is not None:
            self._counts["refused"] += 1
            state.error_code, state.message = refusal.error_code, str(refusal)
            state.header.stamp = time_message(self._now_ns())
            self.get_logger().warning(f"refused: {refusal}", throttle_duration_sec=1.0)
        return state

    def _tell(self) -> None:
        """Publish the state that waits to be told, if there is one."""
        with self._turn:
            self._teller.cancel()
            untold, self._untold = self._untold, None
            if untold is not None:
                self._focus_state.publish(self._state_after(*untold))

    def _state_of(self, request: FocusRequest, decision: Decision, stamp: Any) -> FocusState:
        """What is told of a request that was judged; `stamp` of its command, None = there is none."""
        use = self._use
        assert use is not None
        state = state_of(request)
        self._use_forecast()
        forecast = self._forecast.forecast(decision.target.curvature, decision.move.plan.rms)
        fill_state(state, use.calibration.id, decision, forecast)
        state.creep_held = self._hold.would_keep(use.loop.law)
        state.message = self._remarks(use, decision.look.unknown)
        state.applied = stamp is not None
        state.header.stamp = stamp or time_message(self._now_ns())
        return state

    def _go(self, request: FocusRequest, decision: Decision, now_ns: int) -> Any:
        """Send the command of `decision`, made at `now_ns`, and hold its shape from now on; returns its stamp."""
        assert self._use is not None
        move = decision.move
        stamp = self._send(move.signals, request, now_ns)
        self._asked = move.signals
        now = 1e-9 * now_ns
        self._hold.begin(self._use.loop, move.effective, move.signals, now, decision.look.known)
        self._pace_looks(now)
        return stamp

    def _condition(self, request: FocusRequest, decision: Decision) -> Waiting:
        """Have the mirror degaussed before `request` is carried out."""
        self._conditioner.check_service()
        self._hold.end("the mirror is conditioned")
        return self._conditioner.submit(request, decision.condition or 0)

    def _refuse(self, request: FocusRequest, refusal: Refusal) -> FocusState:
        """Refuse a request that could not be attempted. Publishes the state."""
        state = self._state_after(request, Outcome(refusal=refusal))
        self._focus_state.publish(state)
        return state

    def _send(
        self, signals: Any, request: FocusRequest | None = None, now_ns: int | None = None, expected_turns: int = 0
    ) -> Any:
        command = ActuatorCommand(signals=doubles(signals), expected_turns=expected_turns)
        command.header.stamp = time_message(self._now_ns() if now_ns is None else now_ns)
        self._command.publish(command)
        self._latency.sent(command)
        self._driver.sent(command, request)
        self._sent = command.signals
        return command.header.stamp

    def _standing(self, signals: Any) -> Any:
        """What was last sent to keep the shape that was asked for by `signals` (N,); None = another was asked since."""
        with self._turn:
            ours = len(signals) == len(self._asked) and np.allclose(signals, self._asked, rtol=0.0, atol=SAME_SIGNAL)
            return self._sent if ours else None

    def _stop(self, signals: Any) -> bool:
        """Leave the move to `signals` (N,) where it is; False = another shape was asked for since, nothing is sent."""
        with self._turn:
            driver = self._driver.latest
            if self._standing(signals) is None:
                return False
            self._hold.end("the move was cancelled")
            self._asked = ()
            if driver is not None and len(driver.applied):
                self._send(driver.applied)
            return True

    def _look_for_untaken(self) -> None:
        """Tell of a command that the driver did not take: its request had been answered as carried out."""
        untaken = self._driver.untaken()
        if untaken is None:
            return
        with self._turn:
            request, refusal = untaken
            self._hold.end("the driver did not take the command")
            if request is not None:
                self._refuse(request, refusal)
            else:  # a correction, or the end of a move
                self.get_logger().warning(str(refusal))

    def _look_after_shape(self) -> None:
        with self._turn:
            now = self._now()
            self._correct_held_shape(now)
            self._pace_looks(now)

    def _pace_looks(self, now: float) -> None:
        """Look often only while a correction can be due soon."""
        if self._hold.next_look - now > SELDOM_S:
            self._often.cancel()
        elif self._often.is_canceled():
            self._often.reset()

    def _correct_held_shape(self, now: float) -> None:
        driver = self._driver.latest
        if not self._hold.active or driver is None or driver.moving:
            return
        if self._converge.busy or self._recipes.busy:
            self._hold.end("a closed loop is running")
            return
        signals = self._hold.correction(self._watch.look(now), now)
        if signals is not None:
            self._hold.sent(signals, now)
            self._send(signals, expected_turns=driver.turns)

    def _on_focus_request(self, request: FocusRequest) -> None:
        with self._turn:
            outcome = self._attempt(request)
            if outcome.stamp is None:
                self._focus_state.publish(self._state_after(request, outcome))
            else:
                self._untold = request, outcome
                self._teller.reset()

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
        message.header.stamp = time_message(self._now_ns())
        message.latency = self._latency.typical
        if self._mirror_info is not None:
            message.settling = settling_time(self._mirror_info)
        driver = self._driver.latest
        self._told = (driver.driver_state if driver is not None else None, unknown)
        self._capabilities.publish(message)

    def _remarks(self, use: ActiveCalibration, unknown: str) -> str:
        """What makes predictions worse than they could be, in words; "" = nothing."""
        history = f"the history of the actuators is not known ({unknown}): {CURE}" if unknown else ""
        return "; ".join(filter(None, (history if use.loop.hysteresis is not None else "", self._stale(use))))

    def _stale(self, use: ActiveCalibration) -> str:
        return use.stale(self._now_ns(), self._values["calibration_age_max"])

    def _health(self) -> diagnostics.Health:
        use, unknown = self._use, self._watch.unknown
        values: dict[str, object] = dict(self._counts)
        values |= {"history": unknown or "known", "held": self._hold.active, "corrections": self._hold.corrections}
        return health(self._not_calibrated if use is None else self._remarks(use, unknown), self._driver.check, values)


def main() -> int:
    """Entry point of the node."""
    return run_node(FocusControllerNode, sys.argv)


if __name__ == "__main__":
    sys.exit(main())
