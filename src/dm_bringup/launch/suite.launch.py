"""Start the nodes that a parameter file configures: ros2 launch dm_bringup suite.launch.py config:=FILE."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    GroupAction,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
    TimerAction,
)
from launch.event_handlers import OnProcessStart
from launch.events import matches_action
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import LifecycleNode, Node
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from lifecycle_msgs.msg import Transition

from dm_bringup.nodes import (
    BY_EVENTS,
    HELD_SIGNALS,
    LAUNCH_ARGUMENTS,
    arguments_of,
    companions_of,
    namespace_of,
    node_environment,
    nodes_of,
    number,
)
from dm_bringup.suite import load_config
from launch import LaunchDescription

#: From the start of a process until it is asked to configure, s.
DISCOVERY_S = 3.0


def start_nodes(context):
    """One action per node; the virtual bench and the autofocus only where the file has a section for them."""
    values = {name: LaunchConfiguration(name).perform(context) for name, _default, _text in LAUNCH_ARGUMENTS}
    # None: launch puts the user's own launch-prefix, such as a debugger, before the commands, with its filter.
    prefix = None if LaunchConfiguration("launch-prefix", default="").perform(context) else HELD_SIGNALS
    actions = []
    pushed = LaunchConfiguration("ros_namespace", default="").perform(context)  # PushRosNamespace around this file
    config = load_config(Path(values["config"]), namespace_of(values, pushed))
    for node in nodes_of(config):
        action = (LifecycleNode if node.lifecycle else Node)(
            package=node.package,
            executable=node.name,
            name=node.name,
            exec_name=node.name,
            output="screen",
            prefix=prefix,
            **arguments_of(node, values),
        )
        if node.lifecycle and values["autostart"] == BY_EVENTS:
            actions += brought_up(action)
        actions.append(action)
    aggregation = Path(get_package_share_directory("dm_bringup")) / "launch" / "diagnostics.yaml"
    camera = number("virtual_bench: camera.rate", config.get("virtual_bench", {}).get("camera.rate", 0.0)) > 0.0
    companions = companions_of(values, aggregation, camera, pushed)
    return actions + [Node(output="screen", **others) for others in companions]


def brought_up(action):
    """Configure a node when its process has started, and activate it when that is done.

    Where somebody else configures it later, activating it is left to them.
    """
    requested = set()

    def change(transition):
        return [EmitEvent(event=ChangeState(lifecycle_node_matcher=matches_action(action), transition_id=transition))]

    def begin(_context):
        requested.add(action)
        return change(Transition.TRANSITION_CONFIGURE)

    def go_on(context):
        ours = bool(requested) and context.locals.event.goal_state == "inactive"
        requested.clear()
        return change(Transition.TRANSITION_ACTIVATE) if ours else []

    # A request that leaves before both sides have discovered each other is lost, and so is one to a process that died.
    start = TimerAction(period=DISCOVERY_S, actions=[OpaqueFunction(function=begin)])
    return [
        RegisterEventHandler(OnProcessStart(target_action=action, on_start=[start])),
        RegisterEventHandler(
            OnStateTransition(
                target_lifecycle_node=action, start_state="configuring", entities=[OpaqueFunction(function=go_on)]
            )
        ),
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
