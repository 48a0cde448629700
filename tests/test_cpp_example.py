"""The C++ example against the headers that the workspace generates from dm_msgs.

The ROS 2 wheels have the headers of messages but not rclcpp, for which the declarations in `rclcpp_stand_in` stand:
types, names and fields of the messages are checked, and that package.xml, CMakeLists.txt and source belong together.
With an installation of ROS 2 the package is built by colcon like any other.
"""

from __future__ import annotations

import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "cpp"


def test_the_example_compiles_against_the_messages() -> None:
    folders = [Path(__file__).parent / "rclcpp_stand_in", *(Path(sys.prefix) / "include").glob("*")]
    folders.append(ROOT / "install" / "dm_msgs" / "include" / "dm_msgs")
    command = ["g++", "-std=c++17", "-fsyntax-only", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    includes = [f"-I{folder}" if "stand_in" in str(folder) else f"-isystem{folder}" for folder in folders]
    done = subprocess.run(
        [*command, *includes, str(EXAMPLE / "src" / "request_focus.cpp")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_its_package_names_what_it_uses() -> None:
    used = set(re.findall(r'#include "(\w+)/', (EXAMPLE / "src" / "request_focus.cpp").read_text()))
    package = ElementTree.parse(EXAMPLE / "package.xml").getroot()
    build = (EXAMPLE / "CMakeLists.txt").read_text()
    assert used == {item.text for item in package.findall("depend")}
    assert used == set(re.findall(r"find_package\((\w+)", build)) - {"ament_cmake"}
    assert f"project({package.findtext('name')})" in build and "src/request_focus.cpp" in build
