"""Start the virtual bench and the nodes on it: ros2 launch dm_bringup bench.launch.py."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

from dm_bringup.nodes import LAUNCH_ARGUMENTS
from launch import LaunchDescription


def generate_launch_description():
    share = Path(get_package_share_directory("dm_bringup"))
    bench = str(share / "config" / "bench.yaml")
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=bench if default is None else default, description=text)
                for name, default, text in LAUNCH_ARGUMENTS
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(str(share / "launch" / "suite.launch.py")),
                launch_arguments={name: LaunchConfiguration(name) for name, _, _ in LAUNCH_ARGUMENTS}.items(),
            ),
        ]
    )
