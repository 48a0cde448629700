"""A real `pdm_driver` process against emulated electronics in this process, whose monitor judges every frame.

The monitor belongs to the simulation (:mod:`dm_simulation.electronics.monitor`) and shares no code with the driver's
limiter.
"""

from __future__ import annotations

import signal
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import numpy as np
import rclpy
import yaml
from dm_msgs.msg import ActuatorCommand, ActuatorState, ErrorCode
from dm_msgs.srv import SetSignals
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from numpy.typing import ArrayLike, NDArray
from rclpy.context import Context
from rclpy.node import Node

from dm_bringup.nodes import MODULES
from dm_common.ros import qos
from dm_common.ros.executor import BackgroundExecutor
from dm_simulation.bench import BenchConfig, FilesConfig, VirtualBench
from dm_simulation.electronics.drive_unit import DriveConfig
from dm_simulation.electronics.monitor import MonitorConfig
from dm_simulation.electronics.server import OFF, PortsConfig
from dm_simulation.interferometer.interferometer import InterferometerConfig
from fault_injection.rigs.forked_node import ForkedNode, Process

ACTUATORS = 37
#: Of the rig's mirror.
SERIAL = "faults"
#: Longest wait for anything that the driver promises; generous, for a busy machine [s].
PATIENCE_S = 60.0
#: The slew rate of the rig: slow, so that faults meet moves under way [1/s].
SLEW_RATE = 4.0
_SIGNAL_TOLERANCE = 1e-3  # a USB DAC-40 has 12 bit


class RigError(Exception):
    """The driver did not do within PATIENCE_S what it promises; the message says what."""


class DriverRig:
    """Driver process, emulated unit, and a node that commands and listens. Use as a context manager.

    Args:
        folder: for the driver's files and log.
        domain: ROS domain.
        kind: "edac40_tcp", "edac40_udp" or "usb_dac40".
        via: port that the driver is told instead of the unit's: of a relay between the two; 0 = the unit's own.
        changes: parameters of the driver beside the rig's.
    """

    def __init__(self, folder: Path, domain: int, kind: str = "edac40_tcp", via: int = 0, **changes: Any) -> None:
        self.folder = folder
        self._domain = domain
        folder.mkdir(parents=True, exist_ok=True)
        self.events: list[str] = []  # what happened at the unit, in words
        serial = str(folder / "ttyUSB") if kind == "usb_dac40" else ""
        self._udp = kind == "edac40_udp"
        self.bench = VirtualBench(self._bench_config(serial), on_event=lambda severe, text: self.events.append(text))
        endpoints = self.bench.electronics.endpoints
        self.port = int(endpoints.get("udp_port" if self._udp else "tcp_port", 1))
        self._parameters = folder / "driver.yaml"
        values = {
            "mirror.serial": SERIAL,
            "state_folder": str(folder / "state"),
            "electronics.kind": kind,
            "electronics.address": "127.0.0.1",
            "electronics.port": via or self.port,
            "electronics.discovery_port": int(endpoints.get("discovery_port", 0)),
            "electronics.serial_port": serial,
            "volts.dac_at_zero": 0.0,
            "volts.dac_at_full": 5.0,
            "volts.amplifier_gain": 80.0,
            "volts.min": 0.0,
            "volts.max": 300.0,
            "limits.slew_rate": SLEW_RATE,
            **{name.replace("__", "."): value for name, value in changes.items()},
        }
        self._parameters.write_text(yaml.safe_dump({"/**": {"ros__parameters": values}}))
        self.process: Process | None = None
        self.states: list[ActuatorState] = []

    def _bench_config(self, serial: str) -> BenchConfig:
        """The bench: the electronics and their monitor are what counts, so its camera is small."""
        tcp, udp = (OFF, 0) if self._udp else (OFF if serial else 0, OFF)
        return BenchConfig(
            interferometer=InterferometerConfig(pixels=32),
            drive=DriveConfig(),
            ports=PortsConfig(tcp, udp, udp, serial),
            monitor=MonitorConfig(jump=0.1, neighbour_difference=1.0),
            files=FilesConfig(folder=self.folder / "maps"),
            trigger_port=OFF,
        )

    def __enter__(self) -> Self:
        self._context = Context()
        rclpy.init(context=self._context, domain_id=self._domain)
        self.node = Node("fault_injection", context=self._context, enable_rosout=False, start_parameter_services=False)
        self.node.create_subscription(ActuatorState, "actuator_state", self._on_state, qos.STATE)
        self.publisher = self.node.create_publisher(ActuatorCommand, "actuator_command", qos.COMMAND)
        self._clients = {
            SetSignals: self.node.create_client(SetSignals, "set_signals"),
            ChangeState: self.node.create_client(ChangeState, "pdm_driver/change_state"),
        }
        self._background = BackgroundExecutor(self.node)
        self.start()
        return self

    def __exit__(self, *_exception: object) -> None:
        self.kill(signal.SIGINT)
        self._background.destroy_node()
        rclpy.try_shutdown(context=self._context)
        self.bench.close()

    # The driver as a process

    def start(self) -> None:
        """Start the driver."""
        assert self.process is None
        self.process = self._start(MODULES["pdm_driver"], self._parameters, self.folder / "driver.log")

    def _start(self, module: str, parameters: Path, log: Path) -> Process:
        command = ["--ros-args", "--params-file", str(parameters)]
        return ForkedNode(module, command, log, {"ROS_DOMAIN_ID": str(self._domain)})

    def send_signal(self, number: int) -> None:
        """Send the driver a signal."""
        assert self.process is not None
        self.process.send_signal(number)

    def kill(self, number: int = signal.SIGKILL) -> int:
        """End the driver by a signal; its exit status."""
        process, self.process = self.process, None
        return 0 if process is None else end_process(process, number, "the driver")

    # The driver as a node

    def _on_state(self, message: ActuatorState) -> None:
        self.states.append(message)
        del self.states[:-2000]

    def wait(self, condition: Callable[[], Any], what: str, patience_s: float = PATIENCE_S) -> Any:
        """The first true value of `condition()`.

        Raises:
            RigError: there is none in time.
        """
        deadline = time.monotonic() + patience_s
        while not (value := condition()):
            if time.monotonic() > deadline:
                log = (self.folder / "driver.log").read_text(errors="replace")[-800:]
                raise RigError(f"not within {patience_s:g} s: {what}\n{log}")
            time.sleep(0.005)
        return value

    def wait_for_driver_state(self, driver_state: int) -> None:
        """Wait until the newest state message, of those that come from now on, tells `driver_state`."""
        self.states.clear()
        self.wait(lambda: self.states and self.states[-1].driver_state == driver_state, f"driver state {driver_state}")

    def call(self, kind: Any, request: Any) -> Any:
        """Call a service of the driver."""
        return self.wait_answer(self.begin(kind, request))

    def begin(self, kind: Any, request: Any) -> Any:
        """Call a service of the driver without waiting; returns the future."""
        client = self._clients[kind]
        self.wait(client.service_is_ready, f"service {client.srv_name}")
        return client.call_async(request)

    def wait_answer(self, future: Any) -> Any:
        """The answer of a call."""
        self.wait(future.done, "an answer")
        return future.result()

    def change(self, transition: int) -> bool:
        """Request a lifecycle transition."""
        return bool(self.call(ChangeState, ChangeState.Request(transition=Transition(id=transition))).success)

    def publish(self, signals: ArrayLike, stamp_ns: int = 0) -> None:
        """Publish a command; 0 = without a stamp."""
        message = ActuatorCommand(signals=np.asarray(signals, dtype=np.float64).tolist())
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
        self.publisher.publish(message)

    def set_signals(self, signals: ArrayLike, wait: bool = True) -> Any:
        """The service; with `wait` the answer comes when the shape stands."""
        request = SetSignals.Request(signals=np.asarray(signals, dtype=np.float64).tolist(), wait=wait)
        return self.call(SetSignals, request)

    # The electronics

    @property
    def violations(self) -> int:
        """Frames that broke a limit of the monitor."""
        return self.bench.electronics.run(lambda: self.bench.monitor.record.violations)

    @property
    def frames(self) -> int:
        """Frames that reached the electronics."""
        return self.bench.electronics.run(lambda: self.bench.monitor.record.frames)

    @property
    def signals(self) -> NDArray[np.float64]:
        """(37,) what stands at the actuators."""
        return self.bench.electronics.run(self.bench.unit.signals)

    def stands_at(self, signals: ArrayLike) -> bool:
        """Whether the actuators have these signals, but for the quantisation."""
        return bool(np.abs(self.signals - np.asarray(signals, dtype=np.float64)).max() <= _SIGNAL_TOLERANCE)

    def silent(self, seconds: float) -> threading.Thread:
        """The unit stops reading for a while; its connection stays. Returns the thread that waits for the end."""
        thread = threading.Thread(target=lambda: self.bench.electronics.run(lambda: time.sleep(seconds)))
        thread.start()
        return thread

    def wait_moving(self, frames: int = 3) -> None:
        """Wait until some more frames have arrived: a move is under way."""
        before = self.frames
        self.wait(lambda: self.frames >= before + frames, "a move under way")

    def recover(self, signals: ArrayLike) -> float:
        """Ask for `signals` until the driver carries it out; the seconds that took.

        Raises:
            RigError: it does not within PATIENCE_S, or says it did and the actuators stand elsewhere.
        """
        begun = time.monotonic()
        request = SetSignals.Request(signals=np.asarray(signals, dtype=np.float64).tolist(), wait=True)
        self.insist(SetSignals, request, "a command that is carried out")
        took = time.monotonic() - begun
        self.wait(lambda: self.stands_at(signals), "the accepted shape at the actuators", 5.0)
        return took

    def insist(self, kind: Any, request: Any, what: str, answer_s: float = 5.0) -> Any:
        """Call a service until it answers without an error; `answer_s` is the longest wait for one answer.

        Raises:
            RigError: it does not within PATIENCE_S.
        """
        client = self._clients[kind]
        refusal = "not offered"

        def accepted() -> Any:
            nonlocal refusal
            if not client.service_is_ready():
                return None
            future = client.call_async(request)
            try:
                self.wait(future.done, "an answer", answer_s)
            except RigError:  # a server that is found and lost again takes the answer with it
                client.remove_pending_request(future)
                refusal = "no answer"
                return None
            refusal = getattr(future.result(), "message", "")
            return future.result() if future.result().error_code == ErrorCode.OK else None

        try:
            return self.wait(accepted, what)
        except RigError as error:
            raise RigError(f"{client.srv_name}: {refusal}: {error}") from error


def end_process(process: Process, number: int, name: str) -> int:
    """End a process, stopped or not, by a signal; its exit status.

    Raises:
        RigError: it goes on; it was killed.
    """
    process.send_signal(signal.SIGCONT)
    process.send_signal(number)
    try:
        return process.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        raise RigError(f"{name} did not end on signal {number}") from None
