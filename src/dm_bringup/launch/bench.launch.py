"""Start the virtual bench and the four nodes on it: ros2 launch dm_bringup bench.launch.py."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription


def generate_launch_description():
    share = Path(get_package_share_directory("dm_bringup"))
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "config",
                default_value=str(share / "config" / "bench.yaml"),
                description="parameter file of all nodes",
            ),
            DeclareLaunchArgument("namespace", default_value="", description="namespace; one per mirror"),
            Node(
                package="dm_simulation",
                executable="virtual_bench",
                namespace=LaunchConfiguration("namespace"),
                parameters=[LaunchConfiguration("config")],
                output="screen",
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(str(share / "launch" / "suite.launch.py")),
                launch_arguments={
                    "config": LaunchConfiguration("config"),
                    "namespace": LaunchConfiguration("namespace"),
                }.items(),
            ),
        ]
    )
