"""The bench of a calibration over ROS: services of driver and interferometer as blocking calls."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import rclpy
from dm_msgs.action import Degauss
from dm_msgs.msg import ActuatorState, MirrorInfo, SurfaceMapInfo
from dm_msgs.srv import Measure, SetSignals
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from dm_common import Floats
from dm_common.errors import Cancelled, ErrorCode, MeasurementError, Refusal
from dm_common.messages import doubles, driver_refusal, measurement_from, stamp_ns
from dm_common.ros import qos
from dm_common.ros.clients import MirrorHolder, ServiceCallError, ThreadedActionClient, call, run_goal
from dm_common.ros.worker import duration_clock, sleep

if TYPE_CHECKING:
    from dm_common.measurement import Measurement

#: Error codes of a failed measurement that another try cannot cure.
_FATAL = (ErrorCode.INTERFEROMETER_INACTIVE, ErrorCode.NOT_SUPPORTED, ErrorCode.INVALID_ARGUMENT)
#: Signals that differ by no more than this are the same command.
_SAME_SIGNAL = 1e-6
#: Most tries of one map, if the interferometer is lost during each of them and comes back.
_TRIES = 5
#: Wall time for a state message to confirm that the mirror still holds the command, s (it comes every 0.5 s).
_STATE_WAIT_S = 2.0
#: Longest wait for the driver when the process ends, s.
_EXIT_WAIT_S = 5.0


class BenchServices:
    """Driver and interferometer of one calibration; implements :class:`dm_common.measurement.Bench`.

    All methods block and must be called from a worker thread.

    Attributes:
        hold: the hold on the mirror.
        nodes: liveliness of driver and interferometer.
        state: the driver's last state message; None before the first.
        settle_time: s of ROS time between command and map.
        cancelled: whether to cancel; called while waiting.
        map_time: s of ROS time that the last map took; 0 = none was taken yet.
        waiting: called with the reason for waiting, such as a missing node; "" = the wait is over.
        temperature: of the mirror (degC) at a time (s of ROS time); NaN = not known.
    """

    def __init__(self, node: Node, values: Mapping[str, Any]) -> None:
        self._node = node
        self._values = values
        self._set_signals = node.create_client(SetSignals, "set_signals")
        self._degauss = ThreadedActionClient(node, Degauss, "degauss")
        self._measure = node.create_client(Measure, "measure")
        self._driver = qos.watch(node, "pdm_driver", MirrorInfo, "mirror_info", qos.LATCHED)
        self._interferometer = qos.watch(node, "interferometer", SurfaceMapInfo, "surface_map_info", qos.STATE)
        self.nodes = (self._driver, self._interferometer)
        self.hold = MirrorHolder(node, node.get_name(), self._driver.missing)
        self.waiting: Callable[[str], None] = lambda _text: None
        self._said = ""
        self.state: ActuatorState | None = None
        self.settle_time = float(values["settle_time"])
        self.cancelled: Callable[[], bool] = lambda: False
        self.map_time = 0.0
        self.temperature: Callable[[float], float] = lambda _time: math.nan
        self._commanded: Floats | None = None
        self._history_known = False
        node.create_subscription(ActuatorState, "actuator_state", self._on_state, qos.STATE)

    def _on_state(self, message: ActuatorState) -> None:
        self.state = message
        self._driver.heard()

    def publish_waits(self, handle: Any, feedback: Any) -> None:
        """From now on, publish the reason for waiting as the `message` of a goal's feedback."""

        def publish(text: str) -> None:
            feedback.message = text
            handle.publish_feedback(feedback)

        self.waiting = publish
        self._said = ""

    @contextmanager
    def held(self, request: Any, purpose: str, duration: float = 0.0) -> Iterator[None]:
        """Hold the mirror during the block: commands of other clients are refused.

        Arguments as those of `MirrorHolder.held`.

        Raises:
            Refusal: somebody else holds it, or there is no driver.
        """
        with ExitStack() as stack:
            with self._answered("hold_mirror", self._driver, self._set_signals.service_is_ready) as stop:
                stack.enter_context(self.hold.held(request, purpose, duration, self._values["driver_timeout"], stop))
            yield

    def check_ready(self) -> None:
        """Raise Refusal when the driver says that it takes no commands."""
        refusal = driver_refusal(self.state)
        if refusal is not None and refusal.error_code == ErrorCode.DRIVER_INACTIVE:  # a lost link comes back
            raise refusal

    def check_history(self) -> None:
        """Raise Refusal when the driver knew the history of the actuators and no longer does.

        A driver that was restarted, or lost its link, soon takes commands again; but maps from before and after that
        must not be combined without a degauss in between.
        """
        was_known = self._history_known
        self._history_known = self.state is not None and self.state.history_known
        if was_known and not self._history_known:
            raise Refusal(
                ErrorCode.DRIVER_UNAVAILABLE,
                "pdm_driver no longer knows the history of the actuators: it was restarted or lost its link",
            )

    def degauss(self, steps: int = 0) -> None:
        """As in `Bench`, with this number of half-swings; 0 = as configured in the driver."""
        goal = Degauss.Goal(steps=steps, holder=self.hold.holder)
        timeout = self._values["degauss_timeout"]
        with self._answered("degauss", self._driver, self._degauss.server_is_ready) as stop:
            self.check_history()
            self._history_known = False
            lost = self._driver.since_now()
            result = run_goal(self._degauss, goal, timeout, stop=stop, server_lost=lost, send_by=self.hold.command)
            if result.error_code != ErrorCode.OK and stop():
                raise ServiceCallError("degauss: cancelled")
        self._check("degauss", result)

    def apply(self, signals: Floats) -> Floats:
        request = SetSignals.Request(signals=doubles(signals), wait=True, holder=self.hold.holder)
        with self._answered("set_signals", self._driver, self._set_signals.service_is_ready) as stop:
            # A driver that was just restarted may not have discovered this client yet; its answer is then lost.
            again = qos.RETURN_S if self._driver.changed_within(qos.APPEAR_S) else math.inf
            response = call(self._set_signals, request, self._values["driver_timeout"], stop, again, self.hold.command)
        self._check("set_signals", response)
        self._commanded = signals
        return np.array(response.applied) if len(response.applied) == len(signals) else signals

    def settle(self, dwell: float = 0.0, share: float = 1.0) -> bool:
        slept = sleep(self._node.get_clock(), share * self.settle_time + dwell, self._stopping)
        if self.hold.lost is not None:
            raise self.hold.lost
        return slept

    def measure(self, label: str) -> Measurement:
        for left in reversed(range(_TRIES)):
            try:
                return self._measured(label, self._check_undisturbed)
            except MeasurementError as error:
                if not self._no_interferometer() or (left and not self._interferometer_returns()):
                    raise
                failure = error
        raise Refusal(failure.error_code, f"{failure} ({_TRIES} tries)") from failure

    def measure_present_shape(self, label: str) -> Measurement:
        """One map of the shape as it stands; does not wait for an interferometer to return. Raises as `measure`."""
        return self._measured(label, lambda: None)

    def _no_interferometer(self) -> bool:
        return self._interferometer.missing(self._measure.service_is_ready)

    def _interferometer_returns(self) -> bool:
        """Wait up to the timeout of a map for an interferometer that has died; whether it is back. Raises Cancelled."""
        deadline = time.monotonic() + self._values["measure_timeout"]
        while (missing := self._no_interferometer()) and time.monotonic() < deadline:
            if self._stopping():
                raise self.hold.lost or Cancelled("cancelled")
            time.sleep(0.02)
        return not missing

    def _measured(self, label: str, check: Callable[[], None]) -> Measurement:
        timeout = self._values["measure_timeout"]
        request = Measure.Request(label=label, timeout=timeout)
        clock = duration_clock(self._node.get_clock())
        began = clock.now()
        # The interferometer enforces the time limit; the call waits a little longer for its answer with the reason.
        try:
            with self._answered("measure", self._interferometer, self._measure.service_is_ready) as stop:
                response = call(self._measure, request, timeout + 5.0, stop)
            self._check("measure", response)
        except Refusal as error:
            if error.error_code in _FATAL or self.hold.lost is not None:
                raise
            raise MeasurementError(error.error_code, str(error)) from error
        self.map_time = max(0.0, (clock.now() - began).nanoseconds * 1e-9)  # a simulation may begin anew
        check()
        try:
            # The state was read after the map, so its stamp is that of the write that the map shows.
            moved_ns = stamp_ns(self.state.header.stamp) if self.state is not None else 0
            measured = measurement_from(response)
            return replace(measured, moved_ns=moved_ns, temperature=self.temperature(1e-9 * measured.stamp_ns))
        except ValueError as error:
            raise Refusal(ErrorCode.INTERNAL, f"measure: {error}") from error

    def rest(self, signals: Floats) -> str:
        """Ramp back to `signals`, even after a cancellation. Returns the outcome as a sentence."""
        self.cancelled = lambda: False
        self._history_known = False
        deadline = time.monotonic() + self._values["degauss_timeout"]
        while True:
            try:
                self.apply(signals)
                return "the mirror is back at mid range"
            except Refusal as error:
                if self.hold.lost is not None or error.error_code == ErrorCode.DRIVER_INACTIVE:
                    return f"the mirror is left as it is: {self.hold.lost or error}"
                # A degauss or ramp that was cancelled here may still be running in the driver.
                if error.error_code not in (ErrorCode.BUSY, ErrorCode.PREEMPTED) or time.monotonic() > deadline:
                    return f"the mirror could NOT be brought back to mid range: {error}"
                time.sleep(0.2)

    def rest_at_exit(self, signals: Floats) -> str:
        """As `rest`, when the process ends: over a ROS context of its own, since nobody serves the node any more."""
        self.hold.end()
        context = Context()
        rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
        node = Node(f"{self._node.get_name()}_exit", context=context, use_global_arguments=False)
        try:
            client = node.create_client(SetSignals, self._set_signals.service_name)  # of this namespace, as remapped
            timeout = min(self._values["driver_timeout"], _EXIT_WAIT_S)
            request = SetSignals.Request(signals=doubles(signals), wait=True, holder=self.hold.holder)
            response: Any = None
            if client.wait_for_service(timeout_sec=timeout):
                future = client.call_async(request)
                rclpy.spin_until_future_complete(node, future, SingleThreadedExecutor(context=context), timeout)
                response = future.result() if future.done() else None
            if response is None:
                return "the mirror was not brought back to mid range: pdm_driver ends too, or has not answered in time"
            if response.error_code != ErrorCode.OK:
                return f"the mirror could NOT be brought back to mid range: {response.message}"
            return "the mirror is back at mid range"
        finally:
            node.destroy_node()
            context.try_shutdown()

    def _missing(self) -> str:
        """What is missing on the bench now, as a sentence; "" = nothing."""
        if self._driver.missing(self._set_signals.service_is_ready):
            return self._driver.text
        if self.state is not None and self.state.driver_state == ActuatorState.STATE_LINK_LOST:
            return "pdm_driver has lost the link to the electronics"
        return self._interferometer.text if self._no_interferometer() else ""

    def _stopping(self) -> bool:
        """Whether a wait is to end. Anything missing on the bench is reported at once, even if needed only later."""
        if (missing := self._missing()) != self._said:
            self._said = missing
            self.waiting(f"waiting: {missing}" if missing else "")
        return self.cancelled() or self.hold.lost is not None

    @contextmanager
    def _answered(self, what: str, server: qos.Liveliness, ready: Callable[[], bool]) -> Iterator[Callable[[], bool]]:
        """For a call of `what` at `server`: yield the condition that ends its wait; turn its failure into a Refusal."""
        server.wait_for_return(self._stopping)
        lost_reason = server.since_now(ready)
        try:
            yield lambda: self._stopping() or bool(lost_reason())
        except ServiceCallError as error:
            if self.cancelled() or not self._node.context.ok():  # a Refusal would be journalled as a failed map
                raise Cancelled("cancelled") from error
            if self.hold.lost is not None:
                raise self.hold.lost from error
            code = ErrorCode.DRIVER_UNAVAILABLE if server is self._driver else ErrorCode.INTERFEROMETER_UNAVAILABLE
            raise Refusal(code, f"{what}: {text}" if (text := lost_reason()) else str(error)) from error

    @staticmethod
    def _check(what: str, response: Any) -> None:
        if response.error_code != ErrorCode.OK:
            raise Refusal(response.error_code, f"{what}: {response.message}")

    def _check_undisturbed(self) -> None:
        """Raise Refusal when the mirror no longer holds what this node commanded: the map then shows another shape."""
        deadline = time.monotonic() + _STATE_WAIT_S
        while self.state is not None and self._commanded is not None:
            requested = np.array(self.state.requested, dtype=np.float64)
            if requested.shape == self._commanded.shape and np.abs(requested - self._commanded).max() <= _SAME_SIGNAL:
                return
            self.check_ready()
            if self.hold.lost is not None:
                raise self.hold.lost
            if time.monotonic() > deadline or self.cancelled():
                raise Refusal(ErrorCode.PREEMPTED, "another program commanded the mirror meanwhile: stop it first")
            time.sleep(0.01)
