"""Answers to clients that the server has not discovered yet.

A client may have discovered a server on a busy machine before that one has discovered the client. rmw_fastrtps then
waits 0.1 s for it and drops the answer, of which rclpy tells only by a warning ("client will not receive response"):
the request is carried out, and whoever asked waits for ever (ros2/rmw_fastrtps#706, ros2/rclcpp#2760).
"""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from rclpy.action import ActionServer, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.exceptions import InvalidHandle
from rclpy.impl.implementation_singleton import rclpy_implementation

#: An answer that took so long to send was dropped, s; others take less than a millisecond.
DROPPED_S = 0.09
#: After how long it is sent again, s, each counted from the one before: a client may be gone, or never match.
PAUSES_S = (0.2, 0.4, 0.8, 1.6, 3.2)


def until_discovered(send: Callable[..., None]) -> Callable[..., None]:
    """`send`, which repeats an answer that was dropped, from a thread of its own."""

    def patient(*answer: Any) -> None:
        if _dropped(send, *answer):
            _send_again(send, *answer)

    return patient


class PatientActionServer(ActionServer):
    """An action server that repeats acceptance and result of a goal when they were dropped."""

    def __init__(self, *arguments: Any, goal_callback: Callable[[Any], GoalResponse], **keywords: Any) -> None:
        self._judged = self._begun = 0.0

        def judge(goal: Any) -> GoalResponse:
            try:
                return goal_callback(goal)
            finally:
                self._judged = time.monotonic()

        def begin(goal_handle: ServerGoalHandle) -> None:
            self._begun = time.monotonic()
            goal_handle.execute()

        super().__init__(*arguments, goal_callback=judge, handle_accepted_callback=begin, **keywords)

    async def _execute_goal_request(self, request: Any) -> None:
        self._judged, self._begun = time.monotonic(), 0.0
        await super()._execute_goal_request(request)
        # rclpy sends the answer between judging a goal and beginning it.
        accepted = self._begun > self._judged
        if (self._begun if accepted else time.monotonic()) - self._judged >= DROPPED_S:
            answer = self._action_type.Impl.SendGoalService.Response(accepted=accepted)
            _send_again(self._handle.send_goal_response, request[0], answer)

    def _send_result_response(self, request_header: Any, future: Any) -> None:
        with suppress(rclpy_implementation.RCLError):  # the client may have gone
            until_discovered(self._handle.send_result_response)(request_header, future.result())


def _send_again(send: Callable[..., None], *answer: Any) -> None:
    """Have an answer that was dropped sent again until its client takes it, or for some seconds."""

    def repeat() -> None:
        with suppress(InvalidHandle, rclpy_implementation.RCLError):  # the node has ended
            for pause in PAUSES_S:
                time.sleep(pause)
                if not _dropped(send, *answer):
                    return

    threading.Thread(target=repeat, daemon=True).start()


def _dropped(send: Callable[..., None], *answer: Any) -> bool:
    began = time.monotonic()
    send(*answer)
    return time.monotonic() - began >= DROPPED_S
