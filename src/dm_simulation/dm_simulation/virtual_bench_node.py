"""Node `virtual_bench`: simulation of mirror, drive electronics and interferometer.

Other nodes access it as they access hardware: on the wire and by map files. ROS carries only what a person at the bench
would do: pull the plug (`~/power`), press the instrument's button (`~/trigger`), read the labels (`~/endpoints`); and
the images of the camera behind the mirror (`image_raw`, `camera_info`), which the driver of a real camera would
publish; and the temperature of a plate on piezo stacks (`temperature`), which a sensor would publish.
"""

import array
import json
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from rclpy.clock import Clock as SteadyClock
from rclpy.clock import ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, Temperature
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from dm_common.ros import qos
from dm_common.ros.domains import held_by
from dm_common.ros.executor import run_node
from dm_common.ros.lifecycle import ERROR, OK, WARN, Diagnostics, Health
from dm_common.ros.parameters import declare
from dm_common.ros.worker import WorkerService
from dm_simulation.bench import VirtualBench
from dm_simulation.camera import camera_matrix
from dm_simulation.electronics.server import PortError
from dm_simulation.mirror.piezo import PiezoActuators
from dm_simulation.parameters import PARAMETERS, bench_config

#: Longest wait for the driver to end before this node does, s; `ros2 launch` waits for 5 s only.
DRIVER_LEAVES_S = 4.0
#: Time between two readings of the thermometer, s of bench time.
READING_S = 2.0


class VirtualBenchNode(Node):
    """Runs one :class:`dm_simulation.bench.VirtualBench`."""

    def __init__(self) -> None:
        super().__init__("virtual_bench")
        values = declare(self, PARAMETERS, self._on_change, check=self._check_change)
        self._speed = speed = values["clock.speed"]
        self._began_ns, self._origin_ns = time.time_ns(), time.monotonic_ns()
        self._stop = threading.Event()
        try:
            self.bench = VirtualBench(bench_config(values), lambda: self._now().nanoseconds * 1e-9, self._on_event)
        except PortError as error:
            raise OSError(f"{error}{held_by(error.port)}") from None

        # Latched JSON object: the ports and paths actually in use.
        endpoints = self.create_publisher(String, "~/endpoints", qos.LATCHED)
        endpoints.publish(String(data=json.dumps(self.bench.endpoints)))
        WorkerService(self, Trigger, "~/trigger", self._trigger)
        WorkerService(self, SetBool, "~/power", self._power)
        Diagnostics(self, f"virtual {values['mirror.name']}", self._check)
        self._threads: list[threading.Thread] = []
        if speed:
            # Reliable, depth 1: matches the best-effort subscriptions of all time sources and any stricter one.
            self._clock_publisher = self.create_publisher(Clock, "/clock", QoSProfile(depth=1))
            self._start(self._tick, values["clock.period"])
        if isinstance(self.bench.actuators, PiezoActuators):
            self._temperature_publisher = self.create_publisher(Temperature, "temperature", qos_profile_sensor_data)
            # By the wall clock: this node's time is that of the bench, or of another source that may stand still.
            steady = SteadyClock(clock_type=ClockType.STEADY_TIME)
            self.create_timer(max(READING_S / (speed or 1.0), 0.01), self._read_temperature, clock=steady)
        if self.bench.camera is not None:
            # Reliable: viewers that require it get images too. Depth 1: an image not fetched in time is dropped.
            self._image_publisher = self.create_publisher(Image, "image_raw", qos.MAP)
            self._info_publisher = self.create_publisher(CameraInfo, "camera_info", qos.MAP)
            camera = self.bench.config.camera
            size, k = {"height": camera.height, "width": camera.width}, camera_matrix(camera)
            self._camera_info = CameraInfo(**size, distortion_model="plumb_bob", d=[0.0] * 5, r=np.eye(3).ravel(), k=k)
            self._camera_info.header.frame_id = f"{self.get_namespace()}/camera_optical".lstrip("/")  # REP 103
            self._camera_info.p = np.pad(np.reshape(k, (3, 3)), [(0, 0), (0, 1)]).ravel()
            self._start(self._film, 1 / values["camera.rate"])
        places = ", ".join(f"{name} {place}" for name, place in self.bench.endpoints.items())
        law = f"{values['piezo.law']} {100 * values['piezo.hysteresis']:g} %, creep {100 * values['piezo.creep']:g} %"
        if self.bench.config.membrane is not None:
            law = "membrane"
        pace = f"{speed:g} times as fast as real time" if speed else "in real time"
        self.get_logger().info(f"virtual bench: {places}; seed {values['seed']}, {law}; {pace}")

    def _start(self, work: Callable[[float], None], period: float) -> None:
        self._threads.append(threading.Thread(target=work, args=(period,), daemon=True))
        self._threads[-1].start()

    def _check_change(self, changes: Mapping[str, Any]) -> None:
        if self.bench.camera is not None and "camera.distances" in changes:
            self.bench.camera.left_to_focus(changes["camera.distances"])

    def _on_change(self, changes: Mapping[str, Any]) -> None:
        if self.bench.camera is not None and "camera.distances" in changes:
            self.bench.camera.place(changes["camera.distances"])

    def _now(self) -> Time:
        """The bench's time: with `clock.speed`, that multiple of the wall clock, from the Unix time of the start on."""
        if self._speed:
            return Time(nanoseconds=self._began_ns + round(self._speed * (time.monotonic_ns() - self._origin_ns)))
        return self.get_clock().now()

    def _tick(self, period: float) -> None:
        while not self._stop.wait(period):
            self._clock_publisher.publish(Clock(clock=self._now().to_msg()))

    def _read_temperature(self) -> None:
        reading = Temperature(temperature=self.bench.temperature())
        reading.header.stamp = self._now().to_msg()
        self._temperature_publisher.publish(reading)

    def _film(self, period: float) -> None:
        while not self._stop.wait(period - time.monotonic() % period):
            header = self._camera_info.header
            header.stamp = self._now().to_msg()
            try:
                picture = self.bench.photograph()
            except OSError:  # the bench is closing
                return
            height, width = picture.shape
            image = Image(header=header, height=height, width=width, encoding="mono8", step=width)
            image.data = array.array("B", picture.tobytes())
            self._image_publisher.publish(image)
            self._info_publisher.publish(self._camera_info)

    def _on_event(self, severe: bool, text: str) -> None:
        logger = self.get_logger()
        if severe:
            logger.warning(text, throttle_duration_sec=0.2)
        else:
            logger.info(text)

    def _trigger(self, _request: Any, response: Any) -> Any:
        try:
            response.message = str(self.bench.measure())
            response.success = True
        except (OSError, ValueError) as error:
            response.success, response.message = False, str(error)
        return response

    def _power(self, request: Any, response: Any) -> Any:
        try:
            self.bench.electronics.set_plugged(request.data)
            response.success = True
            response.message = "plugged in" if request.data else "unplugged; the outputs hold"
        except OSError as error:
            response.success, response.message = False, str(error)
        return response

    def _check(self) -> Health:
        bench, record, electronics = self.bench, self.bench.monitor.record, self.bench.electronics
        values = {
            "plugged": electronics.plugged,
            "malformed_frames": electronics.malformed_count,
            "settings_frames": bench.unit.settings_frames,
            "violations": record.violations,
            **{name: f"{each:.5f}" if isinstance(each, float) else each for name, each in asdict(record).items()},
            "maps_written": bench.maps_written,
            **bench.endpoints,
        }
        if record.violations:
            return Health(ERROR, f"{record.violations} frames broke a limit", values)
        if electronics.malformed_count or bench.unit.settings_frames:
            return Health(WARN, "frames arrived that no driver should send", values)
        if not electronics.plugged:
            return Health(WARN, "unplugged", values)
        return Health(OK, f"{record.frames} frames, {bench.maps_written} maps", values)

    def make_safe(self) -> None:
        """Let the driver bring the mirror to its safe shape, then free ports and threads before the node ends.

        Ctrl-C reaches all processes of a launch at once; if the emulated hardware ended first, nobody could reach it.
        """
        deadline = time.monotonic() + DRIVER_LEAVES_S
        driver = ("pdm_driver", self.get_namespace())
        while driver in self.get_node_names_and_namespaces() and time.monotonic() < deadline:
            time.sleep(0.02)
        self._stop.set()
        for thread in self._threads:
            thread.join(2)
        self.bench.close()


def main() -> int:
    """Entry point of the executable `virtual_bench`."""
    return run_node(VirtualBenchNode, images=True)


if __name__ == "__main__":
    sys.exit(main())
