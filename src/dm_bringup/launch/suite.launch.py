"""Start the nodes against hardware: ros2 launch dm_bringup suite.launch.py config:=FILE [camera:=true]."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

NODES = (
    ("dm_driver", "pdm_driver"),
    ("dm_calibration", "interferometer"),
    ("dm_calibration", "calibration"),
    ("dm_controller", "focus_controller"),
)


def generate_launch_description():
    profile = Path(get_package_share_directory("dm_bringup")) / "config" / "fastdds.xml"
    return LaunchDescription(
        [
            DeclareLaunchArgument("config", description="parameter file of all nodes, see config/hardware.yaml"),
            DeclareLaunchArgument("namespace", default_value="", description="namespace; one per mirror"),
            DeclareLaunchArgument("camera", default_value="false", description="true: start the node autofocus too"),
            SetEnvironmentVariable(
                "FASTRTPS_DEFAULT_PROFILES_FILE",
                EnvironmentVariable("FASTRTPS_DEFAULT_PROFILES_FILE", default_value=str(profile)),
            ),
            # Matrix products here take a millisecond; threads of several nodes would fight over the cores for longer.
            SetEnvironmentVariable("OPENBLAS_NUM_THREADS", "1"),
            *(
                Node(
                    package=package,
                    executable=executable,
                    namespace=LaunchConfiguration("namespace"),
                    parameters=[LaunchConfiguration("config")],
                    output="screen",
                )
                for package, executable in NODES
            ),
            Node(
                package="dm_autofocus",
                executable="autofocus",
                namespace=LaunchConfiguration("namespace"),
                parameters=[LaunchConfiguration("config")],
                output="screen",
                condition=IfCondition(LaunchConfiguration("camera")),
            ),
        ]
    )
