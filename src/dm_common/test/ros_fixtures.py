"""A ROS domain of a test's own, and a node in the test process that talks to what runs there."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions

from dm_common.ros.clients import ThreadedActionClient
from dm_common.ros.domains import own_domain
from dm_common.ros.executor import BackgroundExecutor
from waiting import wait_until


class Observer:
    """A node in the test process: publishes, records topics, calls services and actions. Use as a context manager."""

    def __init__(self, domain: int, name: str = "observer") -> None:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        rclpy.init(domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node(name)
        self._clients: dict[str, Any] = {}

    def __enter__(self) -> Observer:
        self._background = BackgroundExecutor(self.node)
        return self

    def __exit__(self, *_exception: object) -> None:
        self._background.destroy_node()
        rclpy.try_shutdown()

    def record(self, message_type: Any, topic: str, qos: QoSProfile | int = 10) -> list[Any]:
        """Return a list to which every message on `topic` is appended."""
        received: list[Any] = []
        self.node.create_subscription(message_type, topic, received.append, qos)
        return received

    def call(self, service_type: Any, name: str, request: Any = None, timeout_s: float = 30.0) -> Any:
        """Call a service and return its response."""
        if name not in self._clients:
            self._clients[name] = self.node.create_client(service_type, name)
        client = self._clients[name]
        wait_until(client.service_is_ready, max(timeout_s, 60.0), f"service {name}")
        future = client.call_async(request if request is not None else service_type.Request())
        wait_until(future.done, timeout_s, f"answer of {name}")
        return future.result()

    def send_goal(
        self, action_type: Any, name: str, goal: Any, feedback: Callable[[Any], None] | None = None
    ) -> tuple[Any, Any]:
        """Send a goal; return (goal handle, future of the result)."""
        if name not in self._clients:
            self._clients[name] = ThreadedActionClient(self.node, action_type, name)
        client = self._clients[name]
        wait_until(client.server_is_ready, 60, f"action {name}")
        accepted = client.send_goal_async(goal, feedback_callback=feedback)
        wait_until(accepted.done, 60, f"acceptance by {name}")
        handle = accepted.result()
        return handle, handle.get_result_async()

    def run_goal(self, action_type: Any, name: str, goal: Any, timeout_s: float = 120.0) -> Any:
        """Send a goal and wait for its result (the whole GetResult response: .status, .result)."""
        _, result = self.send_goal(action_type, name, goal)
        wait_until(result.done, timeout_s, f"result of {name}")
        return result.result()


@pytest.fixture
def domain() -> Iterator[int]:
    """A ROS domain of the test's own."""
    with own_domain() as number:
        yield number


@pytest.fixture
def observer(domain: int) -> Iterator[Observer]:
    """A node in the test process on the test's domain."""
    with Observer(domain) as node:
        yield node
