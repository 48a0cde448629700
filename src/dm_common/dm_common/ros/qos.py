"""Quality-of-service profiles, one per kind of topic, and whether a node that one depends on is alive.

A service of a process that was killed stays in the ROS graph for 20 s, and its clients wait on. DDS asserts liveliness
for every publisher with a lease, whatever is published; so the nodes that others wait for give a topic one, and those
who wait watch it here: they know within a second, also after kill -9.
"""

import time
from collections.abc import Callable
from copy import copy
from typing import Any
from weakref import WeakKeyDictionary

from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

#: Set-points: reliable, and the latest wins, so that a slow reader never works off a queue of old requests.
COMMAND = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)

#: State streams: reliable with a small depth, so that a short stall loses nothing.
STATE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)

#: Facts that late joiners need (calibration, capabilities, mirror info).
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)

#: Services that many ask at once: a server keeps as many requests, and answers on their way, as this, whoever they are
#: from. With the default of 10 a hundred clients at once lose one request in five (measured).
SERVICE = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)

#: Surface maps of several megabytes. Reliable, because best effort loses whole maps once they exceed the transport's
#: datagram size (ros2/rmw_fastrtps#739).
MAP = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)

#: A publisher whose process does not say for so long that it lives counts as dead, s.
LEASE_S = 1.0
#: A node counts as dead once it has been lost for so long, s: a machine that stalls loses all nodes for a moment.
SURE_S = 0.7
#: A node that has not appeared for so long after the one that watches it was started is missing, s.
APPEAR_S = 5.0
#: A node that was started again is known to one process sooner than to another, up to seconds on a busy machine: a call
#: to one that is lost waits for so long before it counts as dead, s.
RETURN_S = 1.2
#: What became of a node that is lost.
GONE = "has died, was stopped or hangs: start it again"


def with_lease(profile: QoSProfile) -> QoSProfile:
    """`profile` with a lease: for publishers that others watch, and for subscriptions that watch them."""
    leased = copy(profile)
    leased.liveliness = LivelinessPolicy.AUTOMATIC
    leased.liveliness_lease_duration = Duration(seconds=LEASE_S)
    return leased


class Liveliness:
    """Watches the publisher of a topic by a subscription of its own, whose messages it does not even decode.

    Made by `watch`: with two such subscriptions in one process Fast DDS counts a living publisher as dead when it
    forgets one that was killed, 20 s later (measured; the first of them is told the state of whichever publisher
    `LivelinessManager::remove_writer` passed last).

    A publisher without a lease is not seen at all: nothing is known of it.

    Args:
        node: hosts the subscription.
        name: of the node that is watched.
        message_type, topic: one that is published seldom.
        profile: of the topic, without the lease.

    Attributes:
        name: of the node that is watched.
        lost: there was a publisher, and now there is none.
        starts: how many came one after the other; 0 = there was none yet.
    """

    def __init__(self, node: Node, name: str, message_type: Any, topic: str, profile: QoSProfile) -> None:
        self.name, self.lost, self.starts = name, False, 0
        self._born = self._changed_at = self._heard_at = time.monotonic()
        node.create_subscription(
            message_type,
            topic,
            lambda _message: self.heard(),
            with_lease(profile),
            event_callbacks=SubscriptionEventCallbacks(
                liveliness=self._on_change,
                incompatible_qos=lambda _info: None,  # a publisher without a lease is no mistake
            ),
            raw=True,
        )

    def heard(self) -> None:
        """Note that a message of the node has come: who speaks lives, whatever a lease says that lapsed."""
        self._heard_at = time.monotonic()

    def wait_for_return(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Wait for a node that is lost; `RETURN_S` at most.

        Args:
            stop: ends the wait.
        """
        deadline = time.monotonic() + RETURN_S
        while self.lost:
            if stop() or time.monotonic() > deadline:
                return
            time.sleep(0.02)

    def missing(self, served: Callable[[], bool] = lambda: True) -> bool:
        """Whether the node is lost, or never came: not even what it serves is there, which `served` looks for.

        Without that, one that never came is not missing.
        """
        now = time.monotonic()
        if self.lost:
            return now - self._changed_at > SURE_S and now - self._heard_at > LEASE_S
        return not self.starts and now - self._born > APPEAR_S and not served()

    def changed_within(self, duration_s: float) -> bool:
        """Whether the node is lost, or came back or came at all within so long."""
        return self.lost or time.monotonic() - self._changed_at < duration_s

    @property
    def text(self) -> str:
        """What became of a node that is missing, and what to do."""
        return f"the node {self.name} {GONE if self.starts else 'is not running: start it'}"

    def since_now(self, served: Callable[[], bool] = lambda: True) -> Callable[[], str]:
        """What says whether the node is missing, or was started anew since this call: then no answer comes any more.

        It returns what became of the node and what to do, as a sentence; "" = it may answer.
        """
        starts = max(self.starts, 1)

        def gone() -> str:
            if self.starts > starts:
                return f"the node {self.name} was restarted meanwhile: ask again"
            return self.text if self.missing(served) else ""

        return gone

    def _on_change(self, info: Any) -> None:
        lost = info.alive_count == 0
        # A publisher that comes back after its lease lapsed only leaves the other count. That the first one has come is
        # not always heard, when it came before the executor did; whatever changes afterwards, there was one.
        started = info.alive_count_change + info.not_alive_count_change > 0
        self.starts = max(self.starts + started, 1)
        if lost != self.lost:
            self.lost, self._changed_at = lost, time.monotonic()


_watches: WeakKeyDictionary[Node, dict[str, Liveliness]] = WeakKeyDictionary()


def watch(node: Node, name: str, message_type: Any, topic: str, profile: QoSProfile) -> Liveliness:
    """The one watch of this node on a topic; arguments as those of `Liveliness`."""
    own = _watches.setdefault(node, {})
    if topic not in own:
        own[topic] = Liveliness(node, name, message_type, topic, profile)
    return own[topic]
