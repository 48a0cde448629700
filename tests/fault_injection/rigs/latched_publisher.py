"""Latches the calibration in a file (a serialised message) until it is ended. Run as a process.

python -m fault_injection.rigs.latched_publisher --ros-args -p file:=PATH
"""

from __future__ import annotations

import sys
from pathlib import Path

from dm_msgs.msg import Calibration
from rclpy.node import Node
from rclpy.serialization import deserialize_message

from dm_common.ros import qos
from dm_common.ros.executor import run_node


class LatchedPublisher(Node):
    """Does nothing but keep the message for late joiners."""

    def __init__(self) -> None:
        super().__init__("latched_publisher", enable_rosout=False, start_parameter_services=False)
        content = Path(self.declare_parameter("file", "").value).read_bytes()
        self._publisher = self.create_publisher(Calibration, "calibration", qos.LATCHED)
        self._publisher.publish(deserialize_message(content, Calibration))


def main() -> int:
    """Until SIGINT or SIGTERM."""
    return run_node(LatchedPublisher)


if __name__ == "__main__":
    sys.exit(main())
