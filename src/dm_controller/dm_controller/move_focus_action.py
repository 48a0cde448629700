"""The action `move_focus`: plan, command, wait until the driver reports the shape, settle."""

from __future__ import annotations

import time
from typing import Any

from dm_msgs.action import MoveFocus
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from dm_common.errors import ErrorCode
from dm_common.ros.worker import WorkerActionServer, sleep
from dm_controller.focus_host import FocusHost
from dm_controller.focus_types import Order

#: How often an order is looked after, s, and how often its feedback is published.
POLL_S, FEEDBACK_S = 0.002, 0.1


class MoveFocusAction:
    """Serves `move_focus` in worker threads; the newest goal pre-empts.

    Args:
        node: hosts the action.
        host: carries the requests out.
        settle_time: s, for goals that name none.
    """

    def __init__(self, node: Node, host: FocusHost, settle_time: float) -> None:
        self._clock, self._host, self._settle_time = node.get_clock(), host, settle_time
        self._server = WorkerActionServer(node, MoveFocus, "move_focus", self._run, exclusive="preempt")

    def _run(self, handle: ServerGoalHandle) -> tuple[str, Any]:
        started, result = time.monotonic(), MoveFocus.Result()
        outcome, result.error_code, result.message = self._carry_out(handle, result)
        result.duration = time.monotonic() - started
        return outcome, result

    def _carry_out(self, handle: ServerGoalHandle, result: MoveFocus.Result) -> tuple[str, int, str]:
        """Outcome, ErrorCode and message of a goal; fills the state of `result`."""
        goal, host = handle.request, self._host
        # Goals that wait for their turn may get it in another order than they came in.
        if self._to_stop(handle):
            return self._stopped(handle, None)
        handle.publish_feedback(MoveFocus.Feedback(phase=MoveFocus.Feedback.PHASE_PLAN))
        if goal.tolerance > 0.0:
            preview = host.state(host.order(goal.request, dry_run=True))
            if preview.error_code == ErrorCode.OK and preview.predicted_max_zernike > goal.tolerance:
                result.state = preview
                return (
                    "abort",
                    ErrorCode.OUT_OF_RANGE,
                    f"tolerance = {goal.tolerance * 1e9:.2f} nm: the predicted largest coefficient error is "
                    f"{preview.predicted_max_zernike * 1e9:.2f} nm; nothing moved",
                )
        order = host.order(goal.request)
        ended = self._follow(handle, order)
        result.state = host.state(order)
        if ended is not None:
            return ended
        handle.publish_feedback(MoveFocus.Feedback(phase=MoveFocus.Feedback.PHASE_SETTLE, progress=1.0))
        if not sleep(self._clock, goal.settle_time or self._settle_time, lambda: self._to_stop(handle)):
            return self._stopped(handle, order)
        if not host.keeps(order):
            return "abort", ErrorCode.PREEMPTED, "another command took over"
        return "succeed", ErrorCode.OK, f"the shape stands; {result.state.predicted_rms * 1e9:.1f} nm rms predicted"

    def _follow(self, handle: ServerGoalHandle, order: Order) -> tuple[str, int, str] | None:
        """Wait until the shape of `order` stands; None when it does."""
        next_feedback = 0.0
        while True:
            progress = self._host.progress(order)
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
        waited = order is not None and self._host.withdraw(order)
        if not handle.is_cancel_requested:
            return "abort", ErrorCode.PREEMPTED, "a newer goal took over"
        if order is None:
            return "canceled", ErrorCode.CANCELED, "canceled before anything moved"
        if waited:
            return "canceled", ErrorCode.CANCELED, "canceled; the degauss under way ends at mid range"
        if self._host.stop(order):
            return "canceled", ErrorCode.CANCELED, "canceled; the mirror holds the shape it had reached"
        return "canceled", ErrorCode.CANCELED, "canceled; the mirror follows a newer request"
