"""The C++ examples built by colcon against the dm_msgs of the workspace, and the vision node among them at work.

The ROS 2 wheels have no rclcpp: in its place stands what is in `rclcpp_stand_in`, last in the path, so that it gives
way to a real one. Types, names and fields of the messages are checked, the libraries of dm_msgs are linked, and
package.xml, CMakeLists.txt and sources belong together. Topics go through the same rmw as everywhere; parameters are
those of the stand-in.
"""

from __future__ import annotations

import math
import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from builtin_interfaces.msg import Time
from dm_msgs.msg import ErrorCode, FocusRequest, FocusState
from rclpy.publisher import Publisher
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Range
from std_msgs.msg import Header

from dm_autofocus.optics import FocusOptics, dioptre_of
from dm_common.ros import qos
from support import Observer, wait_until

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "cpp"
SOURCES = sorted((EXAMPLE / "src").glob("*.cpp"))


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the built programs."""
    if not (ROOT / "install" / "dm_msgs").is_dir():
        pytest.skip("dm_msgs is not built in this checkout")
    folder = tmp_path_factory.mktemp("cpp")
    prefixes = os.pathsep.join([os.environ["CMAKE_PREFIX_PATH"], str(Path(__file__).parents[1] / "rclcpp_stand_in")])
    ninja = ["-GNinja"] if shutil.which("ninja") else []
    options = [*ninja, "-DCMAKE_CXX_FLAGS=-Werror", f"-DPython3_EXECUTABLE={sys.executable}"]
    shown = ["--event-handlers", "console_cohesion+"]
    done = subprocess.run(
        [sys.executable, "-m", "colcon", "build", "--base-paths", str(EXAMPLE), *shown, "--cmake-args", *options],
        cwd=folder,
        env={**os.environ, "CMAKE_PREFIX_PATH": prefixes},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "install" / "dm_example_cpp" / "lib" / "dm_example_cpp"


@pytest.mark.slow
@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.stem)
def test_the_examples_are_built_by_colcon(programs: Path, source: Path) -> None:
    assert b"libdm_msgs__rosidl_typesupport_cpp.so" in (programs / source.stem).read_bytes()


@pytest.mark.slow
def test_the_vision_node_asks_for_what_the_python_one_does(programs: Path, observer: Observer, tmp_path: Path) -> None:
    optics = FocusOptics.from_rest_distance(5.0)
    distances = dict(enumerate([0.5, 5.0, 6.0, 100.0, math.inf, 0.0], start=1))  # m, by the second of their stamp
    seen = observer.node.create_publisher(Range, "object_distance", qos_profile_sensor_data)
    states = observer.node.create_publisher(FocusState, "focus_state", qos.STATE)
    asked = observer.record(FocusRequest, "focus_request", qos.COMMAND)
    log = tmp_path / "log"

    def send(publisher: Publisher, message: Range | FocusState, sentence: str = "") -> None:
        """Again and again, as a camera does, until the node logs the sentence; without one, until it asks."""

        def heard() -> bool:
            publisher.publish(message)
            return sentence in log.read_text() if sentence else message.header in [request.header for request in asked]

        wait_until(heard, what=f"answer to {message}")

    command = [str(programs / "vision_node"), "--ros-args", "-p", "rest_distance:=5.0"]
    with log.open("w") as output, subprocess.Popen(command, stdout=output, stderr=output) as process:
        try:
            for second, distance in distances.items():
                send(seen, Range(header=Header(stamp=Time(sec=second, nanosec=5)), range=distance))
            for distance in (math.nan, -1.0):
                send(seen, Range(range=distance), f"distance = {distance}")
            issued = Header(stamp=Time(sec=1, nanosec=500_000_000))
            state = FocusState(header=issued, curvature=0.01, predicted_duration=0.02)
            send(states, state, "+0.2200 dioptre from 1.520 s on")
            send(states, FocusState(error_code=ErrorCode.BUSY, message="held"), "refused: held")
        finally:
            process.terminate()
    curvatures = {request.header.stamp.sec: request.curvature for request in asked}
    assert curvatures == pytest.approx({s: optics.curvature_for(dioptre_of(d)) for s, d in distances.items()})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("request_focus --ros-args -r __ns:=/left", "no action move_focus"),  # the curvature may be left out
        ("request_focus 0.01 --ros-args -r __ns:=/left", "no action move_focus"),
        ("request_focus 1/50", "curvature 1/50: must be a number"),
        ("vision_node --ros-args -p rest_distance:=-1.0", "rest_distance = -1.000000 m: must be above 0"),
    ],
)
def test_what_they_are_started_with_is_refused_in_words(programs: Path, domain: int, command: str, said: str) -> None:
    program, *arguments = command.split()
    ended = subprocess.run([str(programs / program), *arguments], capture_output=True, text=True, timeout=60.0)
    assert ended.returncode == 1 and said in ended.stderr


def test_its_package_names_what_it_uses() -> None:
    used = {name for source in SOURCES for name in re.findall(r'#include "(\w+)/', source.read_text())}
    package = ElementTree.parse(EXAMPLE / "package.xml").getroot()
    build = (EXAMPLE / "CMakeLists.txt").read_text()
    assert used == {item.text for item in package.findall("depend")}
    assert used == set(re.findall(r"find_package\((\w+)", build)) - {"ament_cmake"}
    assert f"project({package.findtext('name')})" in build
    assert all(f"src/{source.name}" in build for source in SOURCES)
