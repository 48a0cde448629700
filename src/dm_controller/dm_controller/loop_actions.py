"""The closed loops of the focus controller: actions `converge` and `build_recipes`, and what they ask of the node."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from dm_msgs.action import BuildRecipes, Converge
from dm_msgs.msg import Calibration, FocusRequest
from dm_msgs.srv import StoreRecipes

from dm_common.errors import EXPECTED, ErrorCode, MeasurementError, error_code
from dm_common.hysteresis.model import HysteresisState
from dm_common.ros import qos
from dm_common.ros.bench_services import BenchServices
from dm_common.ros.worker import WorkerActionServer, WorkerGoal, wait_for_clock
from dm_controller.focus_actions import FocusHost
from dm_controller.focus_parameters import BUILD_RECIPES, CONVERGE
from dm_controller.planning.active_calibration import ActiveCalibration
from dm_controller.planning.planner import Move

if TYPE_CHECKING:
    from dm_common.measurement import Measurement

#: Text of refusals while a goal of an action runs.
BUSY = {
    "converge": "a closed loop (action converge) is running",
    "build_recipes": "recipes are being built (action build_recipes)",
}
#: How a goal ends, by its ErrorCode; "abort" with any other.
OUTCOMES: dict[int, str] = {ErrorCode.OK: "succeed", ErrorCode.CANCELED: "canceled"}


def loop_times(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """The settings of `BenchServices`, from the parameters of the node, which may change while it is inactive."""
    own = {name: values[f"converge.{name}"] for name in ("settle_time", "driver_timeout", "measure_timeout")}
    return own | {"degauss_timeout": values["recipes.degauss_timeout"]}


class LoopBench(BenchServices):
    """Driver and interferometer for one goal of either action at a time, with what the focus controller knows.

    Attributes:
        parameters: of `node`.
    """

    def __init__(self, node: FocusHost, values: Mapping[str, Any]) -> None:
        super().__init__(node, loop_times(values))
        self._host, self.parameters = node, values
        self._goal = threading.Lock()
        self._needed: qos.Liveliness | None = None
        self._by_history = False

    def run(
        self,
        name: str,
        handle: WorkerGoal,
        feedback: Any,
        request: Any,
        body: Callable[[], tuple[int, str]],
        needed: qos.Liveliness | None = None,
        history: bool = False,
    ) -> tuple[str, int, str]:
        """Outcome, ErrorCode and sentence of a goal of the action `name`, which has the bench for itself.

        Cancelling the goal ends waits, and its feedback names them.

        Args:
            request: the goal or request, which names the client, see `BenchServices.held`.
            needed: a node that the goal needs besides driver and interferometer.
            history: whether a map is valid only if the driver has known the actuators' history since the degauss.
        """
        busy = "a closed loop or a run of recipes is under way; cancel it first, or take the mirror over"
        timeout = self.parameters["converge.driver_timeout"]
        try:
            self.hold.wait_for(lambda: self._goal.acquire(blocking=False), request, busy, timeout)
            try:
                self._values, self._needed, self._by_history = loop_times(self.parameters), needed, history
                self.settle_time = self._values["settle_time"]
                self.cancelled = lambda: bool(handle.is_cancel_requested)
                self.publish_waits(handle, feedback)
                with self.held(request, f"{BUSY[name]}; cancel it to end it"):
                    code, text = body()
            finally:
                self._goal.release()
        except EXPECTED as error:
            code, text = error_code(error), str(error)
        # One line per severity: rclpy ties a severity to the line that logs.
        if code == ErrorCode.OK:
            self._node.get_logger().info(f"{name}: {text}")
        else:
            self._node.get_logger().warning(f"{name}: {text}")
        return OUTCOMES.get(code, "abort"), code, text

    def move(self, request: FocusRequest) -> Move:
        """The move that a request would make. Raises Refusal."""
        order = self._host.order(request, dry_run=True)
        if order.refusal is not None:
            raise order.refusal
        assert order.move is not None  # else it is refused
        return order.move

    def active_calibration(self) -> ActiveCalibration:
        """The calibration in use. Raises Refusal."""
        with self._host.controller() as (controller, _now):
            if controller.active is None:
                raise controller.not_calibrated
            return controller.active

    def hysteresis(self) -> HysteresisState | None:
        """Estimated state of the actuators; None = not known."""
        with self._host.controller() as (controller, now):
            return controller.observer.estimate(now.time).state

    def _missing(self) -> str:
        needed = self._needed
        return super()._missing() or (needed.text if needed is not None and needed.missing() else "")

    def check_ready(self) -> None:
        """Check the driver, and wait until ROS time runs. Raises ClockError if it does not."""
        super().check_ready()
        wait_for_clock(self._node.get_clock())

    def now(self) -> float:
        """ROS time, s."""
        return 1e-9 * float(self._node.get_clock().now().nanoseconds)

    def degauss(self, steps: int = 0) -> None:
        """Degauss with the number of half-swings that recipes begin with, which may differ from the driver's."""
        super().degauss(steps or int(self.parameters["recipes.degauss_steps"]))
        self._history_known = self._by_history  # from here on, so that a loss before the first map counts too

    def measure(self, label: str) -> Measurement:
        """One map. Raises MeasurementError after all tries, or Refusal when no other try can succeed."""
        left = int(self.parameters["converge.measure_retries"])
        while True:
            try:
                measured = super().measure(label)
                if self._by_history:
                    self.check_history()
                return measured
            except MeasurementError:
                if left == 0 or self.cancelled():
                    raise
                left -= 1


def serve_loops(node: FocusHost, values: Mapping[str, Any]) -> None:
    """Offer both actions, one goal at a time. Their code is loaded with the first goal: most mirrors never need it."""
    bench = LoopBench(node, values)
    store = node.create_client(StoreRecipes, "store_recipes")
    calibration = qos.watch(node, "calibration", Calibration, "calibration", qos.LATCHED)

    def converge(handle: WorkerGoal) -> tuple[str, Any]:
        from dm_controller.converge.converge_run import run_converge

        return run_converge(bench, handle)

    def build_recipes(handle: WorkerGoal) -> tuple[str, Any]:
        from dm_controller.converge.recipe_run import RecipeRun

        return RecipeRun(bench, store, calibration).run(handle)

    WorkerActionServer(node, Converge, "converge", converge, fields=CONVERGE)
    WorkerActionServer(node, BuildRecipes, "build_recipes", build_recipes, fields=BUILD_RECIPES)
