"""Quality-of-service profiles, one per kind of topic, and a watch on whether another node is alive.

A service of a killed process stays in the ROS graph for 20 s, and its clients keep waiting. DDS asserts liveliness for
every publisher with a lease, whether it publishes or not. So each node that others wait for has one publisher with a
lease, which its clients watch by this module: they learn of its death within a second, even after kill -9.
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

#: Services that many clients call at once: depth of the queues of requests, and of answers under way, that all clients
#: of a server share. With the default of 10 a hundred clients at once lose one request in five (measured).
SERVICE = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)

#: Surface maps of several megabytes. Reliable, because best effort loses whole maps once they exceed the transport's
#: datagram size (ros2/rmw_fastrtps#739).
MAP = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)

#: A publisher whose process has not asserted its liveliness for this time counts as dead, s.
LEASE_S = 1.0
#: A node counts as dead once it has been lost for this time, s: a machine that stalls loses all nodes for a moment.
SURE_S = 0.7
#: A node that has not appeared for this time after the start of the node that watches it is missing, s.
APPEAR_S = 5.0
#: A call to a node that is lost waits for its return for this time, s: some processes discover a restarted node later
#: than others, by seconds on a busy machine.
RETURN_S = 1.2
#: Text on a node that is lost.
LOST_TEXT = "has died, was stopped or hangs: start it again"


def with_lease(profile: QoSProfile) -> QoSProfile:
    """`profile` with a lease: for publishers that others watch, and for subscriptions that watch them."""
    leased = copy(profile)
    leased.liveliness = LivelinessPolicy.AUTOMATIC
    leased.liveliness_lease_duration = Duration(seconds=LEASE_S)
    return leased


class Liveliness:
    """Watches the publisher of a topic by a subscription of its own, whose messages are not decoded.

    Made by `watch`: with two such subscriptions in one process, Fast DDS counts a living publisher as dead when it
    forgets one that was killed, 20 s later (measured; the first of them is given the state of whichever publisher
    `LivelinessManager::remove_writer` passed last).

    A publisher without a lease is not seen at all.

    Args:
        message_type, topic: of a topic with few messages.
        profile: of the topic, without the lease.

    Attributes:
        name: of the node that is watched.
        lost: there was a publisher, and now there is none.
        starts: number of publishers that came one after the other; 0 = there was none yet.
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
        """Note that a message of the node has come: it is then alive, even if its lease has lapsed."""
        self._heard_at = time.monotonic()

    def wait_for_return(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Wait for a node that is lost, until `stop()`; `RETURN_S` at most."""
        deadline = time.monotonic() + RETURN_S
        while self.lost:
            if stop() or time.monotonic() > deadline:
                return
            time.sleep(0.02)

    def missing(self, served: Callable[[], bool] = lambda: True) -> bool:
        """Whether the node is lost, or never appeared and `served()` finds none of its services.

        Without `served`, a node that never appeared is not missing.
        """
        now = time.monotonic()
        if self.lost:
            return now - self._changed_at > SURE_S and now - self._heard_at > LEASE_S
        return not self.starts and now - self._born > APPEAR_S and not served()

    def changed_within(self, duration_s: float) -> bool:
        """Whether the node is lost, or has appeared or come back within this time."""
        return self.lost or time.monotonic() - self._changed_at < duration_s

    @property
    def text(self) -> str:
        """What happened to a node that is missing, and what to do."""
        return f"the node {self.name} {LOST_TEXT if self.starts else 'is not running: start it'}"

    def since_now(self, served: Callable[[], bool] = lambda: True) -> Callable[[], str]:
        """Return a function that checks whether the node is missing or was restarted since: then no answer can come.

        That function returns what happened and what to do, as a sentence; "" = the node may still answer.
        """
        starts = max(self.starts, 1)

        def lost_reason() -> str:
            if self.starts > starts:
                return f"the node {self.name} was restarted meanwhile: ask again"
            return self.text if self.missing(served) else ""

        return lost_reason

    def _on_change(self, info: Any) -> None:
        lost = info.alive_count == 0
        # A publisher that returns after its lease lapsed moves from one count to the other: their sum does not grow. If
        # the first one came before the executor, its arrival may go unnoticed; any later change shows that it came.
        started = info.alive_count_change + info.not_alive_count_change > 0
        self.starts = max(self.starts + started, 1)
        if lost != self.lost:
            self.lost, self._changed_at = lost, time.monotonic()


_watches: WeakKeyDictionary[Node, dict[str, Liveliness]] = WeakKeyDictionary()


def watch(node: Node, name: str, message_type: Any, topic: str, profile: QoSProfile) -> Liveliness:
    """The single watch of this node on a topic; arguments as those of `Liveliness`."""
    own = _watches.setdefault(node, {})
    if topic not in own:
        own[topic] = Liveliness(node, name, message_type, topic, profile)
    return own[topic]
