"""Node `focus_controller`: curvature requests in, actuator commands out, with the prediction of what they will do.

Translates messages, parameters and time; what happens is decided in `dm_controller.focus_controller`.
"""

import sys
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from dm_msgs.msg import (
    ActuatorCommand,
    ActuatorEstimate,
    ActuatorState,
    Calibration,
    Capabilities,
    FocusRequest,
    FocusState,
    MirrorInfo,
)
from rclpy.clock import Clock, ClockType

from dm_common.errors import ErrorCode, Refusal
from dm_common.hysteresis.creep_record import CreepRecorder
from dm_common.messages import doubles, estimate_message, time_message
from dm_common.ros import qos
from dm_common.ros.executor import run_node
from dm_common.ros.lifecycle import Health
from dm_common.ros.parameters import frame_id
from dm_common.ros.qos import GONE, LEASE_S
from dm_controller.focus_actions import DegaussClient, FocusHost, FocusServices, MoveFocusAction
from dm_controller.focus_controller import SLOW_PERIOD_S, FocusController
from dm_controller.focus_messages import capabilities_message, health, state_message
from dm_controller.focus_parameters import PARAMETERS
from dm_controller.focus_types import (
    Effect,
    Moment,
    Order,
    Outcome,
    PublishCapabilities,
    PublishState,
    SendCommand,
    StartDegauss,
)
from dm_controller.forecast import ForecastClient
from dm_controller.loop_actions import LoopHost, serve_loops

#: How often the estimate of the actuators is published while the mirror moves, s of wall time.
ESTIMATE_PERIOD_S = 0.25
#: How often silence of the driver is noticed, s of wall time.
STEADY_PERIOD_S = 0.5
#: How often what the actuators have crept to is put on disk, s of wall time.
RECORD_PERIOD_S = 30.0


class FocusControllerNode(FocusHost):
    """Subscriptions and timers run in the executor, services and actions in threads of their own. See README.

    While it is not active it goes on following the actuators, has no calibration in use, and sends no command.
    """

    def __init__(self, **keywords: Any) -> None:
        super().__init__("focus_controller", PARAMETERS, self._on_parameters, **keywords)
        values = self._values
        self._lock, self._controller = threading.Lock(), FocusController(values)
        self._mirror: MirrorInfo | None = None
        self._calibration: Calibration | None = None
        self._command = self.create_publisher(ActuatorCommand, "actuator_command", qos.COMMAND)
        self._focus_state = self.create_publisher(FocusState, "focus_state", qos.STATE)
        self._capabilities = self.create_publisher(Capabilities, "capabilities", qos.with_lease(qos.LATCHED))
        self._estimate = self.create_publisher(ActuatorEstimate, "actuator_estimate", qos.LATCHED)
        self._estimated: tuple[object, ...] = ()  # what was published there last, and when, s of steady time
        self._estimated_at = 0.0
        self._degauss, self._forecast = DegaussClient(self, self._degauss_ended), ForecastClient(self)
        self._controller.degauss_offered = lambda: self._degauss.offered
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._recorder = CreepRecorder(values["state_folder"], self._controller.observer, self._warn)
        self.create_timer(RECORD_PERIOD_S, self._keep_record, clock=steady)
        self._quick = self.create_timer(values["hold.period"], self._tick)
        self.create_timer(SLOW_PERIOD_S, self._tick)
        self.create_timer(STEADY_PERIOD_S, self._tick, clock=steady)
        FocusServices(self, lambda: values["driver_timeout"])
        self._actions = MoveFocusAction(self, lambda: values["settle_time"]), *serve_loops(self, values, LoopHost(self))
        self._driver = qos.watch(self, "pdm_driver", MirrorInfo, "mirror_info", qos.LATCHED)
        self.create_subscription(MirrorInfo, "mirror_info", self._on_mirror_info, qos.LATCHED)
        self.create_subscription(Calibration, "calibration", self._on_calibration, qos.LATCHED)
        self.create_subscription(ActuatorState, "actuator_state", self._on_actuator_state, qos.STATE)
        self.create_subscription(FocusRequest, "focus_request", self.order, qos.COMMAND)
        if not values["autostart"]:
            self.deactivate()

    # --- lifecycle ---

    def configure(self) -> None:
        self._quick.timer_period_ns = round(self._values["hold.period"] * 1e9)
        self._recorder.folder = self._values["state_folder"]

    def activate(self) -> None:
        self._use()

    def deactivate(self) -> None:
        with self.controller() as (controller, now):
            self._do(controller.rest(Refusal(ErrorCode.NODE_INACTIVE, self.inactive()), now), now)

    def clean_up(self) -> None:
        self.deactivate()  # with another sentence

    def refused(self, reason: str) -> None:
        self.deactivate()

    @property
    def _frame_id(self) -> str:
        return self._mirror.header.frame_id if self._mirror is not None else frame_id(self, "")

    @contextmanager
    def controller(self) -> Iterator[tuple[FocusController, Moment]]:
        with self._lock:
            yield self._controller, self._now()

    def _now(self) -> Moment:
        clock = self.get_clock()
        ns = int(clock.now().nanoseconds)
        return Moment(ns, 1e-9 * ns, time.monotonic(), clock.ros_time_is_active)

    # --- what comes in ---

    def _on_mirror_info(self, message: MirrorInfo) -> None:
        self._mirror, self._diagnostics.hardware_id = message, message.serial
        self._recorder.recall(message.serial, self._now().time)
        self._use()

    def _keep_record(self) -> None:
        with self.controller() as (controller, now):
            # Of a mirror that nobody reports of, the last record stands: what comes after it is in doubt.
            if not controller.monitor.stopped(now.steady):
                self._recorder.keep(now.time)

    def _warn(self, text: str) -> None:
        self.get_logger().warning(text, throttle_duration_sec=60.0)

    def _on_calibration(self, message: Calibration) -> None:
        self._calibration = message
        self._use()

    def _on_parameters(self, changes: Mapping[str, Any]) -> None:
        if {"hold_tilt", "optical_axis"} & set(changes):
            self._use()
        else:
            self._publish_capabilities()

    def _use(self) -> None:
        if not self.active:
            return
        with self.controller() as (controller, now):
            self._do(controller.use(self._calibration, self._mirror), now)
            self._forecast.use(controller.active, self._values["reachable_tolerance"])

    def _on_actuator_state(self, message: ActuatorState) -> None:
        with self.controller() as (controller, now):
            self._do(controller.driver_report(message, now), now)

    def _tick(self) -> None:
        with self.controller() as (controller, now):
            # Who reports lives, whatever a lease says that lapsed on a busy machine.
            dead = controller.monitor.age(now.steady) > LEASE_S and self._driver.missing()
            self._do(controller.tick(now, f"pdm_driver {GONE}" if dead else ""), now)
            self._degauss.retry(controller.conditioning.run)
            self._forecast.use(controller.active, self._values["reachable_tolerance"])

    def _degauss_ended(self, number: int, duration: float, refusal: Refusal | None) -> None:
        with self.controller() as (controller, now):
            self._do(controller.degauss_answered(number, now, duration, refusal), now)

    # --- what goes out ---

    def _do(self, effects: Iterable[Effect], now: Moment) -> None:
        for effect in effects:
            if isinstance(effect, SendCommand):
                command = ActuatorCommand(signals=doubles(effect.signals), expected_turns=effect.expected_turns)
                command.holder, command.take_over = effect.holder, effect.take_over
                command.header.stamp = time_message(effect.stamp_ns)
                self._command.publish(command)
            elif isinstance(effect, PublishState):
                self._focus_state.publish(self.state(effect.outcome))
            elif isinstance(effect, PublishCapabilities):
                self._publish_capabilities()
            elif isinstance(effect, StartDegauss):
                self._degauss.start(effect)
            # One line per severity: rclpy ties a severity to the line that logs.
            elif effect.level == "info":
                self.get_logger().info(effect.text)
            elif effect.level == "warning":
                self.get_logger().warning(effect.text, throttle_duration_sec=1.0)
            else:
                self.get_logger().error(effect.text)
        self._publish_estimate(now)
        # Tick quickly only while something can be due soon: a lost driver counts as dead within 2 s.
        if not (self._controller.quick_ticks(now) or (self._driver.lost and not self._driver.missing())):
            self._quick.cancel()
        elif self._quick.is_canceled():
            self._quick.reset()

    def state(self, outcome: Outcome) -> FocusState:
        state = state_message(outcome, self._values, self._forecast.share)
        state.header.frame_id = self._frame_id
        return state

    def _publish_capabilities(self) -> None:
        message = capabilities_message(self._controller, self._mirror, self._values, self._now())
        message.header.frame_id = self._frame_id
        self._capabilities.publish(message)

    def _publish_estimate(self, now: Moment) -> None:
        """What is known of the actuators, where it changed; while the mirror moves, now and then."""
        observer, active = self._controller.observer, self._controller.active
        known = (observer.state, observer.unknown, active)
        moving = observer.latest is not None and observer.latest.moving
        if known == self._estimated or (moving and now.steady - self._estimated_at < ESTIMATE_PERIOD_S):
            return
        self._estimated, self._estimated_at = known, now.steady
        message = estimate_message(observer)
        message.header.frame_id = self._frame_id
        if active is not None:
            message.calibration_id, message.revision = active.calibration.id, active.calibration.revision
        self._estimate.publish(message)

    def health(self) -> Health:
        with self.controller() as (controller, now):
            return health(controller, self._values, now)

    # --- requests, and what the actions ask for, from any thread ---

    def order(self, message: FocusRequest, dry_run: bool = False) -> Order:
        with self.controller() as (controller, now):
            order, effects = controller.request(message, now, dry_run)
            self._do(effects, now)
        return order

    def stop(self, order: Order) -> bool:
        with self.controller() as (controller, now):
            effects = controller.stop(order, now)
            self._do(effects or (), now)
        return effects is not None


def main() -> int:
    """Entry point of the node."""
    return run_node(FocusControllerNode, sys.argv)


if __name__ == "__main__":
    sys.exit(main())
