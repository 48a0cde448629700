"""Client of the benchmark `hosts`: sends requests to a focus controller and times its commands and the reports.

    python -m studies.benchmarks.ros_jobs.hosts_client ROUNDS NAMESPACE

Run as a process. Prints a line of JSON: medians and 99th percentiles in us, from the request to the command that the
controller publishes, and from there to the driver's report that the command was written.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import numpy as np
import rclpy
from dm_msgs.action import Degauss
from dm_msgs.msg import ActuatorCommand, ActuatorState, Calibration, Capabilities, FocusRequest, MirrorInfo
from rclpy.action import ActionClient
from rclpy.node import Node

from dm_common.ros import qos
from dm_common.ros.executor import make_executor
from studies.benchmarks import stand_in_mirror

LAW = "Prandtl-Ishlinskii"
REACH = 0.01  # 1/m: short ramps
FIRST_S, ANSWER_S, PAUSE_S = 60.0, 2.0, 0.03


class Client(Node):
    """Records the messages of the two nodes, with their times of arrival."""

    def __init__(self, namespace: str) -> None:
        super().__init__("client", namespace=namespace)
        self.request = self.create_publisher(FocusRequest, "focus_request", qos.COMMAND)
        self.calibration = self.create_publisher(Calibration, "calibration", qos.LATCHED)
        self.degauss = ActionClient(self, Degauss, "degauss")
        self.infos: list[MirrorInfo] = []
        self.capabilities: list[Capabilities] = []
        self.commands: list[tuple[int, Any]] = []
        self.reports: list[tuple[int, ActuatorState]] = []
        self.create_subscription(MirrorInfo, "mirror_info", self.infos.append, qos.LATCHED)
        self.create_subscription(Capabilities, "capabilities", self.capabilities.append, qos.LATCHED)
        self.create_subscription(ActuatorCommand, "actuator_command", self._on_command, qos.COMMAND)
        self.create_subscription(ActuatorState, "actuator_state", self._on_report, qos.STATE)

    def _on_command(self, command: ActuatorCommand) -> None:
        self.commands.append((time.perf_counter_ns(), command.signals))

    def _on_report(self, report: ActuatorState) -> None:
        self.reports.append((time.perf_counter_ns(), report))


def main() -> int:
    """Exit status 0 with figures, 1 when a node did not answer."""
    rounds, namespace = int(sys.argv[1]), sys.argv[2]
    rclpy.init()
    client = Client(namespace)
    executor = make_executor(client)

    def serve(seconds: float, until: Any = lambda: False) -> bool:
        end = time.monotonic() + seconds
        while not until():
            if time.monotonic() >= end:
                return False
            executor.spin_once(timeout_sec=max(end - time.monotonic(), 0.0))
        return True

    def active() -> bool:
        return bool(client.reports) and client.reports[-1][1].driver_state == ActuatorState.STATE_ACTIVE

    if not serve(FIRST_S, lambda: client.infos and active() and client.degauss.server_is_ready()):
        print("the driver did not appear", file=sys.stderr)
        return 1
    client.calibration.publish(stand_in_mirror.calibration(LAW, client.infos[-1].serial))
    if not serve(FIRST_S, lambda: client.capabilities and client.capabilities[-1].calibration_id):
        print("the controller did not take the calibration", file=sys.stderr)
        return 1
    serve(1.0)
    accepted = client.degauss.send_goal_async(Degauss.Goal(steps=10))
    serve(FIRST_S, accepted.done)
    serve(FIRST_S, accepted.result().get_result_async().done)
    serve(1.0)
    generator = np.random.default_rng(6)
    command_us, report_us = [], []
    for curvature in generator.uniform(-REACH, REACH, rounds):
        client.commands.clear()
        client.reports.clear()
        message = FocusRequest(curvature=float(curvature))
        message.header.stamp = client.get_clock().now().to_msg()
        sent = time.perf_counter_ns()
        client.request.publish(message)
        if not serve(ANSWER_S, lambda: client.commands):
            continue
        at, signals = client.commands[0]

        def written(signals: Any = signals) -> bool:
            return any(report.requested == signals for _at, report in client.reports)

        if not serve(ANSWER_S, written):
            continue
        command_us.append(1e-3 * (at - sent))
        seen = next(when for when, report in client.reports if report.requested == signals)
        report_us.append(1e-3 * (seen - at))
        serve(PAUSE_S)
    figures: dict[str, float] = {"answered": len(command_us), "asked": rounds}
    for name, values in (("command", command_us), ("report", report_us)):
        if values:
            p50, p99 = np.percentile(values, (50, 99))
            figures |= {f"{name}_p50_us": float(p50), f"{name}_p99_us": float(p99)}
    print(json.dumps(figures))
    client.destroy_node()
    rclpy.try_shutdown()
    return 0 if command_us else 1


if __name__ == "__main__":
    sys.exit(main())
