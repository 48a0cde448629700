"""Node `virtual_bench` as a process: ports, services, clock, diagnostics."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import qos_profile_sensor_data
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, Temperature
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

import dm_simulation.interferometer.trigger
from dm_common.ros import qos
from dm_simulation.virtual_bench_node import READING_S
from support import NodeProcess, Observer, wait_until

Start = Callable[..., NodeProcess]

SMALL: dict[str, Any] = {
    "interferometer.pixels": 128,
    "electronics.tcp_port": 0,
    "electronics.udp_port": 0,
    "electronics.discovery_port": 0,
    "trigger.port": 0,
}


def endpoints_of(observer: Observer) -> dict[str, Any]:
    received = observer.record(String, "virtual_bench/endpoints", qos.LATCHED)
    wait_until(lambda: received, 60, "endpoints")
    return json.loads(received[0].data)


def values_of(messages: list[DiagnosticArray]) -> dict[str, str]:
    """The bench's newest figures; {} before there are any."""
    for message in reversed(messages):
        for status in message.status:
            if status.name == "virtual_bench":
                return {pair.key: pair.value for pair in status.values}
    return {}


def test_trigger_power_and_diagnostics(start: Start, observer: Observer, tmp_path: Path) -> None:
    link = tmp_path / "tty"
    folder = tmp_path / "maps"
    process = start(
        "dm_simulation",
        "virtual_bench",
        {**SMALL, "output_folder": str(folder), "output_format": "dat", "electronics.pty_link": str(link)},
    )
    endpoints = endpoints_of(observer)
    health: list[DiagnosticArray] = observer.record(DiagnosticArray, "/diagnostics")
    assert set(endpoints) == {"tcp_port", "udp_port", "discovery_port", "pty", "trigger_port"}
    assert link.is_symlink()

    answer = observer.call(Trigger, "virtual_bench/trigger")
    assert answer.success, answer.message
    assert Path(answer.message).stat().st_size == 834 + 4 * 128 * 128

    client = [
        sys.executable,
        "-S",
        "-I",
        dm_simulation.interferometer.trigger.__file__,
        "--port",
        str(endpoints["trigger_port"]),
    ]
    target = folder / "asked.datx"
    run = subprocess.run([*client, "--output", str(target)], capture_output=True, text=True, timeout=30, check=False)
    assert (run.returncode, run.stdout.strip()) == (0, str(target))

    # One frame within the limits, then one that jumps: the bench's own watch tells them apart.
    with socket.create_connection(("127.0.0.1", endpoints["tcp_port"]), timeout=5) as electronics:
        electronics.sendall(b"\xff" * 5 + b"\0" + b"\x00\x01" * 40)
        wait_until(lambda: values_of(health).get("frames") == "1", what="one frame in the diagnostics")
        assert values_of(health)["violations"] == "0"
        electronics.sendall(b"\xff" * 5 + b"\0" + b"\x00\x80" * 40)
        wait_until(lambda: values_of(health).get("jumps") == "1", what="a jump in the diagnostics")

        assert observer.call(SetBool, "virtual_bench/power", SetBool.Request(data=False)).success
        electronics.settimeout(5)
        try:
            assert electronics.recv(1) == b""
        except ConnectionResetError:
            pass
    wait_until(lambda: values_of(health).get("plugged") == "False", what="unplugged in the diagnostics")
    assert observer.call(SetBool, "virtual_bench/power", SetBool.Request(data=True)).success
    socket.create_connection(("127.0.0.1", endpoints["tcp_port"]), timeout=5).close()

    assert process.stop() == 0
    assert "Traceback" not in process.output
    assert not link.is_symlink()


def test_fast_clock(start: Start, observer: Observer) -> None:
    ticks: list[Clock] = observer.record(Clock, "/clock")
    readings: list[Temperature] = observer.record(Temperature, "temperature", qos_profile_sensor_data)
    process = start("dm_simulation", "virtual_bench", {**SMALL, "clock.speed": 50.0, "use_sim_time": True})
    wait_until(lambda: len(ticks) > 200, 60, "ticks of /clock")
    wait_until(lambda: len(readings) > 5, 60, "readings of the thermometer")
    read = [Time.from_msg(reading.header.stamp).nanoseconds * 1e-9 for reading in readings]
    assert (read[-1] - read[0]) / (len(read) - 1) > 0.5 * READING_S
    times = [tick.clock.sec + tick.clock.nanosec * 1e-9 for tick in ticks]
    assert times == sorted(times)
    # 200 periods of at least 2 ms wall time each, 50 times as fast.
    assert times[-1] - times[0] > 0.9 * 50 * 0.002 * 200
    assert process.stop(signal.SIGTERM) == 0
    assert "Traceback" not in process.output


def test_images_of_the_camera(start: Start, observer: Observer) -> None:
    images: list[Image] = observer.record(Image, "image_raw", qos_profile_sensor_data)
    infos: list[CameraInfo] = observer.record(CameraInfo, "camera_info", qos_profile_sensor_data)
    process = start("dm_simulation", "virtual_bench", {**SMALL, "camera.rate": 30.0, "camera.width": 160})
    wait_until(lambda: len(images) > 10, 60, "images")
    first, last = images[0], images[-1]
    assert (last.width, last.height, last.encoding, len(last.data)) == (160, 240, "mono8", 160 * 240)
    wait_until(lambda: infos, 60, "camera_info")
    assert np.array_equal(infos[-1].p.reshape(3, 4)[:, :3], infos[-1].k.reshape(3, 3)) and infos[-1].k[0] > 0.0
    assert infos[-1].header.frame_id == last.header.frame_id == "camera_optical"
    assert np.array_equal(infos[-1].r.reshape(3, 3), np.eye(3)) and infos[-1].distortion_model == "plumb_bob"
    stamps = [Time.from_msg(image.header.stamp).nanoseconds for image in images]
    assert stamps == sorted(set(stamps))
    assert (stamps[-1] - stamps[0]) * 1e-9 > 0.9 * (len(stamps) - 1) / 30, "no faster than asked for"
    assert bytes(first.data) != bytes(last.data)
    assert process.stop() == 0
    assert "Traceback" not in process.output


def test_a_senseless_configuration_ends_with_the_reason(start: Start) -> None:
    wrong = start("dm_simulation", "virtual_bench", {**SMALL, "piezo.law": "magic"})
    assert wrong.process.wait(30) == 1
    assert "piezo.law = 'magic': must be one of none, prandtl_ishlinskii, preisach, bouc_wen" in wrong.output
    twice = start("dm_simulation", "virtual_bench", {**SMALL, "wiring": [3] * 37})
    assert twice.process.wait(30) == 1
    assert "wiring" in twice.output
