"""Record the topics of a suite, whatever their type, as they arrive."""

from __future__ import annotations

import itertools
import math
import os
import queue
import re
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from rcl_interfaces.msg import Parameter, ParameterEvent, ParameterType
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions

from dm_bringup.nodes import NAMES
from dm_tools.recording.bag import PARAMETER_EVENTS, BagWriter, Topic, offered
from dm_tools.recording.interfaces import UnknownTypeError, definition, message_class

#: How often new topics are looked for, s.
DISCOVERY_PERIOD_S = 0.25
#: A node is asked for its parameters again after this time, s: just after a start, request or answer may be lost.
RETRY_S = 5.0
#: Messages that a subscription holds while the writer is busy.
DEPTH = 100
#: Bytes that may wait for the writer; messages beyond are lost, and counted.
WAITING_MAX = 500_000_000
#: Longest sleep of the executor, s; only bounds how soon it ends.
SPIN_S = 0.1
#: The writer flushes after this time without a message, s; with `FLUSH_NS` no message waits longer than five seconds.
IDLE_S = 1.0
#: Topic of the maps themselves, several megabytes each; the results of their fits are on other topics.
MAP_TOPIC = "surface_map"

#: Topics that all mirrors of a domain share.
COMMON = ("/diagnostics", "/rosout", "/clock", "/tf", "/tf_static", PARAMETER_EVENTS)


class Recorder:
    """Records from its creation until the end of its `with` block.

    Args:
        folder: of the new recording.
        namespace: record only topics in it, and those that all share; "" = all.
        topics: only these, by their names with or without namespace; empty = all.
        maps: whether to record the maps themselves.
        domain: ROS domain; None = the environment's.

    Attributes:
        refused: topics not recorded, or not every message of them, with the reason.

    Raises:
        FileExistsError, OSError: the recording cannot be written.
    """

    def __init__(
        self,
        folder: Path,
        namespace: str = "",
        topics: Sequence[str] = (),
        maps: bool = True,
        domain: int | None = None,
    ) -> None:
        self.refused: dict[str, str] = {}
        self._namespace = f"/{namespace.strip('/')}/" if namespace.strip("/") else "/"
        self._wanted = {name if name.startswith("/") else self._namespace + name for name in topics}
        self._maps = maps
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()  # of the writer; None = the end
        self._received, self._written = 0, 0  # bytes; each is counted in one thread only
        self._failure: Exception | None = None
        self._stopping = False
        # Times are of a clock that is never set: messages keep their order.
        self._since_ns = time.time_ns() - time.monotonic_ns()
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
        try:
            self._bag = BagWriter(folder)  # once ROS has started: else it would leave a folder
        except BaseException:
            self._context.try_shutdown()
            raise
        self._node = Node(f"dm_recorder_{os.getpid()}", context=self._context)
        self._writer = threading.Thread(target=self._write, name="bag_writer", daemon=True)
        self._writer.start()
        self._subscribed: set[str] = set()
        self._clients: dict[str, AsyncParameterClient] = {}
        # By publisher of a node's parameter events: when to ask it again (monotonic, s); when it was first seen, ns.
        self._retry_at: dict[bytes, float] = {}
        self._seen: dict[bytes, int] = {}
        self._discover()
        self._node.create_timer(DISCOVERY_PERIOD_S, self._discover)
        # The events executor cannot pass on serialised messages (it fails on raw subscriptions).
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._spinning = threading.Thread(target=self._spin, name="recorder", daemon=True)
        self._spinning.start()

    def _now_ns(self) -> int:
        return self._since_ns + time.monotonic_ns()

    @property
    def counts(self) -> dict[str, int]:
        """Messages written of each topic so far."""
        return self._bag.counts

    @property
    def unseen(self) -> list[str]:
        """Topics that were to be recorded and that nobody has published so far."""
        return sorted(self._wanted - self.counts.keys() - self.refused.keys())

    def check(self) -> None:
        """Raise OSError when the recording can no longer be written (disk full, ...)."""
        if self._failure is not None:
            raise OSError(f"{self._bag.folder}: the recording ended early: {str(self._failure) or repr(self._failure)}")

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_error: object) -> None:
        """Leave the ROS graph and finish the recording. Raises OSError when not everything could be written."""
        self._stopping = True
        self._spinning.join(10.0 * SPIN_S + 1.0)
        self._executor.shutdown(1.0)
        self._node.destroy_node()
        self._context.try_shutdown()
        self._jobs.put(None)
        self._writer.join()
        try:
            self._bag.close()
        finally:
            self.check()

    # --- in the executor's thread ---

    def _spin(self) -> None:
        try:
            while not self._stopping:
                self._executor.spin_once(SPIN_S)
        except Exception as error:  # otherwise the recording would silently continue without messages
            self._failure = error

    def _discover(self) -> None:
        """Subscribe to topics that are new."""
        for name, types in self._node.get_topic_names_and_types():
            if name not in self._subscribed and self._records(name):
                self._subscribe(name, types[0])
        self._request_parameters()

    def _records(self, name: str) -> bool:
        if self._wanted:
            return name in self._wanted or name == PARAMETER_EVENTS
        if name.rsplit("/", 1)[-1] == MAP_TOPIC and not self._maps:
            return False
        inside = name.startswith(self._namespace) or name in COMMON
        return inside and not re.search(r"/_(?!action/(feedback|status)$)", name)

    def _subscribe(self, name: str, type_name: str) -> None:
        publishers = self._node.get_publishers_info_by_topic(name)
        if not publishers:
            return  # its type and quality of service are not known yet
        self._subscribed.add(name)
        offers = [offered(publisher.qos_profile) for publisher in publishers]
        topic = Topic(name, type_name, offers, str(publishers[0].topic_type_hash))
        try:
            self._jobs.put(partial(self._bag.add_topic, topic, definition(type_name)))
        except UnknownTypeError as error:
            self.refused[name] = str(error)
            return

        lost = itertools.count(1)

        def take(data: bytes) -> None:
            if self._received - self._written > WAITING_MAX:
                self.refused[name] = f"{next(lost)} messages: they come faster than they can be written"
                return
            self._received += len(data)
            self._jobs.put(partial(self._keep, name, data, self._now_ns()))

        profile = profile_for(topic, DEPTH, all(offer.reliability.name == "RELIABLE" for offer in offers))
        self._node.create_subscription(message_class(type_name), name, take, profile, raw=True)

    def _request_parameters(self) -> None:
        """Ask each node of the suite for its parameters, once after every start of it; the answers come later."""
        if PARAMETER_EVENTS not in self._subscribed:
            return
        now = time.monotonic()
        for publisher in self._node.get_publishers_info_by_topic(PARAMETER_EVENTS):
            name, node = publisher.node_name, bytes(publisher.endpoint_gid)
            path = f"{publisher.node_namespace.rstrip('/')}/{name}"
            if name not in NAMES or now < self._retry_at.get(node, now) or not path.startswith(self._namespace):
                continue
            self._seen.setdefault(node, self._now_ns())
            if path not in self._clients:
                self._clients[path] = AsyncParameterClient(self._node, path)
            if not self._clients[path].services_are_ready():
                continue
            self._retry_at[node] = now + RETRY_S
            listed = self._clients[path].list_parameters()
            listed.add_done_callback(lambda future, path=path, node=node: self._on_listed(path, node, future))

    def _on_listed(self, path: str, node: bytes, listed: Any) -> None:
        """Fetch the values of the names listed; they are recorded as if the node began now."""
        client, names = self._clients[path], listed.result().result.names

        # If one of the parameters asked for has no value any more, rclpy returns no values at all: it is asked again.
        def fetch(answer: Any) -> None:
            if len(types := answer.result().types) == len(names):
                typed = zip(names, types, strict=True)
                known = [name for name, type_number in typed if type_number != ParameterType.PARAMETER_NOT_SET]
                client.get_parameters(known).add_done_callback(lambda answer: keep(known, answer.result().values))

        def keep(known: Sequence[str], values: Sequence[Any]) -> None:
            if len(values) != len(known):
                return
            given = [Parameter(name=name, value=value) for name, value in zip(known, values, strict=True)]
            event = serialize_message(ParameterEvent(node=path, new_parameters=given))
            # Stamped with the time of its discovery: later changes are recorded after it and replace its values.
            self._jobs.put(partial(self._bag.write, PARAMETER_EVENTS, event, self._seen[node]))
            self._retry_at[node] = math.inf

        client.get_parameter_types(names).add_done_callback(fetch)

    # --- in the writer's thread ---

    def _keep(self, name: str, data: bytes, time_ns: int) -> None:
        self._bag.write(name, data, time_ns)
        self._written += len(data)

    def _write(self) -> None:
        """Write what arrives; compression must not hold up the executor."""
        while True:
            try:
                job = self._jobs.get(timeout=IDLE_S)
            except queue.Empty:
                job = self._bag.flush
            if job is None:
                return
            if self._failure is None:
                try:
                    job()
                except Exception as error:  # of any kind, also asserts: the end of the thread would go unnoticed
                    self._failure = error


def profile_for(topic: Topic, depth: int, reliable: bool) -> QoSProfile:
    """Quality of service for a topic: `reliable`, and latched if all its publishers are."""
    latched = {offer.durability.name for offer in topic.qos} == {"TRANSIENT_LOCAL"}
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
