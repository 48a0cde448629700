"""The calibration's bench over ROS: the driver's and the interferometer's services as blocking calls."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import rclpy
from dm_msgs.msg import ActuatorState
from dm_msgs.srv import Degauss, Measure, SetSignals
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from dm_common.errors import Cancelled, ErrorCode, MeasurementError, Refusal
from dm_common.messages import doubles, measurement_from, stamp_ns
from dm_common.ros import qos
from dm_common.ros.worker import ServiceCallError, call, sleep

if TYPE_CHECKING:
    from dm_common.measurement import Measurement

Floats = NDArray[np.float64]

#: Failures of a measurement that another try does not mend.
_FATAL = (ErrorCode.INTERFEROMETER_INACTIVE, ErrorCode.NOT_SUPPORTED, ErrorCode.INVALID_ARGUMENT)
#: Signals that differ less are the same command.
_SAME_SIGNAL = 1e-6
#: Wall time for a state message to confirm that the mirror still holds the command, s (it comes every 0.5 s).
_STATE_WAIT_S = 2.0
#: Longest wait for the driver when the process ends, s.
_EXIT_WAIT_S = 5.0


def _never() -> bool:
    return False


class BenchServices:
    """Driver and interferometer of one calibration; implements :class:`dm_common.measurement.Bench`.

    All methods block and belong into a worker thread.

    Attributes:
        state: the driver's last state message; None before the first.
        settle_time: s of ROS time between command and map.
        cancelled: asked while waiting.
        map_time: s of ROS time that the last map took; 0 = none was taken yet.
    """

    def __init__(self, node: Node, values: Mapping[str, Any]) -> None:
        self._node = node
        self._values = values
        self._set_signals = node.create_client(SetSignals, "set_signals")
        self._degauss = node.create_client(Degauss, "degauss")
        self._measure = node.create_client(Measure, "measure")
        self.state: ActuatorState | None = None
        self.settle_time = float(values["settle_time"])
        self.cancelled: Callable[[], bool] = _never
        self.map_time = 0.0
        self._commanded: Floats | None = None
        self._history_known = False
        node.create_subscription(ActuatorState, "actuator_state", self._on_state, qos.STATE)

    def _on_state(self, message: ActuatorState) -> None:
        self.state = message

    def check_ready(self) -> None:
        """Raise Refusal when the driver says that it takes no commands."""
        state = self.state
        if state is None or state.driver_state in (ActuatorState.STATE_ACTIVE, ActuatorState.STATE_LINK_LOST):
            return
        raise Refusal(ErrorCode.DRIVER_INACTIVE, "pdm_driver is not active: activate it first")

    def check_history(self) -> None:
        """Raise Refusal when the driver knew what the actuators went through and no longer does.

        A driver that was restarted, or lost its link, takes commands again soon; what was measured before and after
        does not belong together without a degauss between.
        """
        state = self.state
        if state is None:
            return
        if self._history_known and not state.history_known:
            self._history_known = False
            raise Refusal(
                ErrorCode.DRIVER_UNAVAILABLE,
                "pdm_driver no longer knows what the actuators went through: it was restarted or lost its link",
            )
        self._history_known = state.history_known

    def degauss(self) -> None:
        self._history_known = False
        self._call(self._degauss, Degauss.Request(), self._values["degauss_timeout"], ErrorCode.DRIVER_UNAVAILABLE)

    def apply(self, signals: Floats) -> Floats:
        request = SetSignals.Request(signals=doubles(signals), wait=True)
        response = self._call(self._set_signals, request, self._values["driver_timeout"], ErrorCode.DRIVER_UNAVAILABLE)
        self._commanded = signals
        applied = np.array(response.applied, dtype=np.float64)
        return applied if applied.shape == signals.shape else signals

    def settle(self, dwell: float = 0.0, share: float = 1.0) -> bool:
        try:
            return sleep(self._node.get_clock(), share * self.settle_time + dwell, self.cancelled)
        except TimeoutError as error:
            raise Refusal(ErrorCode.TIMEOUT, str(error)) from error

    def measure(self, label: str) -> Measurement:
        return self._measured(label, self._check_undisturbed)

    def measure_as_it_stands(self, label: str) -> Measurement:
        """Take one map of whatever stands at the mirror. Raises as `measure`."""
        return self._measured(label, lambda: None)

    def _measured(self, label: str, check: Callable[[], None]) -> Measurement:
        timeout = self._values["measure_timeout"]
        request = Measure.Request(label=label, timeout=timeout)
        began = self._node.get_clock().now()
        # The interferometer keeps the time itself; the call waits a little longer for its answer, which says why.
        try:
            response = self._call(self._measure, request, timeout + 5.0, ErrorCode.INTERFEROMETER_UNAVAILABLE)
        except Refusal as error:
            if error.error_code in _FATAL:
                raise
            raise MeasurementError(error.error_code, str(error)) from error
        self.map_time = (self._node.get_clock().now() - began).nanoseconds * 1e-9
        check()
        try:
            # The state was read after the map, so its stamp is of the write that the map shows.
            moved_ns = stamp_ns(self.state.header.stamp) if self.state is not None else 0
            return replace(measurement_from(response), moved_ns=moved_ns)
        except ValueError as error:
            raise Refusal(ErrorCode.INTERNAL, f"measure: {error}") from error

    def rest(self, signals: Floats) -> str:
        """Ramp back to `signals`, whatever was cancelled. Returns what became of it, a sentence."""
        self.cancelled = _never
        self._history_known = False
        deadline = time.monotonic() + self._values["degauss_timeout"]
        while True:
            try:
                self.apply(signals)
                return "the mirror is back at mid range"
            except Refusal as error:
                # A degauss or ramp that was cancelled here may still be running there.
                if error.error_code in (ErrorCode.BUSY, ErrorCode.PREEMPTED) and time.monotonic() < deadline:
                    time.sleep(0.2)
                    continue
                return f"the mirror could NOT be brought back to mid range: {error}"

    def rest_at_exit(self, signals: Floats) -> str:
        """The same when this process's ROS context is already shut down: over one of its own."""
        context = Context()
        rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
        node = Node(f"{self._node.get_name()}_exit", context=context, use_global_arguments=False)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        try:
            client = node.create_client(SetSignals, self._set_signals.srv_name)
            timeout = min(self._values["driver_timeout"], _EXIT_WAIT_S)
            if not client.wait_for_service(timeout_sec=timeout):
                return "the mirror could NOT be brought back to mid range: the driver does not answer"
            future = client.call_async(SetSignals.Request(signals=doubles(signals), wait=True))
            executor.spin_until_future_complete(future, timeout_sec=timeout)
            response = future.result() if future.done() else None
            if response is None or response.error_code != ErrorCode.OK:
                reason = response.message if response else f"no answer within {timeout:g} s"
                return f"the mirror could NOT be brought back to mid range: {reason}"
            return "the mirror is back at mid range"
        finally:
            node.destroy_node()
            context.try_shutdown()

    def _call(self, client: Any, request: Any, timeout_s: float, unavailable: int) -> Any:
        try:
            response = call(client, request, timeout_s, self.cancelled)
        except ServiceCallError as error:
            if self.cancelled():
                raise Cancelled("cancelled") from error
            raise Refusal(unavailable, str(error)) from error
        if response.error_code != ErrorCode.OK:
            raise Refusal(response.error_code, f"{client.srv_name}: {response.message}")
        return response

    def _check_undisturbed(self) -> None:
        """Raise Refusal when the mirror no longer holds what this node commanded: the map shows something else."""
        deadline = time.monotonic() + _STATE_WAIT_S
        while self.state is not None and self._commanded is not None:
            requested = np.array(self.state.requested, dtype=np.float64)
            if requested.shape == self._commanded.shape and np.allclose(
                requested, self._commanded, rtol=0.0, atol=_SAME_SIGNAL
            ):
                return
            if time.monotonic() > deadline or self.cancelled():
                raise Refusal(ErrorCode.PREEMPTED, "somebody else commanded the mirror meanwhile: stop them first")
            time.sleep(0.01)
