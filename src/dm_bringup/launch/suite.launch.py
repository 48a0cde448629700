"""Start the nodes that a parameter file configures: ros2 launch dm_bringup suite.launch.py config:=FILE."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import Node

from dm_bringup.nodes import node_environment, nodes_of
from dm_bringup.suite import load_config
from launch import LaunchDescription


def start_nodes(context):
    """One action a node; the virtual bench and the autofocus only where the file has a section for them."""
    config = Path(LaunchConfiguration("config").perform(context))
    return [
        Node(
            package=node.package,
            executable=node.name,
            namespace=LaunchConfiguration("namespace"),
            parameters=[str(config)],
            output="screen",
        )
        for node in nodes_of(load_config(config))
    ]


def generate_launch_description():
    environment = node_environment(Path(get_package_share_directory("dm_bringup")) / "config")
    return LaunchDescription(
        [
            DeclareLaunchArgument("config", description="parameter file of all nodes, see config/hardware.yaml"),
            DeclareLaunchArgument("namespace", default_value="", description="namespace; one per mirror"),
            *(
                SetEnvironmentVariable(name, EnvironmentVariable(name, default_value=value))
                for name, value in environment.items()
            ),
            OpaqueFunction(function=start_nodes),
        ]
    )
