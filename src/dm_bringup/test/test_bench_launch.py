"""`ros2 launch dm_bringup bench.launch.py` starts, serves and ends without a complaint, by launch_testing."""

from __future__ import annotations

import re
import unittest
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("launch_testing", reason="launch_testing comes with ROS 2 from apt")

import launch_testing.actions
import launch_testing.asserts
import launch_testing.markers
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource

from dm_client import DeformableMirrorClient
from launch import LaunchDescription

LAUNCH = Path(__file__).resolve().parents[1] / "launch" / "bench.launch.py"


@pytest.mark.launch_test
@launch_testing.markers.keep_alive
def generate_test_description() -> LaunchDescription:
    bench = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(LAUNCH)), launch_arguments={"respawn": "false"}.items()
    )
    return LaunchDescription([bench, launch_testing.actions.ReadyToTest()])


class TestServed(unittest.TestCase):
    def test_the_nodes_take_requests(self) -> None:
        with DeformableMirrorClient() as client:
            client.wait_until_active(120.0)
            client.set_signals([0.1] * client.mirror_info.actuators)


@launch_testing.post_shutdown_test()
class TestEnded(unittest.TestCase):
    def test_nobody_complained(self, proc_output: Any, proc_info: Any) -> None:
        launch_testing.asserts.assertExitCodes(proc_info)
        said = "".join(each.text.decode() for each in proc_output)
        self.assertEqual(re.findall(r".*(?:WARN|ERROR|Traceback).*", said), [])
        self.assertIn("the mirror stands in the safe shape", said)
