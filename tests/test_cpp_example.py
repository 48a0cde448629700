"""The C++ example built by colcon, against the dm_msgs of the workspace.

The ROS 2 wheels have no rclcpp: in its place stands what is in `rclcpp_stand_in`, last in the path, so that it gives
way to a real one. Types, names and fields of the messages are checked, the libraries of dm_msgs are linked, and
package.xml, CMakeLists.txt and source belong together.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "cpp"


@pytest.mark.slow
@pytest.mark.skipif(not (ROOT / "install" / "dm_msgs").is_dir(), reason="dm_msgs is not built in this checkout")
def test_the_example_is_built_by_colcon(tmp_path: Path) -> None:
    prefixes = os.pathsep.join([os.environ["CMAKE_PREFIX_PATH"], str(Path(__file__).parent / "rclcpp_stand_in")])
    ninja = ["-GNinja"] if shutil.which("ninja") else []
    options = [*ninja, "-DCMAKE_CXX_FLAGS=-Werror", f"-DPython3_EXECUTABLE={sys.executable}"]
    done = subprocess.run(
        [sys.executable, "-m", "colcon", "build", "--base-paths", str(EXAMPLE), "--cmake-args", *options],
        cwd=tmp_path,
        env={**os.environ, "CMAKE_PREFIX_PATH": prefixes},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    program = tmp_path / "install" / "dm_example_cpp" / "lib" / "dm_example_cpp" / "request_focus"
    assert b"libdm_msgs__rosidl_typesupport_cpp.so" in program.read_bytes()


def test_its_package_names_what_it_uses() -> None:
    used = set(re.findall(r'#include "(\w+)/', (EXAMPLE / "src" / "request_focus.cpp").read_text()))
    package = ElementTree.parse(EXAMPLE / "package.xml").getroot()
    build = (EXAMPLE / "CMakeLists.txt").read_text()
    assert used == {item.text for item in package.findall("depend")}
    assert used == set(re.findall(r"find_package\((\w+)", build)) - {"ament_cmake"}
    assert f"project({package.findtext('name')})" in build and "src/request_focus.cpp" in build
