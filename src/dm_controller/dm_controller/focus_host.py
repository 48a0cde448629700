"""The focus controller behind its node: used by one thread at a time, its effects carried out as they come."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Mapping
from typing import Any

from dm_msgs.msg import ActuatorCommand, ActuatorState, Calibration, Capabilities, FocusRequest, FocusState, MirrorInfo
from dm_msgs.srv import Degauss
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from dm_common.errors import ErrorCode, Refusal
from dm_common.hysteresis.model import HysteresisState
from dm_common.ros import diagnostics, qos
from dm_common.ros.worker import answers_arrive
from dm_controller.focus_controller import SLOW_PERIOD_S, FocusController
from dm_controller.focus_messages import (
    capabilities_message,
    command_message,
    driver_report_from,
    request_from,
    state_message,
    trouble,
)
from dm_controller.focus_types import (
    Effect,
    Moment,
    Order,
    Outcome,
    Progress,
    PublishCapabilities,
    PublishState,
    SendCommand,
    StartDegauss,
)
from dm_controller.forecast import ForecastClient
from dm_controller.planning.active_calibration import ActiveCalibration
from dm_controller.planning.target import FocusTarget

#: How often silence of the driver is noticed, s of wall time.
STEADY_PERIOD_S = 0.5


class FocusHost:
    """Serves subscriptions and timers in the executor, and the actions in threads of their own.

    Args:
        node: hosts publishers and clients.
        values: its parameters.
    """

    def __init__(self, node: Node, values: Mapping[str, Any]) -> None:
        self._node, self._values = node, values
        self._lock = threading.Lock()
        self._controller = FocusController(values)
        self._mirror: MirrorInfo | None = None
        self._command = node.create_publisher(ActuatorCommand, "actuator_command", qos.COMMAND)
        self._focus_state = node.create_publisher(FocusState, "focus_state", qos.STATE)
        self._capabilities = node.create_publisher(Capabilities, "capabilities", qos.LATCHED)
        self._degauss = node.create_client(Degauss, "degauss")
        self._to_degauss: StartDegauss | None = None
        self._awaited: Any = None
        self._forecast = ForecastClient(node)
        self._quick = node.create_timer(values["hold.period"], self._tick)
        node.create_timer(SLOW_PERIOD_S, self._tick)
        node.create_timer(STEADY_PERIOD_S, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _now(self) -> Moment:
        clock = self._node.get_clock()  # without a simulator its time is the system's, which costs a tenth
        ns = int(clock.now().nanoseconds) if clock.ros_time_is_active else time.time_ns()
        return Moment(ns, time.monotonic())

    # --- what comes in ---

    def use(self, calibration: Calibration | None, mirror: MirrorInfo | None) -> None:
        """Use a calibration of a mirror, if they belong together."""
        with self._lock:
            self._mirror = mirror
            self._do(self._controller.use(calibration, mirror))
            self._forecast.use(self._controller.active, self._values["reachable_tolerance"])

    def driver_report(self, message: ActuatorState) -> None:
        """Take the driver's next report."""
        report = driver_report_from(message)
        with self._lock:
            self._do(self._controller.driver_report(report, self._now()))

    def _tick(self) -> None:
        with self._lock:
            now = self._now()
            self._controller.degauss_offered = self._degauss.service_is_ready()
            if answers_arrive(self._degauss, self._degauss.service_is_ready) and self._to_degauss is not None:
                self._start_degauss(self._to_degauss)
            self._do(self._controller.tick(now))
            self._pace(now)

    def _pace(self, now: Moment) -> None:
        """Tick quickly only while something can be due soon."""
        if not self._controller.quick_ticks(now):
            self._quick.cancel()
        elif self._quick.is_canceled():
            self._quick.reset()

    # --- what goes out ---

    def _do(self, effects: Iterable[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, SendCommand):
                self._command.publish(command_message(effect))
            elif isinstance(effect, PublishState):
                self._focus_state.publish(self._state_message(effect.outcome))
            elif isinstance(effect, PublishCapabilities):
                self.publish_capabilities()
            elif isinstance(effect, StartDegauss):
                self._start_degauss(effect)
            # One line per severity: rclpy ties a severity to the line that logs.
            elif effect.level == "info":
                self._node.get_logger().info(effect.text)
            elif effect.level == "warning":
                self._node.get_logger().warning(effect.text, throttle_duration_sec=1.0)
            else:
                self._node.get_logger().error(effect.text)

    def _state_message(self, outcome: Outcome) -> FocusState:
        self._forecast.use(self._controller.active, self._values["reachable_tolerance"])
        return state_message(outcome, self._values, self._forecast.share)

    def publish_capabilities(self) -> None:
        """Say what the mirror can do now."""
        message = capabilities_message(self._controller, self._mirror, self._values, self._now())
        self._capabilities.publish(message)

    def _start_degauss(self, run: StartDegauss) -> None:
        """Call the driver, or keep `run` until the driver has discovered the client: its answer would be lost."""
        self._to_degauss = run
        if not answers_arrive(self._degauss, self._degauss.service_is_ready):
            return
        self._to_degauss = None
        if self._awaited is not None:
            self._degauss.remove_pending_request(self._awaited)
        self._awaited = self._degauss.call_async(Degauss.Request(steps=run.steps))
        # By the executor: the answer may be there already, and then this thread would take the lock twice.
        self._awaited.add_done_callback(
            lambda done: self._node.executor.create_task(self._on_degaussed, run.number, done)
        )

    def _on_degaussed(self, number: int, done: Any) -> None:
        refusal, answer = None, done.result()
        if answer.error_code != ErrorCode.OK:
            refusal = Refusal(answer.error_code, f"conditioning: {answer.message}")
        with self._lock:
            self._do(self._controller.degauss_answered(number, self._now(), answer.duration, refusal))

    def health(self) -> diagnostics.Health:
        """The node's health."""
        with self._lock:
            controller, now = self._controller, self._now()
            values = {
                "requests": controller.requests,
                "refused": controller.refused,
                "history": controller.observer.unknown or "known",
                "held": controller.hold.active,
                "corrections": controller.hold.corrections,
            }
            text = trouble(controller, self._values, now)
        return diagnostics.Health(diagnostics.WARN if text else diagnostics.OK, text or "ready", values)

    # --- requests, and what the actions ask for, from any thread ---

    def order(self, request: FocusRequest, dry_run: bool = False) -> Order:
        """Judge a request and, unless it is refused or a dry run, carry it out."""
        wanted = request_from(request)
        with self._lock:
            now = self._now()
            if not self._controller.degauss_offered:
                self._controller.degauss_offered = self._degauss.service_is_ready()
            order, effects = self._controller.request(wanted, now, dry_run)
            self._do(effects)
            self._pace(now)
        return order

    def state(self, order: Order) -> FocusState:
        """What came of an order so far."""
        assert order.outcome is not None
        return self._state_message(order.outcome)

    def progress(self, order: Order) -> Progress:
        """How far an order is."""
        with self._lock:
            return self._controller.monitor.progress(order, self._now().steady)

    def keeps(self, order: Order) -> bool:
        """Whether the shape of an order is still the one to keep."""
        with self._lock:
            return self._controller.monitor.keeps(order)

    def withdraw(self, order: Order) -> bool:
        """Do not carry out an order after all; False = it does not wait for a degauss (any more)."""
        with self._lock:
            return self._controller.conditioning.withdraw(order)

    def stop(self, order: Order) -> bool:
        """Leave the move of an order where it is; False = another shape was asked for since."""
        with self._lock:
            effects = self._controller.stop(order, self._now())
            self._do(effects or ())
        return effects is not None

    def target(self, request: FocusRequest) -> FocusTarget:
        """The target of a request that could be carried out. Raises Refusal."""
        with self._lock:
            return self._controller.judge(request_from(request), self._now()).target

    def active_calibration(self) -> ActiveCalibration:
        """The calibration in use. Raises Refusal."""
        with self._lock:
            if self._controller.active is None:
                raise self._controller.not_calibrated
            return self._controller.active

    def hysteresis(self) -> HysteresisState | None:
        """What is known of the actuators; None = nothing."""
        with self._lock:
            return self._controller.observer.estimate(self._now().time).state

    def reserve(self, text: str) -> None:
        """Refuse requests from now on, with this sentence as the reason; "" = serve them again."""
        with self._lock:
            self._controller.reserved = text
