"""Long runs: a steady stream of focus requests through controller, driver and simulation, and whether anything grows.

Each node is a process; memory, file handles and threads are read from /proc. Requests are a topic on which the latest
wins: on a busy machine one may be overtaken by the next before it is looked at, so the number of answers is told too.
Latency is that of this machine at this moment: a bare relay beside the controller shows what the machine itself does.
"""

from __future__ import annotations

import contextlib
import gc
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from dm_msgs.action import Degauss
from dm_msgs.msg import (
    ActuatorCommand,
    ActuatorState,
    Calibration,
    Capabilities,
    ErrorCode,
    FocusRequest,
    FocusState,
    MirrorInfo,
)
from numpy.typing import NDArray
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions

from dm_bringup.suite import Suite, stop_processes
from dm_common.ros import qos
from dm_common.ros.executor import make_executor
from dm_tools.demo.demo_bench import bench_config
from fault_injection.soak_result import NODES, SoakResult, Window
from studies.benchmarks import stand_in_mirror

RATE = 200.0  # 1/s
#: One request in so many goes to the relay as well.
RELAY_SHARE = 10
LAW, TWIN_LAW, CREEP = "Prandtl-Ishlinskii", "prandtl_ishlinskii", 0.01
REACH = 0.01  # 1/m: the way takes less than a period
#: Longest wait for the nodes, and for the last answers, s.
PATIENCE_S, LAST_S = 60.0, 2.0
#: Share of the run that does not count, caches and logs of fixed length fill up meanwhile; and its bounds, s.
WARM_UP, WARM_UP_LEAST_S, WARM_UP_MOST_S = 0.2, 5.0, 180.0
#: Windows that what counts is cut into; start and end are the medians over the first and the last fifth of them.
WINDOWS = 20


def look_at_processes(pids: dict[str, int], window: Window) -> None:
    """Write down memory, handles and threads of processes, by name."""
    for name, pid in pids.items():
        place = Path(f"/proc/{pid}")
        status = dict(line.split(":", 1) for line in (place / "status").read_text().splitlines())
        window.rss_mb[name] = int(status["VmRSS"].split()[0]) / 1024.0
        window.threads[name] = int(status["Threads"])
        window.handles[name] = len(list((place / "fd").iterdir()))


class _Client(Node):
    """Asks, and times the commands that follow."""

    def __init__(self, context: rclpy.Context) -> None:
        super().__init__("soak", context=context, enable_rosout=False, start_parameter_services=False)
        self.window = Window()
        self.answered = self.refused = self.violations = 0
        self.infos: list[MirrorInfo] = []
        self.calibrated = self.active = False
        self._sent: dict[float, int] = {}
        self._commands: dict[tuple[int, int], int] = {}
        self._request = self.create_publisher(FocusRequest, "focus_request", qos.COMMAND)
        self.calibration = self.create_publisher(Calibration, "calibration", qos.LATCHED)
        self.degauss = ActionClient(self, Degauss, "degauss")
        self._relay_sent: dict[float, int] = {}
        self._relay_request = self.create_publisher(FocusRequest, "/relay/focus_request", qos.COMMAND)
        deep = QoSProfile(depth=200)
        self.create_subscription(MirrorInfo, "mirror_info", self.infos.append, qos.LATCHED)
        self.create_subscription(Capabilities, "capabilities", self._on_capabilities, qos.LATCHED)
        self.create_subscription(ActuatorState, "actuator_state", self._on_report, deep)
        self.create_subscription(ActuatorCommand, "actuator_command", self._on_command, deep)
        self.create_subscription(ActuatorCommand, "/relay/actuator_command", self._on_relay, deep)
        self.create_subscription(FocusState, "focus_state", self._on_state, deep)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, deep)

    def _on_capabilities(self, message: Capabilities) -> None:
        self.calibrated = message.quality == Capabilities.CALIBRATED

    def _on_report(self, message: ActuatorState) -> None:
        self.active = message.driver_state == ActuatorState.STATE_ACTIVE

    def ask(self, curvature: float) -> None:
        """Send a request."""
        message = FocusRequest(curvature=curvature)
        message.header.stamp = self.get_clock().now().to_msg()
        self._sent[curvature] = time.perf_counter_ns()
        self._request.publish(message)

    def ask_relay(self, curvature: float) -> None:
        """Send the relay a request."""
        self._relay_sent = {curvature: time.perf_counter_ns()}  # the latest wins there too
        self._relay_request.publish(FocusRequest(curvature=curvature))

    def _on_relay(self, command: ActuatorCommand) -> None:
        sent = self._relay_sent.pop(command.signals[0], None)
        if sent is not None:
            self.window.relay_us.append(1e-3 * (time.perf_counter_ns() - sent))

    def _on_command(self, command: ActuatorCommand) -> None:
        stamp = command.header.stamp
        self._commands[stamp.sec, stamp.nanosec] = time.perf_counter_ns()
        if len(self._commands) > 1000:  # corrections and commands whose state was overtaken
            del self._commands[next(iter(self._commands))]

    def _on_state(self, state: FocusState) -> None:
        sent = self._sent.pop(state.curvature, None)
        if sent is None:
            return
        for overtaken in [curvature for curvature, when in self._sent.items() if when < sent]:
            del self._sent[overtaken]
        self.answered += 1
        # A request that a newer one replaced before the driver confirmed it is not refused: the latest wins.
        self.refused += state.error_code not in (ErrorCode.OK, ErrorCode.PREEMPTED)
        arrived = self._commands.pop((state.header.stamp.sec, state.header.stamp.nanosec), None)
        if arrived is not None:
            self.window.latency_us.append(1e-3 * (arrived - sent))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            for item in status.values:
                if item.key == "violations":
                    self.violations = int(item.value)


def soak(
    seconds: float, folder: Path, domain: int, seed: int = 1, progress: Callable[[float], None] = lambda share: None
) -> SoakResult:
    """Ask for `seconds` at RATE.

    Args:
        seconds: of requests, warm-up included.
        folder: for the nodes' files and logs.
        domain: ROS domain.
        seed: of the simulation and the requests.
        progress: called with the share that is done.

    Raises:
        RuntimeError: a node ended, or did not begin.
    """
    random = Random(seed)
    config = bench_config(folder, TWIN_LAW, CREEP, seed, 0.0)
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    client = _Client(context)
    executor = make_executor(client)

    def serve(duration: float, until: Callable[[], Any] = lambda: False) -> bool:
        end = time.monotonic() + duration
        while not until():
            if time.monotonic() >= end:
                return bool(until())
            executor.spin_once(timeout_sec=max(end - time.monotonic(), 0.0))
        return True

    def wait_for(what: str, condition: Callable[[], Any]) -> None:
        if not serve(PATIENCE_S, condition):
            suite.check()
            raise RuntimeError(f"{what}: not within {PATIENCE_S:g} s")

    try:
        with Suite(config, folder / "nodes", domain, nodes=NODES) as suite, _relay(domain):
            wait_for("the driver", lambda: client.infos and client.active and client.degauss.server_is_ready())
            client.calibration.publish(stand_in_mirror.calibration(LAW, client.infos[-1].serial))
            wait_for("the controller's calibration", lambda: client.calibrated)
            serve(1.0)
            degauss = client.degauss.send_goal_async(Degauss.Goal(steps=10))
            serve(PATIENCE_S, degauss.done)
            serve(PATIENCE_S, degauss.result().get_result_async().done)
            serve(1.0)
            return _stream(client, suite, serve, seconds, random, progress)
    finally:
        executor.shutdown(2.0)
        client.destroy_node()
        rclpy.try_shutdown(context=context)


@contextlib.contextmanager
def _relay(domain: int) -> Iterator[None]:
    command = [
        sys.executable,
        "-m",
        "studies.benchmarks.ros_jobs.relay_node",
        "events",
        "--ros-args",
        "-r",
        "__ns:=/relay",
    ]
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain)}
    process = subprocess.Popen(command, env=environment, start_new_session=True)
    try:
        yield
    finally:
        stop_processes([process])


def _stream(
    client: _Client,
    suite: Suite,
    serve: Callable[..., bool],
    seconds: float,
    random: Random,
    progress: Callable[[float], None],
) -> SoakResult:
    warm_up = min(max(WARM_UP * seconds, WARM_UP_LEAST_S), WARM_UP_MOST_S, 0.5 * seconds)
    ends: NDArray[np.float64] = warm_up + (seconds - warm_up) * np.arange(WINDOWS + 1) / WINDOWS
    windows: list[Window] = []
    requests, begun = 0, time.monotonic()
    gc.collect()
    for number, end in enumerate(ends.tolist()):
        client.window = Window()
        while (elapsed := time.monotonic() - begun) < end:
            ahead = requests / RATE - elapsed
            if ahead > 0.0:
                serve(ahead)
                continue
            client.ask(random.uniform(-REACH, REACH))
            requests += 1
            if requests % RELAY_SHARE == 0:
                serve(0.5 / RATE)
                client.ask_relay(random.uniform(-REACH, REACH))
            serve(0.0)
            if requests - RATE * elapsed < -RATE:  # a second behind: the time of a stopped machine is not made up for
                begun += elapsed - requests / RATE
        suite.check()
        look_at_processes(suite.pids, client.window)
        if number:  # the first is the warm-up
            windows.append(client.window)
        progress(end / seconds)
    lasted = time.monotonic() - begun
    serve(LAST_S)
    return SoakResult(lasted, requests, client.answered, client.refused, client.violations, tuple(windows))
