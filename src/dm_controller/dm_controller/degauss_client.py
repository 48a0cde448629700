"""The driver's service `degauss`, called for the focus controller."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from dm_msgs.srv import Degauss
from rclpy.node import Node

from dm_common.errors import ErrorCode, Refusal
from dm_common.ros.worker import answers_arrive
from dm_controller.conditioning import Run
from dm_controller.focus_types import StartDegauss


class DegaussClient:
    """One degauss at a time; nothing here waits.

    Args:
        node: hosts the client.
        ended: called by the executor with the number of the run, the s that it took, and the refusal; None = done.
    """

    def __init__(self, node: Node, ended: Callable[[int, float, Refusal | None], None]) -> None:
        self._node, self._ended = node, ended
        self._client = node.create_client(Degauss, "degauss")
        self._waiting: StartDegauss | None = None
        self._called: Any = None

    @property
    def offered(self) -> bool:
        """Whether the driver is there and offers it."""
        return bool(self._client.service_is_ready())

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
        if self._waiting is None or not answers_arrive(self._client, self._client.service_is_ready):
            return
        number, steps = self._waiting
        self._waiting = None
        if self._called is not None:
            self._client.remove_pending_request(self._called)
        self._called = self._client.call_async(Degauss.Request(steps=steps))
        # By the executor: the answer may be there already, and then this thread would take the node's lock twice.
        self._called.add_done_callback(lambda done: self._node.executor.create_task(self._answered, number, done))

    def _answered(self, number: int, done: Any) -> None:
        answer, refusal = done.result(), None
        if answer.error_code != ErrorCode.OK:
            refusal = Refusal(answer.error_code, f"conditioning: {answer.message}")
        self._ended(number, answer.duration, refusal)
