"""Start the nodes that a parameter file configures: ros2 launch dm_bringup suite.launch.py config:=FILE."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, GroupAction, OpaqueFunction, SetEnvironmentVariable
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import Node

from dm_bringup.nodes import LAUNCH_ARGUMENTS, arguments_of, node_environment, nodes_of
from dm_bringup.suite import load_config
from launch import LaunchDescription


def start_nodes(context):
    """One action a node; the virtual bench and the autofocus only where the file has a section for them."""
    values = {name: LaunchConfiguration(name).perform(context) for name, _default, _text in LAUNCH_ARGUMENTS}
    nodes = nodes_of(load_config(Path(values["config"])))
    return [
        Node(package=node.package, executable=node.name, output="screen", **arguments_of(node, values))
        for node in nodes
    ]


def generate_launch_description():
    environment = node_environment(Path(get_package_share_directory("dm_bringup")) / "config")
    nodes = [
        *(
            SetEnvironmentVariable(name, EnvironmentVariable(name, default_value=value))
            for name, value in environment.items()
        ),
        OpaqueFunction(function=start_nodes),
    ]
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, description=text, **({} if default is None else {"default_value": default}))
                for name, default, text in LAUNCH_ARGUMENTS
            ),
            # Scoped: what the nodes need is not left in the environment of a launch that includes this one.
            GroupAction(nodes, scoped=True),
        ]
    )
