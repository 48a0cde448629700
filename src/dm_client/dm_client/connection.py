"""A node in a thread of its own, for code that calls and waits: the latest messages, services, actions."""

import atexit
import itertools
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import rclpy
from rclpy.action import ActionClient
from rclpy.client import Client
from rclpy.exceptions import InvalidNamespaceException, InvalidTopicNameException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.validate_namespace import validate_namespace

from dm_common.errors import ErrorCode, Refusal
from dm_common.ros import qos
from dm_common.ros.clients import ServiceCallError, ThreadedActionClient, call, run_goal
from dm_common.ros.executor import BackgroundExecutor
from dm_common.ros.qos import Liveliness

#: By the name of a node: message type, name and profile of the topic by which it is known to be alive, and what it
#: serves, {name: service or action type}.
Watched = Mapping[str, tuple[Any, str, Any, Mapping[str, Any]]]
#: Error code if a node does not answer; TIMEOUT for the other nodes.
UNAVAILABLE = {
    "pdm_driver": ErrorCode.DRIVER_UNAVAILABLE,
    "interferometer": ErrorCode.INTERFEROMETER_UNAVAILABLE,
}
#: Error codes in `capabilities` of a controller or driver that takes no requests; these may already be outdated.
RESTING = (
    ErrorCode.NODE_INACTIVE,
    ErrorCode.DRIVER_INACTIVE,
    ErrorCode.DRIVER_UNAVAILABLE,
    ErrorCode.ELECTRONICS_UNREACHABLE,
)
CLOSED = "the client has been closed"
ENDED = "rclpy was shut down in this process, for example by a signal"
#: Allowed ROS domains.
DOMAINS = range(233)
#: Numbers for the node names of several connections in one process.
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


def full_namespace(namespace: str) -> str:
    """A namespace as an absolute name; "/" = none. Raises DeformableMirrorError if it is not a valid one."""
    place = f"/{namespace.strip('/')}"
    try:
        validate_namespace(place)
        if "__" in place:  # rclpy takes it here, and raises an error of its parser later
            raise InvalidNamespaceException(place, "must not contain two underscores in a row", place.index("__"))
    except InvalidNamespaceException as error:
        text = f"namespace = {namespace!r}: {str(error).splitlines()[0]}"
        raise DeformableMirrorError(ErrorCode.INVALID_ARGUMENT, text) from error
    return place


class Connection:
    """A node that receives topics and calls the nodes of one mirror, once it is started.

    Args:
        name: of the node; process id and a number are appended.
        namespace: of the mirror, "" for none.
        domain: ROS domain; None = the environment's.
        topics: {name: (message type, quality of service)}, subscribed from the beginning.
        watched: the nodes that it calls. Clients of all their services and actions are made at once, so that discovery
            is complete by the time the first is used.
        on_message: called with topic and message in the executor's thread, after `messages` has it.
        timeout_s: longest wait for an answer that should come at once.

    Attributes:
        messages: {topic: latest message}.
        clients: {name: client of the service or action}.
    """

    _closed = False

    def __init__(
        self,
        name: str,
        namespace: str,
        domain: int | None,
        topics: Mapping[str, tuple[Any, Any]],
        watched: Watched,
        on_message: Callable[[str, Any], None] = lambda topic, message: None,
        timeout_s: float = 10.0,
    ) -> None:
        place, own = full_namespace(namespace), f"{name}_{os.getpid()}_{next(_NUMBERS)}"
        if domain is not None and domain not in DOMAINS:  # Fast DDS would end the process
            text = f"domain = {domain!r}: must be {DOMAINS[0]} to {DOMAINS[-1]}"
            raise DeformableMirrorError(ErrorCode.OUT_OF_RANGE, text)
        if not (isinstance(timeout_s, float | int) and timeout_s > 0):
            text = f"timeout_s = {timeout_s!r}: must be a number of seconds above 0"
            raise DeformableMirrorError(ErrorCode.OUT_OF_RANGE, text)
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
        # The command line of a launched process may set another name and namespace, which are meant for its own node.
        rules = ["--ros-args", "-r", f"__node:={own}", "-r", f"__ns:={place}"]
        self.node = Node(own, namespace=place, context=self._context, cli_args=rules)
        self.messages: dict[str, Any] = {}
        self._subscribed: set[str] = set()
        self._on_message, self._timeout_s = on_message, timeout_s
        self.clients: dict[str, Any] = {}
        for topic, (message_type, profile) in topics.items():
            self.subscribe(topic, message_type, profile)
        self._servers: dict[str, Liveliness] = {}
        for server, (message_type, topic, profile, served) in watched.items():
            self._servers |= dict.fromkeys(served, qos.watch(self.node, server, message_type, topic, profile))
            for interface_name, interface in served.items():
                make = ThreadedActionClient if hasattr(interface, "Goal") else Node.create_client
                self.clients[interface_name] = make(self.node, interface, interface_name)

    def start(self) -> None:
        """Begin to receive messages; subscriptions made before miss nothing."""
        self._background = BackgroundExecutor(self.node)
        atexit.register(self.close)  # the interpreter would abort if the thread still ran

    def close(self) -> None:
        """Leave the ROS graph; the mirror keeps its shape. Calls that wait for an answer in other threads raise.

        Raises DeformableMirrorError inside a callback, as it would wait for that callback to end.
        """
        if self._background.is_here:
            raise DeformableMirrorError(ErrorCode.BUSY, "close: not while a callback runs: call it from another thread")
        self._closed = True
        atexit.unregister(self.close)
        self._background.destroy_node()
        self._context.try_shutdown()

    def subscribe(self, topic: str, message_type: Any, profile: Any) -> bool:
        """Keep the latest message of a topic from now on; False = it is already kept.

        Raises DeformableMirrorError if the topic's name is not valid.
        """
        self._check_open()
        if topic in self._subscribed:
            return False
        self._subscribed.add(topic)

        def take(message: Any) -> None:
            self.messages[topic] = message
            self._on_message(topic, message)

        try:
            self.node.create_subscription(message_type, topic, take, profile)
        except InvalidTopicNameException as error:
            self._subscribed.discard(topic)
            text = f"topic = {topic!r}: {str(error).splitlines()[0]}"
            raise DeformableMirrorError(ErrorCode.INVALID_ARGUMENT, text) from error
        return True

    def wait(self, condition: Callable[[], Any], timeout_s: float | None = None) -> bool:
        """Wait until `condition()` is true; False on time-out.

        Raises DeformableMirrorError once the client is closed, even if `condition()` is true.
        """
        deadline = time.monotonic() + (self._timeout_s if timeout_s is None else timeout_s)
        while self._over() or not condition():
            self._check_open()
            if time.monotonic() > deadline:
                return False
            time.sleep(0.005)
        return True

    def _check_open(self) -> None:
        if over := self._over():
            raise DeformableMirrorError(ErrorCode.CANCELED, over)

    def _over(self) -> str:
        """Why nothing can be called any more; "" = it can. Handlers of `rclpy.init()` end all contexts of a process."""
        return CLOSED if self._closed else "" if self._context.ok() else ENDED

    def stamped(self, topic: str, stamp: Any, code: int = ErrorCode.TIMEOUT) -> Any:
        """The message of a topic with the given stamp; raise DeformableMirrorError if it does not arrive."""
        found: Any = None

        def arrived() -> bool:
            nonlocal found
            found = self.messages.get(topic)  # the next one may come at any moment
            return found is not None and bool(found.header.stamp == stamp)

        if not self.wait(arrived):
            raise DeformableMirrorError(code, f"the result did not arrive on {topic}")
        return found

    def call(self, name: str, request: Any, timeout_s: float | None = None, again: bool = False) -> Any:
        """Call the service `name`; raise DeformableMirrorError when it refuses or does not answer.

        A node that has just started may lose a request: with `again`, for requests that may be carried out twice, it is
        sent once more if no answer comes within the client's `timeout_s`.
        """
        with self._answered(name, ActionClient) as lost_reason:
            timeout_s = self._timeout_s if timeout_s is None else timeout_s
            again_s = self._timeout_s if again else math.inf
            response = call(self.clients[name], request, timeout_s, lost_reason, again_s, ready_s=self._timeout_s)
        return checked(response)

    def run_action(
        self,
        name: str,
        goal: Any,
        on_feedback: Callable[[Any], None],
        timeout_s: float,
        stop: Callable[[], bool] = lambda: False,
        identity: Any = None,
    ) -> Any:
        """Run a goal of the action `name` to its end; raise DeformableMirrorError when it is refused or fails.

        Ctrl-C, `stop` and any exception in `on_feedback`, which is raised here, cancel the goal, so that the mirror is
        left in a safe state; `identity`: see `run_goal`.
        """
        failed = list[BaseException]()

        def take(feedback: Any) -> None:
            self._servers[name].heard()  # feedback proves that the node lives, even if a busy machine missed its lease
            try:
                if not failed:
                    on_feedback(feedback)
            except BaseException as error:  # raised in the executor it would end the whole process
                failed.append(error)

        try:
            with self._answered(name, Client) as lost_reason:
                result = run_goal(
                    self.clients[name],
                    goal,
                    timeout_s,
                    answer_s=self._timeout_s,
                    on_feedback=take,
                    stop=lambda: bool(failed) or stop(),
                    server_lost=lost_reason,
                    identity=identity,
                )
        finally:
            if failed:
                raise failed[0]
        return checked(result)

    @contextmanager
    def _answered(self, name: str, not_a: type) -> Iterator[Callable[[], str]]:
        """Raise DeformableMirrorError if `name` does not answer, or has a client of the kind `not_a`.

        Yields a function that returns why its node has gone since then; "" = it has not.
        """
        self._check_open()
        if self._background.is_here:
            text = f"{name}: no answer comes while a callback waits for it: call it from another thread"
            raise DeformableMirrorError(ErrorCode.BUSY, text)
        named = [each for each, client in self.clients.items() if not isinstance(client, not_a)]
        if name not in named:
            text = f"{name!r}: must be one of {', '.join(named)}"
            raise DeformableMirrorError(ErrorCode.UNKNOWN_NAME, text)
        server = self._servers[name]
        server.wait_for_return()
        lost = server.since_now()

        def lost_reason() -> str:
            return self._over() or lost()

        try:
            yield lost_reason
        except Exception as error:
            if over := self._over():  # whatever rclpy reports of destroyed objects
                raise DeformableMirrorError(ErrorCode.CANCELED, f"{name}: {over}") from error
            if not isinstance(error, ServiceCallError):
                raise
            code, text = error.error_code, str(error)
            client = self.clients[name]
            served = client.server_is_ready if isinstance(client, ActionClient) else client.service_is_ready
            if reason := lost() or (server.text if server.missing(served) else ""):
                code, text = UNAVAILABLE.get(server.name, ErrorCode.TIMEOUT), f"{name}: {reason}"
            raise DeformableMirrorError(code, text) from error
