"""Node `focus_controller`: curvature requests in, actuator commands out, with a prediction of the result.

Translates messages, parameters and time; what happens is decided in `dm_controller.focus_controller`.
"""

import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
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
    RecipeBook,
)
from rclpy.clock import Clock, ClockType

from dm_common.hysteresis.creep_record import CreepRecorder
from dm_common.messages import doubles, time_message
from dm_common.ros import qos
from dm_common.ros.executor import run_node
from dm_common.ros.parameters import frame_id
from dm_controller.focus_actions import FocusHost
from dm_controller.focus_controller import SLOW_PERIOD_S, FocusController
from dm_controller.focus_messages import actuator_estimate_message, capabilities_message, state_message
from dm_controller.focus_types import (
    Effect,
    Moment,
    Order,
    PublishCapabilities,
    PublishEstimate,
    PublishState,
    SendCommand,
    StartDegauss,
)
from dm_controller.forecast import ForecastClient
from dm_controller.loop_actions import serve_loops

#: Period of checks whether the driver is silent, s of wall time.
STEADY_PERIOD_S = 0.5
#: Period of writing the actuators' creep to disk, s of wall time.
RECORD_PERIOD_S = 30.0


class FocusControllerNode(FocusHost):
    """Subscriptions and timers run in the executor, services and actions in threads of their own. See README.

    While inactive, it still follows the actuators, but uses no calibration and sends no command.
    """

    def __init__(self, **keywords: Any) -> None:
        super().__init__(self._on_parameters, **keywords)
        values = self._values
        self._mirror: MirrorInfo | None = None
        self._calibration: Calibration | None = None
        self._recipes = RecipeBook()
        self._command = self.create_publisher(ActuatorCommand, "actuator_command", qos.COMMAND)
        self._focus_state = self.create_publisher(FocusState, "focus_state", qos.STATE)
        self._capabilities = self.create_publisher(Capabilities, "capabilities", qos.with_lease(qos.LATCHED))
        self._estimate = self.create_publisher(ActuatorEstimate, "actuator_estimate", qos.LATCHED)
        self._forecast = ForecastClient(self)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        warn = partial(self.get_logger().warning, throttle_duration_sec=60.0)
        self._recorder = CreepRecorder(values["state_folder"], self._controller.observer, warn)
        self.create_timer(RECORD_PERIOD_S, self._keep_record, clock=steady)
        self._quick = self.create_timer(values["hold.period"], self._tick)
        self.create_timer(SLOW_PERIOD_S, self._tick)
        self.create_timer(STEADY_PERIOD_S, self._tick, clock=steady)
        serve_loops(self, values)
        self._driver = qos.watch(self, "pdm_driver", MirrorInfo, "mirror_info", qos.LATCHED)
        self.create_subscription(MirrorInfo, "mirror_info", self._on_mirror_info, qos.LATCHED)
        self.create_subscription(Calibration, "calibration", self._on_calibration, qos.LATCHED)
        self.create_subscription(RecipeBook, "recipes", self._on_recipes, qos.LATCHED)
        self.create_subscription(ActuatorState, "actuator_state", self._on_actuator_state, qos.STATE)
        self.create_subscription(FocusRequest, "focus_request", self.order, qos.COMMAND)
        if not values["autostart"]:
            self.deactivate()

    def configure(self) -> None:
        self._quick.timer_period_ns = round(self._values["hold.period"] * 1e9)
        self._recorder.folder = self._values["state_folder"]

    def activate(self) -> None:
        """Use the calibration with the mirror, as far as both are known."""
        if self.active:
            with self.controller() as (controller, now):
                self.carry_out(controller.use(self._calibration, self._mirror, self._recipes), now)
                self._forecast.use(controller.active, self._values["reachable_tolerance"])

    @contextmanager
    def controller(self) -> Iterator[tuple[FocusController, Moment]]:
        with self._lock:
            clock = self.get_clock()
            ns = int(clock.now().nanoseconds)
            yield self._controller, Moment(ns, 1e-9 * ns, time.monotonic(), clock.ros_time_is_active)

    def _on_mirror_info(self, message: MirrorInfo) -> None:
        self._mirror, self._diagnostics.hardware_id = message, message.serial
        with self.controller() as (_controller, now):
            self._recorder.recall(message.serial, now.time)
        self.activate()

    def _keep_record(self) -> None:
        with self.controller() as (controller, now):
            # Without reports on the mirror the last record stays: what comes after it is in doubt.
            if not controller.monitor.stopped(now.steady):
                self._recorder.keep(now.time)

    def _on_calibration(self, message: Calibration) -> None:
        self._calibration = message
        self.activate()

    def _on_recipes(self, message: RecipeBook) -> None:
        before, self._recipes = self._recipes, message
        # Each message on `calibration` comes with one here, which mostly brings nothing new.
        new = message != before and (message.recipes or before.recipes)
        if new and self._calibration is not None and message.calibration_id == self._calibration.id:
            self.activate()

    def _on_parameters(self, changes: Mapping[str, Any]) -> None:
        if {"hold_tilt", "optical_axis"} & set(changes):
            self.activate()
        else:
            with self.controller() as (_controller, now):
                self.carry_out([PublishCapabilities()], now)

    def _on_actuator_state(self, message: ActuatorState) -> None:
        self._driver.heard()
        with self.controller() as (controller, now):
            self.carry_out(controller.driver_report(message, now), now)

    def _tick(self) -> None:
        with self.controller() as (controller, now):
            loss = f"pdm_driver {qos.LOST_TEXT}" if self._driver.missing() else ""
            self.carry_out(controller.tick(now, loss), now)
            self._forecast.use(controller.active, self._values["reachable_tolerance"])

    def order(self, message: FocusRequest, dry_run: bool = False) -> Order:
        with self.controller() as (controller, now):
            order, effects = controller.request(message, now, dry_run)
            self.carry_out(effects, now)
        return order

    def carry_out(self, effects: Iterable[Effect], now: Moment) -> None:
        for effect in effects:
            if isinstance(effect, SendCommand):
                command = ActuatorCommand(signals=doubles(effect.signals), expected_turns=effect.expected_turns)
                command.holder, command.take_over = effect.holder, effect.take_over
                command.header.stamp = time_message(effect.sent.ns)
                self._command.publish(command)
            elif isinstance(effect, PublishState):
                self._focus_state.publish(self.state(effect.order))
            elif isinstance(effect, PublishCapabilities):
                message = capabilities_message(self._controller, self._mirror, self._values, now)
                self._capabilities.publish(self._framed(message))
            elif isinstance(effect, PublishEstimate):
                self._estimate.publish(self._framed(actuator_estimate_message(self._controller)))
            elif isinstance(effect, StartDegauss):
                self._degauss.start(effect)
            # One line per severity: rclpy ties a severity to the line that logs.
            elif effect.level == "info":
                self.get_logger().info(effect.text)
            elif effect.level == "warning":
                self.get_logger().warning(effect.text, throttle_duration_sec=1.0)
            else:
                self.get_logger().error(effect.text)
        # Tick quickly only while something can be due soon: a lost driver counts as dead within 2 s.
        if not (self._controller.needs_fast_timer(now) or (self._driver.lost and not self._driver.missing())):
            self._quick.cancel()
        elif self._quick.is_canceled():
            self._quick.reset()

    def state(self, order: Order) -> FocusState:
        return self._framed(state_message(order, self._values, self._forecast.share))

    def _framed(self, message: Any) -> Any:
        message.header.frame_id = self._mirror.header.frame_id if self._mirror is not None else frame_id(self, "")
        return message


def main() -> int:
    """Entry point of the node."""
    return run_node(FocusControllerNode)


if __name__ == "__main__":
    sys.exit(main())
