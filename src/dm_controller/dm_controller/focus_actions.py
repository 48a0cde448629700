"""Interfaces for requests: services `set_focus` and `flatten`, action `move_focus`; client of the driver's degauss."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from copy import copy
from typing import Any

from dm_msgs.action import Degauss, MoveFocus
from dm_msgs.msg import Calibration, FocusRequest, FocusState
from dm_msgs.srv import Flatten, SetFocus
from rclpy.node import Node

from dm_common.errors import ClockError, ErrorCode, Refusal
from dm_common.ros import qos
from dm_common.ros.clients import ThreadedActionClient
from dm_common.ros.lifecycle import Health, ManagedNode
from dm_common.ros.worker import WorkerActionServer, WorkerGoal, WorkerService, sleep
from dm_common.values import fill_with_nan
from dm_controller.driver_monitor import CONFIRM_S
from dm_controller.focus_controller import FocusController
from dm_controller.focus_messages import health
from dm_controller.focus_parameters import MOVE_FOCUS, PARAMETERS
from dm_controller.focus_types import Effect, Moment, Order, Progress, StartDegauss

#: Polling period of an order, s, by an action and by a service; period of feedback, s.
POLL_S, SERVICE_POLL_S, FEEDBACK_S = 0.002, 0.001, 0.1
#: Further wait for a confirmation after the controller should have given the command up itself, s.
GRACE_S = 1.0
#: Time after the start, s, within which a request waits for calibration, driver and clock.
START_S = 3.0


class FocusHost(ManagedNode, ABC):
    """The services, actions and lifecycle of the node: only one thread at a time uses the controller."""

    def __init__(self, on_change: Callable[[Mapping[str, Any]], None], **keywords: Any) -> None:
        super().__init__("focus_controller", PARAMETERS, on_change, **keywords)
        self._lock, self._controller = threading.Lock(), FocusController(self._values)
        self._started = time.monotonic()
        self._degauss = DegaussClient(self, self._degauss_ended)
        self._controller.degauss_offered = lambda: self._degauss.offered
        WorkerService(self, SetFocus, "set_focus", self._on_set_focus)
        WorkerService(self, Flatten, "flatten", self._on_flatten)
        MoveFocusAction(self, self._values)
        self.calibration_node = qos.watch(self, "calibration", Calibration, "calibration", qos.LATCHED)

    @abstractmethod
    def controller(self) -> AbstractContextManager[tuple[FocusController, Moment]]:
        """The controller, locked for one thread at a time, and the present time."""

    @abstractmethod
    def order(self, message: FocusRequest, dry_run: bool = False) -> Order:
        """Judge a request and, unless it is refused or a dry run, carry it out."""

    @abstractmethod
    def carry_out(self, effects: Iterable[Effect], now: Moment) -> None:
        """Carry out the effects that the controller returns."""

    @abstractmethod
    def state(self, order: Order) -> FocusState:
        """The state message of an order that does not change meanwhile."""

    def deactivate(self) -> None:
        with self.controller() as (controller, now):
            self.carry_out(controller.rest(Refusal(ErrorCode.NODE_INACTIVE, self.inactive()), now), now)

    def clean_up(self) -> None:
        self.deactivate()  # the refusal has another text

    def refused(self, reason: str) -> None:
        self.deactivate()

    def health(self) -> Health:
        calibration = self.calibration_node
        with self.controller() as (controller, now):
            return health(controller, self._values, now, calibration.text if calibration.missing() else "")

    def _degauss_ended(self, number: int, duration: float, refusal: Refusal | None) -> None:
        with self.controller() as (controller, now):
            self.carry_out(controller.degauss_answered(number, now, duration, refusal), now)

    def stop(self, order: Order) -> bool:
        """Stop the move of an order where it is; returns False if another shape was asked for since."""
        with self.controller() as (controller, now):
            effects = controller.stop(order, now)
            self.carry_out(effects or (), now)
        return effects is not None

    def answer(self, order: Order) -> FocusState:
        """The state message of an order as it is now."""
        with self._lock:
            so_far = copy(order)
        return self.state(so_far)

    def await_start(self) -> None:
        """Wait until calibration, driver and simulated time are known, at most until `START_S` after the start."""
        while time.monotonic() < self._started + START_S:
            with self.controller() as (controller, now):
                refusal = controller.unavailable(now)
            unheard = refusal and refusal.error_code in (ErrorCode.NOT_CALIBRATED, ErrorCode.DRIVER_UNAVAILABLE)
            if now.ns and not unheard:
                return
            time.sleep(POLL_S)

    def _on_set_focus(self, request: SetFocus.Request, response: SetFocus.Response) -> SetFocus.Response:
        return self._serve(request.request, request.dry_run, response)

    def _on_flatten(self, request: Flatten.Request, response: Flatten.Response) -> Flatten.Response:
        flat = FocusRequest(holder=request.holder, take_over=request.take_over)
        return self._serve(flat, request.dry_run, response)

    def _serve(self, request: FocusRequest, dry_run: bool, response: Any) -> Any:
        """The answer, or a function that waits for the driver's confirmation first, in a thread of its own."""
        self.await_start()
        order = self.order(request, dry_run)
        deadline = time.monotonic() + GRACE_S + (self._values["driver_timeout"] or CONFIRM_S)

        def end() -> Any:
            """Wait for the driver. Meanwhile the next request is served; if it moves the mirror, it ends this wait."""
            while waits := not (dry_run or order.pending or order.applied or order.refusal):
                if time.monotonic() > deadline:
                    break
                time.sleep(SERVICE_POLL_S)
            response.state = state = self.answer(order)
            response.error_code, response.message = state.error_code, state.message
            if waits:
                response.error_code = ErrorCode.TIMEOUT
                response.message = "the driver has not confirmed the command in time"
            return response

        return end() if dry_run or order.refusal else end


class MoveFocusAction:
    """Serves `move_focus` in worker threads; the newest goal pre-empts."""

    def __init__(self, node: FocusHost, values: Mapping[str, Any]) -> None:
        self._node, self._values = node, values
        self._server = WorkerActionServer(
            node, MoveFocus, "move_focus", self._run, exclusive="preempt", fields=MOVE_FOCUS, admit=self._admit
        )

    def _admit(self, goal: MoveFocus.Goal) -> None:
        """Raise the Refusal of a goal that would be refused: it must not end the goal that is running."""
        if self._server.busy:
            with self._node.controller() as (controller, now):
                order = controller.request(goal.request, now, dry_run=True)[0]
                refusal = order.refusal or controller.monitor.held(goal.request)
            if refusal is not None:
                raise refusal

    def _run(self, handle: WorkerGoal) -> tuple[str, Any]:
        started, result = time.monotonic(), fill_with_nan(MoveFocus.Result())
        try:
            outcome, result.error_code, result.message = self._carry_out(handle, result)
        except ClockError as error:
            outcome, result.error_code, result.message = "abort", error.error_code, str(error)
        result.duration = time.monotonic() - started
        return outcome, result

    def _carry_out(self, handle: WorkerGoal, result: MoveFocus.Result) -> tuple[str, int, str]:
        """Outcome, ErrorCode and message of a goal; fills the state of `result`."""
        goal, node = handle.request, self._node
        # Goals that wait may get their turn in another order than they came in.
        if self._to_stop(handle):
            return self._stopped(handle, None)
        handle.publish_feedback(MoveFocus.Feedback(phase="planning"))
        node.await_start()
        if goal.tolerance > 0.0:
            preview = node.state(node.order(goal.request, dry_run=True))
            if preview.error_code == ErrorCode.OK and preview.predicted_max_zernike > goal.tolerance:
                result.state = preview
                return (
                    "abort",
                    ErrorCode.OUT_OF_RANGE,
                    f"tolerance = {goal.tolerance * 1e9:.3g} nm: the predicted largest coefficient error is "
                    f"{preview.predicted_max_zernike * 1e9:.3g} nm; nothing moved",
                )
        order = node.order(goal.request)
        ended = self._follow(handle, order)
        result.state = node.answer(order)
        if ended is not None:
            return ended
        handle.publish_feedback(MoveFocus.Feedback(phase="settling", progress=1.0))
        settle = goal.settle_time or self._values["settle_time"]
        if not sleep(node.get_clock(), settle, lambda: self._to_stop(handle) or bool(self._progress(order).failed)):
            return self._follow(handle, order) or self._stopped(handle, order)
        text = f"the shape is reached; {result.state.predicted_rms * 1e9:.1f} nm rms predicted"
        return self._follow(handle, order) or ("succeed", ErrorCode.OK, text)

    def _follow(self, handle: WorkerGoal, order: Order) -> tuple[str, int, str] | None:
        """Wait until the shape of `order` is reached; returns None when it is."""
        next_feedback = 0.0
        while True:
            progress = self._progress(order)
            if progress.reached:
                return None
            if progress.failed is not None:
                return "abort", progress.failed.error_code, str(progress.failed)
            if self._to_stop(handle):
                return self._stopped(handle, order)
            if time.monotonic() >= next_feedback:
                next_feedback = time.monotonic() + FEEDBACK_S
                phase = "planning" if progress.planning else "moving"
                handle.publish_feedback(
                    MoveFocus.Feedback(phase=phase, progress=progress.share, remaining=progress.remaining)
                )
            time.sleep(POLL_S)

    def _progress(self, order: Order) -> Progress:
        with self._node.controller() as (controller, now):
            return controller.monitor.progress(order, now.steady)

    def _to_stop(self, handle: WorkerGoal) -> bool:
        return handle.is_cancel_requested or self._server.preempted(handle)

    def _stopped(self, handle: WorkerGoal, order: Order | None) -> tuple[str, int, str]:
        """End a goal early; `order` None = before it asked for anything.

        After a cancel the mirror holds the shape it has, unless it is on its way to one that was asked for since; a
        newer goal continues from there by itself.
        """
        waited, ended = False, Refusal(ErrorCode.CANCELED, "it was cancelled during the degauss")
        if not (cancelled := handle.is_cancel_requested):
            ended = Refusal(ErrorCode.PREEMPTED, "a newer goal took over")
        with self._node.controller() as (controller, now):
            if order is not None and (waited := controller.conditioning.withdraw(order)):
                self._node.carry_out(controller.refuse(order, ended, now), now)
        if not cancelled:
            return "abort", ended.error_code, str(ended)
        if order is None:
            return "canceled", ErrorCode.CANCELED, "canceled before anything moved"
        if waited:
            return "canceled", ErrorCode.CANCELED, "canceled; the degauss under way ends at mid range"
        if self._node.stop(order):
            return "canceled", ErrorCode.CANCELED, "canceled; the mirror holds the shape it had reached"
        return "canceled", ErrorCode.CANCELED, "canceled; the mirror follows a newer request"


class DegaussClient:
    """Calls the driver's degauss; no method waits.

    Args:
        ended: called by the executor with the number of the run, its duration in s, and the refusal (None = done).
    """

    def __init__(self, node: Node, ended: Callable[[int, float, Refusal | None], None]) -> None:
        self._node, self._ended = node, ended
        self._client = ThreadedActionClient(node, Degauss, "degauss")

    @property
    def offered(self) -> bool:
        """Whether the driver is running and offers the action."""
        return bool(self._client.server_is_ready())

    def start(self, run: StartDegauss) -> None:
        """Call the driver. If it has just died, no answer comes, and `Conditioning.failure` ends the run."""
        goal = Degauss.Goal(steps=run.steps, holder=run.holder, take_over=run.take_over)
        # Through the executor: if the answer is there already, this thread would take the node's lock twice.
        self._client.send_goal_async(goal).add_done_callback(
            lambda done: self._node.executor.create_task(self._accepted, run.number, done)
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
