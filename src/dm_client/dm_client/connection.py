"""One node in a thread of its own, for code that calls and waits: the latest messages, services, actions."""

import itertools
import os
import time
from collections.abc import Callable, Mapping
from typing import Any

import rclpy
from dm_msgs.msg import Calibration, Capabilities, MirrorInfo, SurfaceMapInfo
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from dm_common.errors import ErrorCode, Refusal
from dm_common.ros import qos
from dm_common.ros.clients import ServiceCallError, ThreadedActionClient, call
from dm_common.ros.executor import BackgroundExecutor
from dm_common.ros.qos import Liveliness

#: By the name of the node: message type, name and profile of a topic by which it is known to live, and what it serves.
Watched = Mapping[str, tuple[Any, str, Any, tuple[str, ...]]]
WATCHED: Watched = {
    "pdm_driver": (MirrorInfo, "mirror_info", qos.LATCHED, ("set_signals", "degauss")),
    "interferometer": (SurfaceMapInfo, "surface_map_info", qos.STATE, ("measure", "ingest_file")),
    "calibration": (
        Calibration,
        "calibration",
        qos.LATCHED,
        ("calibrate", "list_calibrations", "load_calibration", "update_calibration"),
    ),
    "focus_controller": (
        Capabilities,
        "capabilities",
        qos.LATCHED,
        ("set_focus", "flatten", "move_focus", "converge", "build_recipes"),
    ),
}
#: Of a node that does not answer; TIMEOUT for the others.
UNAVAILABLE = {
    "pdm_driver": ErrorCode.DRIVER_UNAVAILABLE,
    "interferometer": ErrorCode.INTERFEROMETER_UNAVAILABLE,
}
#: What `capabilities` say of a controller or driver that takes no requests, be it that they have not heard better yet.
RESTING = (
    ErrorCode.NODE_INACTIVE,
    ErrorCode.DRIVER_INACTIVE,
    ErrorCode.DRIVER_UNAVAILABLE,
    ErrorCode.ELECTRONICS_UNREACHABLE,
)
#: Two connections of one process need two names.
_NUMBERS = itertools.count(1)


class DeformableMirrorError(Refusal):
    """The suite refused or could not carry out a request.

    Attributes:
        error_code: a value of ErrorCode.
        response: the whole response or result, when there is one.
    """

    def __init__(self, error_code: int, message: str, response: Any = None) -> None:
        super().__init__(error_code, message)
        self.response = response


def checked(response: Any) -> Any:
    """A response or result of the suite; raise DeformableMirrorError when it is a refusal."""
    if response.error_code != 0:
        raise DeformableMirrorError(response.error_code, response.message, response)
    return response


class Connection:
    """A node that hears topics and calls the nodes of one mirror, once it is started.

    Args:
        name: of the node, a number follows.
        namespace: of the mirror, "" for none.
        domain: ROS domain; None = the environment's.
        topics: {name: (message type, quality of service)}, heard from the beginning.
        interfaces: {name: service or action type}, made at once, so that the nodes have discovered them all by the
            time the first is used.
        on_message: called with topic and message in the executor's thread, after `messages` has it.
        timeout_s: how long to wait for an answer that should come at once.
        watched: the nodes that serve the interfaces.

    Attributes:
        messages: {topic: latest message}.
        clients: {name: client of the service or action}.
    """

    def __init__(
        self,
        name: str,
        namespace: str,
        domain: int | None,
        topics: Mapping[str, tuple[Any, Any]],
        interfaces: Mapping[str, Any],
        on_message: Callable[[str, Any], None] = lambda topic, message: None,
        timeout_s: float = 10.0,
        watched: Watched = WATCHED,
    ) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node(f"{name}_{os.getpid()}_{next(_NUMBERS)}", namespace=namespace, context=self._context)
        self.messages: dict[str, Any] = {}
        self._on_message, self._timeout_s = on_message, timeout_s
        self.clients: dict[str, Any] = {}
        for topic, (message_type, profile) in topics.items():
            self.hear(topic, message_type, profile)
        self._servers: dict[str, Liveliness] = {}
        for server, (message_type, topic, profile, served) in watched.items():
            self._servers |= dict.fromkeys(served, qos.watch(self.node, server, message_type, topic, profile))
        for interface_name, interface in interfaces.items():
            make = ThreadedActionClient if hasattr(interface, "Goal") else Node.create_client
            self.clients[interface_name] = make(self.node, interface, interface_name)
        self._background: BackgroundExecutor | None = None

    def start(self) -> None:
        """Begin to hear; what is added to the node before misses nothing."""
        self._background = BackgroundExecutor(self.node)

    def close(self) -> None:
        """Leave the ROS graph; the mirror keeps its shape."""
        if self._background is not None:
            self._background.destroy_node()
        self._context.try_shutdown()

    def hear(self, topic: str, message_type: Any, profile: Any) -> None:
        """Keep the latest message of a topic from now on."""

        def take(message: Any) -> None:
            self.messages[topic] = message
            self._on_message(topic, message)

        self.node.create_subscription(message_type, topic, take, profile)

    def wait(self, condition: Callable[[], Any], timeout_s: float | None = None) -> bool:
        """Wait until `condition()` is true; False when it was not in time."""
        deadline = time.monotonic() + (self._timeout_s if timeout_s is None else timeout_s)
        while not condition():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.005)
        return True

    def call(self, name: str, request: Any, timeout_s: float | None = None) -> Any:
        """Call the service `name`; raise DeformableMirrorError when it refuses or does not answer."""
        gone = self._since_now(name)
        try:
            timeout_s = self._timeout_s if timeout_s is None else timeout_s
            return checked(call(self.clients[name], request, timeout_s, lambda: bool(gone())))
        except ServiceCallError as error:
            self._check(name, gone)
            raise DeformableMirrorError(ErrorCode.TIMEOUT, str(error)) from error

    def _since_now(self, name: str) -> Callable[[], str]:
        """What became of the node that serves `name` since this call, see `Liveliness.since_now`."""
        if name not in self._servers:
            return lambda: ""
        self._servers[name].wait_for_return()
        return self._servers[name].since_now()

    def _check(self, name: str, gone: Callable[[], str]) -> None:
        """Raise DeformableMirrorError when the node that serves `name` is `gone`."""
        if text := gone():
            code = UNAVAILABLE.get(self._servers[name].name, ErrorCode.TIMEOUT)
            raise DeformableMirrorError(code, f"{name}: {text}")

    def run_action(
        self,
        name: str,
        goal: Any,
        on_feedback: Callable[[Any], None],
        timeout_s: float,
        enough: Callable[[], bool] = lambda: False,
    ) -> Any:
        """Run a goal of the action `name` to its end; raise DeformableMirrorError when it is refused or fails.

        Once `enough()` it is cancelled as after `timeout_s`.

        Ctrl-C cancels it first, so that the mirror is left safe.
        """
        client, gone = self.clients[name], self._since_now(name)
        self._check(name, gone)
        if not self.wait(client.server_is_ready):
            raise DeformableMirrorError(ErrorCode.TIMEOUT, f"{name}: no such action; is its node running?")
        accepted = client.send_goal_async(goal, feedback_callback=lambda message: on_feedback(message.feedback))
        finished = None
        try:
            self.wait(lambda: accepted.done() or gone())
            if not accepted.done():
                self._check(name, gone)
                raise DeformableMirrorError(ErrorCode.TIMEOUT, f"{name}: no answer to the goal")
            if not accepted.result().accepted:
                raise DeformableMirrorError(ErrorCode.BUSY, f"{name}: refused, another goal is running")
            finished = accepted.result().get_result_async()
            self.wait(lambda: finished.done() or gone() or enough(), timeout_s)
            if not finished.done():
                self._check(name, gone)
                raise DeformableMirrorError(ErrorCode.TIMEOUT, f"{name}: not finished within {timeout_s:g} s")
        except BaseException:
            if not gone():
                self._cancel(accepted, finished)
            raise
        return checked(finished.result().result)

    def _cancel(self, accepted: Any, finished: Any) -> None:
        """Cancel a goal that may not be accepted yet, and wait for its end."""
        if not self.wait(accepted.done) or not accepted.result().accepted:
            return
        handle = accepted.result()
        handle.cancel_goal_async()
        self.wait((finished or handle.get_result_async()).done, 20.0)
