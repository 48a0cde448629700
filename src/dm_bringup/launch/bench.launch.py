"""Start the virtual bench and the nodes on it: ros2 launch dm_bringup bench.launch.py."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription


def generate_launch_description():
    share = Path(get_package_share_directory("dm_bringup"))
    bench = str(share / "config" / "bench.yaml")
    return LaunchDescription(
        [
            DeclareLaunchArgument("config", default_value=bench, description="parameter file of all nodes"),
            DeclareLaunchArgument("namespace", default_value="", description="namespace; one per mirror"),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(str(share / "launch" / "suite.launch.py")),
                launch_arguments={name: LaunchConfiguration(name) for name in ("config", "namespace")}.items(),
            ),
        ]
    )
