"""An action client that may be used from another thread than the executor's."""

from __future__ import annotations

import threading
from typing import Any

from rclpy.action import ActionClient


class ThreadedActionClient(ActionClient):
    """`rclpy.action.ActionClient` whose requests and answers exclude each other.

    rclpy sends a request first and notes its number afterwards. An answer that the executor takes in between is thrown
    away ("Ignoring unexpected goal response"), and the caller waits for ever.
    """

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        self._sending = threading.RLock()
        super().__init__(*arguments, **keywords)

    def send_goal_async(self, *arguments: Any, **keywords: Any) -> Any:
        with self._sending:
            return super().send_goal_async(*arguments, **keywords)

    def _get_result_async(self, goal_handle: Any) -> Any:
        with self._sending:
            return super()._get_result_async(goal_handle)

    def _cancel_goal_async(self, goal_handle: Any) -> Any:
        with self._sending:
            return super()._cancel_goal_async(goal_handle)

    async def execute(self, taken_data: Any) -> None:
        with self._sending:
            await super().execute(taken_data)
