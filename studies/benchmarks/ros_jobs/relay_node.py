"""A bare relay of the focus controller's messages: the lower limit of what rclpy can do. Run as a process.

python -m studies.benchmarks.ros_jobs.relay_node events|single|multi --ros-args -r __ns:=/relay
"""

from __future__ import annotations

import sys
from array import array

import rclpy
from dm_msgs.msg import ActuatorCommand, FocusRequest
from rclpy.executors import Executor, ExternalShutdownException, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node

from dm_common.ros import qos
from dm_common.ros.executor import run_node

ACTUATORS = 37
OTHERS: dict[str, type[Executor]] = {"single": SingleThreadedExecutor, "multi": MultiThreadedExecutor}


class RelayNode(Node):
    """Answers every focus request with a command that holds nothing but the request's curvature."""

    def __init__(self) -> None:
        super().__init__("relay")
        self._publisher = self.create_publisher(ActuatorCommand, "actuator_command", qos.COMMAND)
        self.create_subscription(FocusRequest, "focus_request", self._on_request, qos.COMMAND)

    def _on_request(self, request: FocusRequest) -> None:
        command = ActuatorCommand(signals=array("d", [request.curvature] * ACTUATORS))
        command.header.stamp = self.get_clock().now().to_msg()
        self._publisher.publish(command)


def main() -> int:
    """Relay until SIGINT or SIGTERM, under the executor named by the first argument."""
    kind = sys.argv[1]
    if kind == "events":
        return run_node(RelayNode)
    rclpy.init()
    executor = OTHERS[kind]()
    executor.add_node(RelayNode())
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    return 0


if __name__ == "__main__":
    sys.exit(main())
