"""Node `pdm_driver`: takes actuator commands and drives the mirror's electronics within the limits.

Lifecycle: `configure` reads the parameters and opens the electronics, `activate` writes the safe shape and accepts
commands, `deactivate` ramps to the safe shape. A unit that cannot be reached does not fail a transition: the driver
reports the lost link and keeps trying, so that the order in which things are switched on does not matter.
"""

import sys
import threading
import time
from typing import Any

from dm_msgs.msg import ActuatorCommand, ActuatorState, MirrorInfo
from dm_msgs.srv import HoldMirror, SetSignals
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn

from dm_common.errors import ErrorCode, Refusal
from dm_common.messages import stamp_ns
from dm_common.ros import parameters, qos
from dm_common.ros.executor import run_node
from dm_common.ros.lifecycle import Health, ManagedNode
from dm_common.ros.worker import WorkerService, never_silent
from dm_common.state_files import state_file
from dm_common.values import fill_with_nan
from dm_driver.actuator_writer import ActuatorWriter
from dm_driver.commands.command_gate import CODE_OF_OUTCOME, MARGIN_S, CommandGate
from dm_driver.commands.degauss_action import DegaussAction
from dm_driver.commands.mirror_hold import MirrorHold
from dm_driver.driver_configuration import DriverConfiguration, build_configuration
from dm_driver.driver_health import LinkLog, driver_health
from dm_driver.driver_messages import mirror_info_message, state_message, unconfigured_message
from dm_driver.driver_parameters import PARAMETERS
from dm_driver.last_shape import LastShape
from dm_driver.moves import Move, Outcome, WriterState

#: Shortest time between two state messages in the middle of a ramp, s.
STATE_INTERVAL_S = 0.02


class PdmDriverNode(ManagedNode):
    """The node; see the head of this module."""

    requires_activation = False

    def __init__(self) -> None:
        super().__init__("pdm_driver", PARAMETERS)
        self._hold = MirrorHold(time.monotonic)
        self._gate = CommandGate(self._hold, self._on_gate, self.inactive)
        self._frame_id = parameters.frame_id(self, self._values["frame_id"])
        # Guards publishing, which happens in the executor's, the writer's and the services' threads.
        self._state_lock = threading.Lock()
        self._link_log = LinkLog(time.monotonic())
        self._published_at = 0.0
        self._info, self._drivers = MirrorInfo(), 1
        # Plain publishers: the state must be seen in every lifecycle state.
        self._state_publisher = self.create_publisher(ActuatorState, "actuator_state", qos.with_lease(qos.STATE))
        self._info_publisher = self.create_publisher(MirrorInfo, "mirror_info", qos.with_lease(qos.LATCHED))
        self.create_subscription(ActuatorCommand, "actuator_command", self._on_command, qos.COMMAND)
        WorkerService(self, SetSignals, "set_signals", self._on_set_signals)
        DegaussAction(self, self._gate, self._values)
        answer = never_silent(self, "hold_mirror", self._on_hold_mirror)
        self.create_service(HoldMirror, "hold_mirror", answer, qos_profile=qos.SERVICE)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(self._values["state_period"], self._periodic, clock=steady)

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        done = super().on_configure(state)
        self._publish_state()
        return done

    def configure(self) -> None:
        configuration = build_configuration(self._values)
        wanted, limits = self._values["limits.slew_rate"], configuration.limiter.limits
        if limits.slew_rate < wanted:
            self.get_logger().info(
                f"limits.slew_rate = {wanted:g} 1/s: {limits.slew_rate:.4g} 1/s is used, for the line carries"
                f" {limits.frames_per_second:.4g} frames per second, each a step of at most {limits.step:g}"
            )
        self._frame_id = parameters.frame_id(self, self._values["frame_id"])
        self._diagnostics.hardware_id = f"{self._values['mirror.name']} {self._values['mirror.serial']}"
        self._timer.timer_period_ns = round(self._values["state_period"] * 1e9)
        self._timer.reset()  # else the period that has begun would continue, up to a minute
        self._gate.configuration = configuration
        self._gate.refusal = None
        self._gate.writer = ActuatorWriter(
            configuration.electronics,
            configuration.output,
            configuration.limiter,
            configuration.safe_shape,
            listener=self._on_writer,
            watchdog_s=self._values["limits.watchdog"],
            stamp_ns=lambda: int(self.get_clock().now().nanoseconds),
            last=self._last_shape(configuration),
        )
        self._link_log = LinkLog(time.monotonic())
        self._gate.writer.start()
        self._gate.writer.wait_for_link(self._values["electronics.timeout"])
        now = self.get_clock().now().to_msg()
        self._info = mirror_info_message(self._values, configuration, self._frame_id, now)
        self._info_publisher.publish(self._info)

    def _last_shape(self, configuration: DriverConfiguration) -> LastShape:
        """The record of what was last sent to this unit; an empty one if none can be kept."""
        settings, actuators = configuration.settings, configuration.limiter.limits.actuators
        place = settings.serial_port or f"{settings.address}-{settings.port}"
        names = self._values["electronics.kind"], place, self._values["mirror.serial"]
        path = state_file(self._values["state_folder"], ".shape", *names)
        try:
            return LastShape(path, actuators)
        except OSError as error:
            nothing = LastShape(None, actuators)
            nothing.trouble = f"state_folder = {self._values['state_folder']!r} cannot be used: {error}"
            self.get_logger().warning(nothing.trouble)
            return nothing

    def activate(self) -> None:
        writer = self._gate.writer
        assert writer is not None
        self._gate.refusal = None
        if writer.enable(MARGIN_S if writer.state().link_up else 0.0):
            self.get_logger().info("active; the mirror stands in the safe shape")
        else:
            self.get_logger().info("active; the safe shape is written as soon as the drive electronics answer")
        self._publish_state()

    def deactivate(self) -> None:
        self._to_safe_shape("deactivate")
        self._publish_state()

    def clean_up(self) -> None:
        self._close("cleanup")

    def make_safe(self) -> None:
        """Ramp to the safe shape and close the electronics; runs when the process ends (SIGINT, SIGTERM)."""
        self.active = False
        self._close("end of the process")
        super().make_safe()

    def _to_safe_shape(self, occasion: str) -> None:
        writer, configuration = self._gate.writer, self._gate.configuration
        if writer is None or configuration is None or not writer.state().enabled:
            return
        ramp_time = writer.ramp_time(configuration.safe_shape)
        outcome = writer.disable(ramp_time + self._values["electronics.timeout"] + MARGIN_S)
        if outcome is Outcome.REACHED:
            self.get_logger().info(f"{occasion}: the mirror stands in the safe shape")
        elif writer.state().applied is None:
            self.get_logger().info(f"{occasion}: the drive electronics were never there, nothing was written")
        else:
            self.get_logger().error(
                f"{occasion}: the safe shape was not reached ({outcome.value}); the outputs probably hold their last"
                " values"
            )

    def _close(self, occasion: str) -> None:
        self._to_safe_shape(occasion)
        writer, self._gate.writer, self._gate.configuration = self._gate.writer, None, None
        if writer is not None and not writer.stop():
            self.get_logger().error(f"{occasion}: the electronics' thread hangs; it ends with the process")
        self._publish_state()

    # Commands

    def _on_command(self, message: ActuatorCommand) -> None:
        def carry_out(writer: ActuatorWriter, configuration: DriverConfiguration) -> Move | None:
            if stamp := stamp_ns(message.header.stamp):
                configuration.limiter.check_age((self.get_clock().now().nanoseconds - stamp) * 1e-9)
            shape = configuration.limiter.check_shape(message.signals)
            return writer.correct(shape, message.expected_turns) if message.expected_turns else writer.command(shape)

        self._gate.attempt("actuator_command", message, carry_out)

    def _on_set_signals(self, request: Any, response: Any) -> Any:
        fill_with_nan(response)  # until they are known

        def carry_out(writer: ActuatorWriter, configuration: DriverConfiguration) -> Move | None:
            target = configuration.limiter.check_shape(request.signals)
            response.ramp_time = writer.ramp_time(target)
            return None if request.dry_run else writer.command(target)

        result = self._gate.attempt("set_signals", request, carry_out, dry_run=request.dry_run)
        will = "would take" if request.dry_run else "took" if request.wait else "takes"
        response.message = f"the signals keep every limit; the ramp {will} {response.ramp_time:.3f} s"
        if isinstance(result, Refusal):
            response.error_code, response.message = result.error_code, str(result)
        elif result is not None and request.wait:
            return lambda: self._signals_set(response, result.wait())
        return self._signals_set(response)

    def _signals_set(self, response: Any, outcome: Outcome | None = None) -> Any:
        if outcome is not None and (ended := self._gate.outcome(outcome)) is not Outcome.REACHED:
            response.error_code, response.message = CODE_OF_OUTCOME[ended], ended.value
        writer = self._gate.writer
        if writer is not None and (applied := writer.state().applied) is not None:
            response.applied.frombytes(applied.tobytes())
        return response

    def _on_hold_mirror(self, request: Any, response: Any) -> Any:
        before = self._hold.holder
        try:
            self._hold.handle(request.operation, request.holder, request.purpose, request.duration, request.lease)
            response.message = self._hold.sentence or "nobody holds the mirror"
        finally:
            response.holder = self._hold.holder
            if response.holder != before:
                self.get_logger().info(self._hold.sentence or f"{before} has given the mirror back")
                self._publish_state()
        return response

    def _on_gate(self, text: str, took_over: bool) -> None:
        """A command was refused, or took the mirror over; a flood of refusals must not hide the latter."""
        if took_over:
            self.get_logger().warning(text)
        else:
            self.get_logger().warning(text, throttle_duration_sec=1.0)
        self._publish_state()

    # State

    def _on_writer(self, state: WriterState, edge: bool) -> None:
        """Runs in the writer's thread after every write and every change of the link."""
        if edge:
            self._log_link(state)
        if edge or time.monotonic() - self._published_at >= STATE_INTERVAL_S:
            self._publish_state()

    def _log_link(self, state: WriterState) -> None:
        with self._state_lock:
            news = self._link_log.news(state, time.monotonic())
        if news is None:
            return
        if news[0] == "error":
            self.get_logger().error(news[1], throttle_duration_sec=5.0)
        else:
            self.get_logger().info(news[1])

    def _periodic(self) -> None:
        """Report periodically: a unit that never answers causes no change of state, but is missing all the same."""
        if (writer := self._gate.writer) is not None:
            self._log_link(writer.state())
            before, self._drivers = self._drivers, self.count_publishers(self._info_publisher.topic_name)
            if self._drivers < before:  # another driver of this name, started by mistake, may have described its mirror
                self._info_publisher.publish(self._info)
        self._publish_state()

    def _publish_state(self) -> None:
        with self._state_lock:
            if not self.context.ok():  # when the process ends, nobody is left to publish to
                return
            refusal, writer, configuration = self._gate.refusal, self._gate.writer, self._gate.configuration
            if reason := self.inactive():
                refusal = Refusal(ErrorCode.INVALID_ARGUMENT if self.trouble else ErrorCode.DRIVER_INACTIVE, reason)
            if writer is None or configuration is None:
                message = unconfigured_message(self._frame_id, refusal, self._hold)
            else:
                message = state_message(writer.state(), refusal, configuration, self._frame_id, self._hold)
            self._state_publisher.publish(message)
            self._published_at = time.monotonic()

    def health(self) -> Health:
        trouble = self.inactive() if self.trouble else ""
        return driver_health(self._gate.writer, self._gate.refusal, self._gate.refused, trouble)


def main() -> int:
    """Run the node."""
    return run_node(PdmDriverNode)


if __name__ == "__main__":
    sys.exit(main())
