"""Health of a node on `/diagnostics`, once a second (the Python diagnostic_updater is not on PyPI); the log of all."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import Log
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from dm_common.messages import seconds

OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR
STALE = DiagnosticStatus.STALE
#: How often health is published, s.
PERIOD_S = 1.0
#: Names of the levels of rcl_interfaces/Log.
LOG_LEVELS = {10: "DEBUG", 20: "INFO", 30: "WARN", 40: "ERROR", 50: "FATAL"}


@dataclass
class Health:
    """One status: a level (OK, WARN, ERROR, STALE), a line for a person, and figures."""

    level: bytes = OK
    message: str = "ok"
    values: Mapping[str, object] = field(default_factory=dict)


class Diagnostics:
    """Publish `check()` on `/diagnostics` once a second of wall time, whatever ROS time does."""

    def __init__(self, node: Node, hardware_id: str, check: Callable[[], Health]) -> None:
        self._node = node
        self._check = check
        self.hardware_id = hardware_id
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._timer = node.create_timer(PERIOD_S, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def publish(self) -> None:
        """Publish now."""
        health = self._check()
        status = DiagnosticStatus(
            level=health.level,
            name=self._node.get_fully_qualified_name().lstrip("/"),
            message=health.message,
            hardware_id=self.hardware_id,
            values=[KeyValue(key=str(key), value=str(value)) for key, value in health.values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)


def hear_log(node: Node, keep: int, take: Callable[[float, str, str, str], None]) -> None:
    """Call `take(time, level, logger, message)` for every line on `/rosout`, the last `keep` of before among them.

    The time is ROS time, s.
    """

    def on_log(line: Log) -> None:
        take(seconds(line.stamp), LOG_LEVELS.get(line.level, str(line.level)), line.name, line.msg)

    # Nodes offer their latest lines to those who come late.
    profile = QoSProfile(depth=keep, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(Log, "/rosout", on_log, profile)
