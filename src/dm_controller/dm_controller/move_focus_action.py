"""The action `move_focus`: plan, command, wait until the driver reports the shape, settle."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from dm_msgs.action import MoveFocus
from dm_msgs.msg import ActuatorState, FocusRequest, FocusState
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from dm_common.errors import ErrorCode
from dm_common.ros.worker import WorkerActionServer, sleep
from dm_controller.conditioning import Waiting
from dm_controller.driver_watch import DriverWatch

#: How a goal ends whose shape somebody else replaced.
_SUPERSEDED = ("abort", ErrorCode.PREEMPTED, "another command took over")


class MoveFocusAction:
    """Serves `move_focus` in worker threads; the newest goal pre-empts.

    Args:
        node: hosts the action.
        carry_out: (request, dry_run): judge a request and, unless it is refused or a dry run, send it. Returns its
            state and, when the mirror is conditioned first, what waits for the end of that.
        drop: do not carry out what waits; False = it has been.
        standing: (signals) -> what was last sent to keep the shape that these (N,) asked for, which may be corrected
            for creep; None = another shape was asked for since.
        stop: (signals) leave the move to these (N,) where it is; False = another shape was asked for since.
        driver: its reports.
        values: parameters `settle_time` and `move_timeout`.
    """

    def __init__(
        self,
        node: Node,
        carry_out: Callable[[FocusRequest, bool], tuple[FocusState, Waiting | None]],
        drop: Callable[[Waiting], bool],
        standing: Callable[[Any], Any],
        stop: Callable[[Any], bool],
        driver: DriverWatch,
        values: Mapping[str, Any],
    ) -> None:
        self._clock = node.get_clock()
        self._carry_out, self._drop, self._standing, self._stop_move = carry_out, drop, standing, stop
        self._driver, self._values = driver, values
        self._server = WorkerActionServer(node, MoveFocus, "move_focus", self._run, exclusive="preempt")

    def _run(self, goal_handle: ServerGoalHandle) -> tuple[str, Any]:
        started = time.monotonic()
        goal, result = goal_handle.request, MoveFocus.Result()

        def end(outcome: str, error_code: int, message: str) -> tuple[str, Any]:
            result.error_code, result.message = error_code, message
            result.duration = time.monotonic() - started
            return outcome, result

        # Goals that wait for their turn may get it in another order than they came in.
        if self._told_to_stop(goal_handle):
            return end(*self._stop(goal_handle))
        goal_handle.publish_feedback(MoveFocus.Feedback(phase=MoveFocus.Feedback.PHASE_PLAN))
        if goal.tolerance > 0.0:
            preview, _ = self._carry_out(goal.request, True)
            if preview.error_code == ErrorCode.OK and preview.predicted_max_zernike > goal.tolerance:
                result.state = preview
                return end(
                    "abort",
                    ErrorCode.OUT_OF_RANGE,
                    f"tolerance = {goal.tolerance * 1e9:.2f} nm: the predicted largest coefficient error is "
                    f"{preview.predicted_max_zernike * 1e9:.2f} nm; nothing moved",
                )
        result.state, waiting = self._carry_out(goal.request, False)
        if waiting is not None:
            stopped = self._await_conditioning(goal_handle, waiting, result.state.predicted_duration)
            if stopped is not None:
                return end(*stopped)
            assert waiting.state is not None
            result.state = waiting.state
        if result.state.error_code != ErrorCode.OK:
            return end("abort", result.state.error_code, result.state.message)
        wanted = np.asarray(result.state.signals)
        stopped = self._await_shape(goal_handle, wanted)
        if stopped is not None:
            outcome, error_code, message = stopped
            return end(outcome, error_code, message)
        settle = goal.settle_time or self._values["settle_time"]
        goal_handle.publish_feedback(MoveFocus.Feedback(phase=MoveFocus.Feedback.PHASE_SETTLE, progress=1.0))
        if not sleep(self._clock, settle, lambda: self._told_to_stop(goal_handle)):
            return end(*self._stop(goal_handle, wanted))
        if self._standing(wanted) is None:
            return end(*_SUPERSEDED)
        return end(
            "succeed", ErrorCode.OK, f"the shape stands; {result.state.predicted_rms * 1e9:.1f} nm rms predicted"
        )

    def _told_to_stop(self, goal_handle: ServerGoalHandle) -> bool:
        return goal_handle.is_cancel_requested or self._server.preempted(goal_handle)

    def _stop(self, goal_handle: ServerGoalHandle, wanted: np.ndarray | None = None) -> tuple[str, int, str]:
        """End a goal early, None = before it sent anything.

        On cancel the mirror holds the shape it has, unless it is under way to one that was asked for since; a newer
        goal goes on from there by itself.
        """
        if not goal_handle.is_cancel_requested:
            return "abort", ErrorCode.PREEMPTED, "a newer goal took over"
        if wanted is None:
            return "canceled", ErrorCode.CANCELED, "canceled before anything moved"
        if self._stop_move(wanted):
            return "canceled", ErrorCode.CANCELED, "canceled; the mirror holds the shape it had reached"
        return "canceled", ErrorCode.CANCELED, "canceled; the mirror follows a newer request"

    def _await_conditioning(
        self, goal_handle: ServerGoalHandle, waiting: Waiting, expected_s: float
    ) -> tuple[str, int, str] | None:
        """Wait until the mirror is degaussed and the command is out; None when it is, or was refused."""
        started, next_feedback = time.monotonic(), 0.0
        while not waiting.done:
            if self._told_to_stop(goal_handle) and self._drop(waiting):
                if goal_handle.is_cancel_requested:
                    return "canceled", ErrorCode.CANCELED, "canceled; the degauss under way ends at mid range"
                return "abort", ErrorCode.PREEMPTED, "a newer goal took over"
            elapsed = time.monotonic() - started
            if elapsed >= next_feedback:
                next_feedback = elapsed + 0.1
                progress = min(1.0, elapsed / expected_s) if expected_s > 0.0 else 0.0
                goal_handle.publish_feedback(MoveFocus.Feedback(phase=MoveFocus.Feedback.PHASE_PLAN, progress=progress))
            time.sleep(0.002)
        return None

    def _await_shape(self, goal_handle: ServerGoalHandle, wanted: np.ndarray) -> tuple[str, int, str] | None:
        """Wait until the driver reports the wanted shape; None when it stands."""
        deadline = time.monotonic() + self._values["move_timeout"]
        next_feedback, first_gap, taken = 0.0, 0.0, False
        while True:
            if self._told_to_stop(goal_handle):
                return self._stop(goal_handle, wanted)
            sent, driver = self._standing(wanted), self._driver.latest
            if sent is None:
                return _SUPERSEDED
            if driver is not None and driver.driver_state != ActuatorState.STATE_ACTIVE:
                return (
                    "abort",
                    ErrorCode.ELECTRONICS_UNREACHABLE,
                    f"the driver left its active state: {driver.message}",
                )
            if silent := self._driver.silent:
                return "abort", ErrorCode.DRIVER_UNAVAILABLE, silent
            if driver is not None and len(driver.requested) == len(driver.applied) == len(wanted):
                gap = float(np.abs(np.asarray(driver.applied) - wanted).max())
                first_gap = max(first_gap, gap)
                ours = any(np.allclose(driver.requested, signals, rtol=0.0, atol=1e-9) for signals in (wanted, sent))
                if ours and not driver.moving:
                    return None
                if taken and not ours:
                    return _SUPERSEDED
                taken = ours
                if time.monotonic() >= next_feedback:
                    next_feedback = time.monotonic() + 0.1
                    goal_handle.publish_feedback(
                        MoveFocus.Feedback(
                            phase=MoveFocus.Feedback.PHASE_MOVE,
                            progress=1.0 - gap / first_gap if first_gap else 1.0,
                            remaining=gap,
                        )
                    )
            if time.monotonic() > deadline:
                message = (
                    driver.message if driver is not None and driver.message else "the driver did not report the shape"
                )
                return "abort", ErrorCode.TIMEOUT, message
            time.sleep(0.002)
