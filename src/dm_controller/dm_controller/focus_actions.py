"""The actions of the focus controller: `move_focus`, `converge` and `build_recipes`; and the driver's `degauss`."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from dm_msgs.action import BuildRecipes, Converge, Degauss, MoveFocus
from dm_msgs.msg import FocusRequest
from dm_msgs.srv import StoreRecipes
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from dm_common.errors import ErrorCode, MeasurementError, Refusal
from dm_common.hysteresis.model import HysteresisState
from dm_common.ros.bench_services import BenchServices
from dm_common.ros.clients import ThreadedActionClient
from dm_common.ros.worker import WorkerActionServer, answers_arrive, sleep
from dm_controller.conditioning import Run
from dm_controller.focus_parameters import BUILD_RECIPES, CONVERGE, MOVE_FOCUS
from dm_controller.focus_types import Order, StartDegauss
from dm_controller.planning.active_calibration import ActiveCalibration
from dm_controller.planning.target import FocusTarget

if TYPE_CHECKING:
    from dm_common.measurement import Measurement
    from dm_controller.focus_controller_node import FocusControllerNode


class LoopHost:
    """What closed loops ask of the focus controller, from any thread."""

    def __init__(self, node: FocusControllerNode) -> None:
        self._node = node

    def target(self, request: FocusRequest) -> FocusTarget:
        """The target of a request that could be carried out. Raises Refusal, as for a move."""
        outcome = self._node.order(request, dry_run=True).outcome
        if outcome.refusal is not None:
            raise outcome.refusal
        assert outcome.move is not None  # else it is refused
        return outcome.move.target

    def active_calibration(self) -> ActiveCalibration:
        """The calibration in use. Raises Refusal."""
        with self._node.controller() as (controller, _now):
            if controller.active is None:
                raise controller.not_calibrated
            return controller.active

    def hysteresis(self) -> HysteresisState | None:
        """What is known of the actuators; None = nothing."""
        with self._node.controller() as (controller, now):
            return controller.observer.estimate(now.time).state


class LoopBench(BenchServices):
    """Driver and interferometer, for one goal of either action at a time.

    Args:
        node: the hosting node.
        values: its parameters, LOOP_PARAMETERS among them.

    Attributes:
        host: what the node knows and can do.
    """

    def __init__(self, node: Node, values: Mapping[str, Any], host: LoopHost) -> None:
        own = {name: values[f"converge.{name}"] for name in ("settle_time", "driver_timeout", "measure_timeout")}
        super().__init__(node, own | {"degauss_timeout": values["recipes.degauss_timeout"]})
        self.host, self._parameters = host, values
        self._goal = threading.Lock()

    @contextmanager
    def reserved(
        self, asked: Any, text: str, cancelled: Callable[[], bool], waiting: Callable[[str], None]
    ) -> Iterator[None]:
        """Keep the bench for one goal, whose waits end when `cancelled()` becomes true.

        Args:
            asked: says who asks, see `BenchServices.held`.
            text: what requests of others are told meanwhile.
            waiting: called with what is waited for.

        Raises:
            Refusal: another goal has it, or somebody else holds the mirror.
        """
        if not self._goal.acquire(blocking=False):
            raise Refusal(ErrorCode.BUSY, "a closed loop or a run of recipes is under way; cancel it first")
        try:
            self.cancelled, self.waiting = cancelled, waiting
            with self.held(asked, f"{text}; cancel it to end it"):
                yield
        finally:
            self._goal.release()

    def degauss(self) -> None:
        """The condition that recipes begin with: the driver's own number of steps may be another."""
        self._run_degauss(int(self._parameters["recipes.degauss_steps"]))

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


def serve_loops(node: Node, values: Mapping[str, Any], host: LoopHost) -> tuple[WorkerActionServer, ...]:
    """Offer both actions, one goal at a time. What they run is loaded with the first goal: most mirrors never see one.

    Args:
        node: the hosting node.
        values: its parameters, LOOP_PARAMETERS among them.
        host: judges requests and knows the calibration in use.
    """
    bench = LoopBench(node, values, host)
    store = node.create_client(StoreRecipes, "store_recipes")

    def converge(handle: ServerGoalHandle) -> tuple[str, Any]:
        from dm_controller.converge.converge_run import ConvergeRun

        return ConvergeRun(node, values, bench).run(handle)

    def build_recipes(handle: ServerGoalHandle) -> tuple[str, Any]:
        from dm_controller.converge.recipe_run import RecipeRun

        return RecipeRun(node, values, bench, store).run(handle)

    return (
        WorkerActionServer(node, Converge, "converge", converge, fields=CONVERGE),
        WorkerActionServer(node, BuildRecipes, "build_recipes", build_recipes, fields=BUILD_RECIPES),
    )


#: How often an order is looked after, s, and how often its feedback is published.
POLL_S, FEEDBACK_S = 0.002, 0.1


class MoveFocusAction:
    """Serves `move_focus` in worker threads; the newest goal pre-empts.

    Args:
        node: hosts the action and carries the requests out.
        settle_time: s, for goals that name none.
    """

    def __init__(self, node: FocusControllerNode, settle_time: float) -> None:
        self._node, self._settle_time = node, settle_time
        self._server = WorkerActionServer(
            node, MoveFocus, "move_focus", self._run, exclusive="preempt", fields=MOVE_FOCUS
        )

    def _run(self, handle: ServerGoalHandle) -> tuple[str, Any]:
        started, result = time.monotonic(), MoveFocus.Result()
        outcome, result.error_code, result.message = self._carry_out(handle, result)
        result.duration = time.monotonic() - started
        return outcome, result

    def _carry_out(self, handle: ServerGoalHandle, result: MoveFocus.Result) -> tuple[str, int, str]:
        """Outcome, ErrorCode and message of a goal; fills the state of `result`."""
        goal, node = handle.request, self._node
        # Goals that wait for their turn may get it in another order than they came in.
        if self._to_stop(handle):
            return self._stopped(handle, None)
        handle.publish_feedback(MoveFocus.Feedback(phase=MoveFocus.Feedback.PHASE_PLAN))
        if goal.tolerance > 0.0:
            preview = node.state(node.order(goal.request, dry_run=True).outcome)
            if preview.error_code == ErrorCode.OK and preview.predicted_max_zernike > goal.tolerance:
                result.state = preview
                return (
                    "abort",
                    ErrorCode.OUT_OF_RANGE,
                    f"tolerance = {goal.tolerance * 1e9:.2f} nm: the predicted largest coefficient error is "
                    f"{preview.predicted_max_zernike * 1e9:.2f} nm; nothing moved",
                )
        order = node.order(goal.request)
        ended = self._follow(handle, order)
        result.state = node.state(order.outcome)
        if ended is not None:
            return ended
        handle.publish_feedback(MoveFocus.Feedback(phase=MoveFocus.Feedback.PHASE_SETTLE, progress=1.0))
        if not sleep(node.get_clock(), goal.settle_time or self._settle_time, lambda: self._to_stop(handle)):
            return self._stopped(handle, order)
        with node.controller() as (controller, _now):
            keeps = controller.monitor.keeps(order)
        if not keeps:
            return "abort", ErrorCode.PREEMPTED, "another command took over"
        return "succeed", ErrorCode.OK, f"the shape stands; {result.state.predicted_rms * 1e9:.1f} nm rms predicted"

    def _follow(self, handle: ServerGoalHandle, order: Order) -> tuple[str, int, str] | None:
        """Wait until the shape of `order` stands; None when it does."""
        next_feedback = 0.0
        while True:
            with self._node.controller() as (controller, now):
                progress = controller.monitor.progress(order, now.steady)
            if progress.stands:
                return None
            if progress.failed is not None:
                return "abort", progress.failed.error_code, str(progress.failed)
            if self._to_stop(handle):
                return self._stopped(handle, order)
            if time.monotonic() >= next_feedback:
                next_feedback = time.monotonic() + FEEDBACK_S
                phase = MoveFocus.Feedback.PHASE_PLAN if progress.planning else MoveFocus.Feedback.PHASE_MOVE
                handle.publish_feedback(
                    MoveFocus.Feedback(phase=phase, progress=progress.share, remaining=progress.remaining)
                )
            time.sleep(POLL_S)

    def _to_stop(self, handle: ServerGoalHandle) -> bool:
        return handle.is_cancel_requested or self._server.preempted(handle)

    def _stopped(self, handle: ServerGoalHandle, order: Order | None) -> tuple[str, int, str]:
        """End a goal early, None = before it asked for anything.

        On cancel the mirror holds the shape it has, unless it is under way to one that was asked for since; a newer
        goal goes on from there by itself.
        """
        with self._node.controller() as (controller, _now):
            waited = order is not None and controller.conditioning.withdraw(order)
        if not handle.is_cancel_requested:
            return "abort", ErrorCode.PREEMPTED, "a newer goal took over"
        if order is None:
            return "canceled", ErrorCode.CANCELED, "canceled before anything moved"
        if waited:
            return "canceled", ErrorCode.CANCELED, "canceled; the degauss under way ends at mid range"
        if self._node.stop(order):
            return "canceled", ErrorCode.CANCELED, "canceled; the mirror holds the shape it had reached"
        return "canceled", ErrorCode.CANCELED, "canceled; the mirror follows a newer request"


class DegaussClient:
    """One degauss at a time; nothing here waits.

    Args:
        node: hosts the client.
        ended: called by the executor with the number of the run, the s that it took, and the refusal; None = done.
    """

    def __init__(self, node: Node, ended: Callable[[int, float, Refusal | None], None]) -> None:
        self._node, self._ended = node, ended
        self._client = ThreadedActionClient(node, Degauss, "degauss")
        self._waiting: StartDegauss | None = None

    @property
    def offered(self) -> bool:
        """Whether the driver is there and offers it."""
        return bool(self._client.server_is_ready())

    def start(self, run: StartDegauss) -> None:
        """Call the driver, or keep `run` until the driver has discovered the client: its answer would be lost."""
        self._waiting = run
        self._call()

    def retry(self, run: Run | None) -> None:
        """Call the driver for a run that is kept, if it is still the one under way; to be asked now and then."""
        if self._waiting is not None and (run is None or run.number != self._waiting.number):
            self._waiting = None  # given up: the mirror must not swing when a driver comes back
        self._call()

    def _call(self) -> None:
        if self._waiting is None or not answers_arrive(self._client, self._client.server_is_ready):
            return
        number, steps, holder, take_over = self._waiting
        self._waiting = None
        goal = Degauss.Goal(steps=steps, holder=holder, take_over=take_over)
        # By the executor: an answer may be there already, and then this thread would take the node's lock twice.
        self._client.send_goal_async(goal).add_done_callback(
            lambda done: self._node.executor.create_task(self._accepted, number, done)
        )

    def _accepted(self, number: int, done: Any) -> None:
        done.result().get_result_async().add_done_callback(
            lambda ended: self._node.executor.create_task(self._answered, number, ended)
        )

    def _answered(self, number: int, ended: Any) -> None:
        answer, refusal = ended.result().result, None
        if answer.error_code != ErrorCode.OK:
            refusal = Refusal(answer.error_code, f"conditioning: {answer.message}")
        self._ended(number, answer.duration, refusal)
