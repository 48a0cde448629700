"""What the actions `converge` and `build_recipes` have in common: their bench, its parameters, how a goal ends."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Protocol

from dm_msgs.msg import FocusRequest
from dm_msgs.srv import Degauss
from rclpy.node import Node

from dm_common.errors import EXPECTED, Cancelled, ErrorCode, MeasurementError, Refusal, error_code
from dm_common.hysteresis.model import HysteresisState
from dm_common.measurement import Measurement
from dm_common.ros.bench_services import BenchServices
from dm_common.ros.parameters import Parameter
from dm_controller.planning.active_calibration import ActiveCalibration
from dm_controller.planning.target import FocusTarget

#: Parameters that the hosting node declares beside those of the two actions.
BENCH_PARAMETERS = (
    Parameter("converge.settle_time", float, 0.5, "wait between command and map, in ROS time", "s", 0.0, 600.0),
    Parameter("converge.driver_timeout", float, 30.0, "longest wait for the driver to set a shape", "s", 0.1, 600.0),
    Parameter("converge.measure_timeout", float, 60.0, "longest wait for one map", "s", 0.1, 3600.0),
    Parameter("converge.measure_retries", int, 1, "further tries after a map that failed", "", 0, 20, live=True),
    Parameter("recipes.degauss_steps", int, 100, "half-swings of the degauss that recipes begin with", "", 1, 10000),
    Parameter("recipes.degauss_timeout", float, 120.0, "longest wait for a degauss", "s", 1.0, 3600.0),
)

#: Most maps that a goal may ask for.
MAPS_MAX = 100


class LoopHost(Protocol):
    """What the hosting node offers; every method may be called from any thread."""

    def target(self, request: FocusRequest) -> FocusTarget:
        """The target of a request that could be carried out; else raises Refusal."""

    def active_calibration(self) -> ActiveCalibration:
        """The calibration in use; raises Refusal when there is none."""

    def hysteresis(self) -> HysteresisState | None:
        """What is known of the actuators; None = nothing."""

    def reserve(self, text: str) -> None:
        """Refuse requests from now on, with this sentence as the reason; "" = serve them again."""


class LoopBench(BenchServices):
    """Driver and interferometer, for one goal of either action at a time.

    Args:
        node: the hosting node.
        values: its parameters, BENCH_PARAMETERS among them.

    Attributes:
        host: what the node knows and can do.
    """

    def __init__(self, node: Node, values: Mapping[str, Any], host: LoopHost) -> None:
        own = {name: values[f"converge.{name}"] for name in ("settle_time", "driver_timeout", "measure_timeout")}
        super().__init__(node, own | {"degauss_timeout": values["recipes.degauss_timeout"]})
        self.host, self._parameters = host, values
        self._goal = threading.Lock()

    @contextmanager
    def reserved(self, text: str, cancelled: Callable[[], bool]) -> Iterator[None]:
        """Keep the bench for one goal, whose waits end when `cancelled()` becomes true.

        Args:
            text: what the host says to requests meanwhile.

        Raises:
            Refusal: another goal has it.
        """
        if not self._goal.acquire(blocking=False):
            raise Refusal(ErrorCode.BUSY, "a closed loop or a run of recipes is under way; cancel it first")
        try:
            self.cancelled = cancelled
            self.host.reserve(text)
            yield
        finally:
            self.host.reserve("")
            self._goal.release()

    def degauss(self) -> None:
        """The condition that recipes begin with: the driver's own number of steps may be another."""
        request = Degauss.Request(steps=int(self._parameters["recipes.degauss_steps"]))
        self._call(self._degauss, request, self._values["degauss_timeout"], ErrorCode.DRIVER_UNAVAILABLE)

    def measure(self, label: str) -> Measurement:
        """One map. Raises MeasurementError after all tries, or Refusal when no other try can succeed."""
        left = int(self._parameters["converge.measure_retries"])
        while True:
            try:
                return super().measure(label)
            except MeasurementError:
                if left == 0 or self.cancelled():
                    raise
                left -= 1


def check_figures(goal: Any) -> None:
    """Raise ValueError naming the field of a goal of either action that makes no sense."""
    if not (math.isfinite(goal.tolerance) and goal.tolerance >= 0.0):
        raise ValueError(f"tolerance = {goal.tolerance} m: must be 0 (= configured) or above, and finite")
    if goal.max_maps > MAPS_MAX:
        raise ValueError(f"max_maps = {goal.max_maps}: must be 0 (= configured) to {MAPS_MAX}")


def ending(error: Exception) -> tuple[str, int, str]:
    """Outcome of the action, ErrorCode and sentence of a goal that `error` ended. A defect is raised again."""
    if isinstance(error, Cancelled):
        return "canceled", ErrorCode.CANCELED, str(error)
    if isinstance(error, EXPECTED):
        return "abort", error_code(error), str(error)
    if isinstance(error, TimeoutError):
        return "abort", ErrorCode.TIMEOUT, str(error)
    raise error
