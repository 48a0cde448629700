"""The body of the action `degauss`."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from dm_msgs.action import Degauss
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from dm_common.errors import ErrorCode, Refusal
from dm_common.ros.worker import WorkerActionServer
from dm_driver.actuator_writer import ActuatorWriter
from dm_driver.moves import Move, Outcome

#: How often a degauss is looked after, s, and how often its feedback is published.
POLL_S, FEEDBACK_S = 0.02, 0.1
#: Time for the electronics beyond what the way back takes.
MARGIN_S = 2.0

CODE_OF_OUTCOME = {
    Outcome.REACHED: ErrorCode.OK,
    Outcome.SUPERSEDED: ErrorCode.PREEMPTED,
    Outcome.LINK_LOST: ErrorCode.ELECTRONICS_UNREACHABLE,
    Outcome.STOPPED: ErrorCode.DRIVER_INACTIVE,
}


class DegaussAction:
    """Serves `degauss` in worker threads; the newest goal pre-empts, a cancelled one slews back.

    Args:
        node: hosts the action.
        begin: a goal's move and its writer. Raises or returns Refusal.
    """

    def __init__(self, node: Node, begin: Callable[[Any], tuple[ActuatorWriter, Move] | Refusal]) -> None:
        self._begin = begin
        self._server = WorkerActionServer(node, Degauss, "degauss", self._run, exclusive="preempt")

    def _run(self, handle: ServerGoalHandle) -> tuple[str, Any]:
        began, result = time.monotonic(), Degauss.Result()
        outcome, result.error_code, result.message = self._carry_out(handle)
        result.duration = time.monotonic() - began
        return outcome, result

    def _carry_out(self, handle: ServerGoalHandle) -> tuple[str, int, str]:
        """Outcome, ErrorCode and message of a goal."""
        if handle.is_cancel_requested:
            return "canceled", ErrorCode.CANCELED, "cancelled before anything moved"
        begun = self._begin(handle.request)
        if isinstance(begun, Refusal):
            return "abort", begun.error_code, str(begun)
        writer, move = begun
        began, next_feedback = time.monotonic(), 0.0
        while (ended := move.wait(POLL_S)) is None:
            if handle.is_cancel_requested:
                return "canceled", ErrorCode.CANCELED, _slew_back(writer, move)
            if self._server.preempted(handle):
                return "abort", ErrorCode.PREEMPTED, "a newer goal took over"
            now = time.monotonic()
            if now >= next_feedback:
                next_feedback = now + FEEDBACK_S
                handle.publish_feedback(
                    Degauss.Feedback(
                        step=min(move.begun, move.steps),
                        steps=move.steps,
                        remaining=max(0.0, move.duration - (now - began)),
                    )
                )
        if ended is not Outcome.REACHED:
            return "abort", CODE_OF_OUTCOME[ended], ended.value
        return "succeed", ErrorCode.OK, f"{move.steps} half-swings in {time.monotonic() - began:.1f} s"


def _slew_back(writer: ActuatorWriter, move: Move) -> str:
    """Leave a degauss for the shape that the mirror held before; returns what became of it."""
    back = writer.turn_back(move)
    if back is None:
        return "cancelled; the mirror follows a newer command"
    ended = back.wait(writer.ramp_time(back.target) + MARGIN_S)
    if ended is Outcome.REACHED:
        return "cancelled; the mirror is back in the shape it held before, its history is not known"
    return f"cancelled; the way back to the shape held before: {ended.value if ended else 'not ended in time'}"
