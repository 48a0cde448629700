"""The log of all nodes, as `/rosout` carries it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from rcl_interfaces.msg import Log
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

#: Names of the levels; their numbers are those of rcl_interfaces/Log.
LEVELS = {10: "DEBUG", 20: "INFO", 30: "WARN", 40: "ERROR", 50: "FATAL"}


@dataclass(frozen=True)
class LogLine:
    """One entry of the log.

    Attributes:
        time: s, of the node's clock.
        level: DEBUG, INFO, WARN, ERROR or FATAL.
        node: logger's name.
        message: the text.
    """

    time: float
    level: str
    node: str
    message: str


class LogTail:
    """Keeps the last `keep` lines that nodes logged since it was made."""

    def __init__(self, node: Node, keep: int = 200) -> None:
        self.lines: deque[LogLine] = deque(maxlen=keep)
        #: Lines heard in all.
        self.count = 0
        node.create_subscription(Log, "/rosout", self._take, _profile(keep))

    def _take(self, message: Log) -> None:
        level = ord(message.level) if isinstance(message.level, bytes) else message.level
        time = message.stamp.sec + 1e-9 * message.stamp.nanosec
        self.lines.append(LogLine(time, LEVELS.get(level, str(level)), message.name, message.msg))
        self.count += 1


def _profile(depth: int) -> QoSProfile:
    """Nodes offer their latest lines to those who come late."""
    return QoSProfile(depth=depth, durability=DurabilityPolicy.TRANSIENT_LOCAL)
