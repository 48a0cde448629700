"""The nodes of the suite: the one list used by launch files, `./dm`, reference pages, security and recordings.

Standard library only, since `./dm` takes the environment of the nodes from here before it has one.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Any


@dataclass(frozen=True)
class SuiteNode:
    """One node.

    Attributes:
        name: of the node and of its executable; `some_name` is the class `SomeNameNode` in `<package>.some_name_node`.
        package: that contains it.
        parameter_module: of the package; its `PARAMETERS` is the table of the node's parameters.
        configuring: "module:function" of the package that makes the node's parts from the values of all its parameters,
            or checks these, raising ValueError; "" = all values that the table allows are valid.
        lifecycle: whether it is a lifecycle node.
        optional: whether it runs only if a configuration has a section for it.
    """

    name: str
    package: str
    parameter_module: str
    configuring: str = ""
    lifecycle: bool = True
    optional: bool = False

    @property
    def module(self) -> str:
        """Name of the module to start with `python -m`."""
        return f"{self.package}.{self.name}_node"

    def load_class(self) -> Any:
        """The class of the node; imports what the node needs."""
        return resolve_name(f"{self.module}:{self.name.title().replace('_', '')}Node")

    def load_parameters(self) -> tuple[Any, ...]:
        """The table of the node's parameters, each a `dm_common.ros.parameters.Parameter`."""
        table: tuple[Any, ...] = resolve_name(f"{self.package}.{self.parameter_module}:PARAMETERS")
        return table

    def load_configuring(self) -> Callable[[Mapping[str, Any]], Any] | None:
        """The function of `configuring`; None if there is none."""
        return resolve_name(f"{self.package}.{self.configuring}") if self.configuring else None


#: In the order of their start. They stop together, except for the bench, which must outlive the driver's last ramp.
NODES = (
    SuiteNode("virtual_bench", "dm_simulation", "parameters", "parameters:check_bench", lifecycle=False, optional=True),
    SuiteNode("pdm_driver", "dm_driver", "driver_parameters", "driver_configuration:build_configuration"),
    SuiteNode("interferometer", "dm_calibration", "interferometer_parameters", "interferometer_parameters:configure"),
    SuiteNode("calibration", "dm_calibration", "calibration_parameters"),
    SuiteNode("focus_controller", "dm_controller", "focus_parameters"),
    SuiteNode("autofocus", "dm_autofocus", "autofocus_parameters", "autofocus_parameters:focus_optics", optional=True),
)
NAMES = tuple(node.name for node in NODES)
#: Modules for `python -m` by the name of the node.
MODULES = {node.name: node.module for node in NODES}


def nodes_of(configured: Collection[str]) -> tuple[SuiteNode, ...]:
    """The nodes that run with a configuration that has sections for `configured`."""
    return tuple(node for node in NODES if node.name in configured or not node.optional)


def node_environment(config_folder: Path) -> dict[str, str]:
    """Environment variables of every process, unless the user sets them; `config_folder`: `config` of this package."""
    return {
        "FASTRTPS_DEFAULT_PROFILES_FILE": str(config_folder / "fastdds.xml"),
        # Matrix products here take a millisecond; threads of several nodes would compete for the cores for longer.
        "OPENBLAS_NUM_THREADS": "1",
    }


#: Prefix of the command of a node in a launch file: signals wait until the node can end in order (`run_node` unblocks
#: them), instead of ending in tracebacks of the modules that it imports.
HELD_SIGNALS = "env --block-signal=INT --block-signal=TERM"
#: From a frame with x forward and z up to an optical one, z forward and x to the right (REP 103), as in `place`.
OPTICAL = "0 0 0 -1.5707963 0 -1.5707963"
#: Value of the launch argument `autostart`: nodes are configured and activated from outside.
BY_EVENTS = "events"
LOG_LEVELS = ("debug", "info", "warn", "error", "fatal")
#: Arguments of the launch files: name, default (None = `config` must be given) and description.
LAUNCH_ARGUMENTS = (
    ("config", None, "parameter file of all nodes, see config/hardware.yaml"),
    ("namespace", "", "namespace; one per mirror"),
    ("respawn", "true", "start a node that died again"),
    ("respawn_delay", "2.0", "s before that"),
    ("log_level", "info", f"of every node: {', '.join(LOG_LEVELS)}"),
    ("remap", "", "remappings of every node, separated by blanks: image_raw:=/camera/image_raw"),
    ("use_sim_time", "", "true or false; empty = as the parameter file says"),
    (
        "autostart",
        "",
        "true: each node configures and activates itself, also when it was started again; false: a lifecycle manager "
        "does; events: this launch does, but for nodes that were killed; empty = as in the file",
    ),
    ("place", "", "of the mirror, x y z [m] yaw pitch roll [rad] frame: tf2_ros publishes it; empty = not known"),
    ("foxglove", "false", "with a bridge for Foxglove (package foxglove_bridge)"),
    ("aggregator", "false", "with an aggregator of diagnostics (package diagnostic_aggregator)"),
)


def arguments_of(node: SuiteNode, values: Mapping[str, str]) -> dict[str, Any]:
    """Keyword arguments of the launch action that starts a node.

    Args:
        values: of LAUNCH_ARGUMENTS, as text.

    Raises:
        ValueError: an invalid value; the message names the argument, the value and what is allowed.
    """
    if (level := values["log_level"].rpartition(":=")[2].lower()) not in LOG_LEVELS:  # may be that of one logger
        raise ValueError(f"log_level = {level!r}: must be one of {', '.join(LOG_LEVELS)}")
    switches = {}
    if values["use_sim_time"]:
        switches["use_sim_time"] = flag("use_sim_time", values["use_sim_time"])
    if node.lifecycle and (autostart := values["autostart"]):
        switches["autostart"] = autostart != BY_EVENTS and flag("autostart", autostart, BY_EVENTS)
    return {
        "namespace": values["namespace"],
        "parameters": [values["config"], switches] if switches else [values["config"]],
        "remappings": [remapping(rule) for rule in values["remap"].split()],
        "arguments": ["--ros-args", "--log-level", values["log_level"]],
        "respawn": flag("respawn", values["respawn"]),
        "respawn_delay": number("respawn_delay", values["respawn_delay"]),
    }


def namespace_of(values: Mapping[str, str], pushed: str) -> str:
    """The namespace of the nodes, without slashes around it; an absolute one in `values` replaces what is `pushed`."""
    own = values["namespace"]
    return own.strip("/") if own.startswith("/") else f"{pushed.strip('/')}/{own.strip('/')}".strip("/")


def companions_of(
    values: Mapping[str, str], aggregation: Path, camera: bool = False, pushed: str = ""
) -> list[dict[str, Any]]:
    """Keyword arguments of the launch actions that start programs of other packages beside the suite.

    Args:
        values: of LAUNCH_ARGUMENTS, as text.
        aggregation: parameter file of the aggregator.
        camera: whether the simulation has a camera.
        pushed: namespace in which all of this is launched.

    Raises:
        ValueError: as `arguments_of`.
    """
    found: list[dict[str, Any]] = []
    places = {"mirror": values["place"]} if values["place"] else {}
    prefix = f"{namespace_of(values, pushed)}/".lstrip("/")
    if camera:
        places["camera_optical"] = f"{OPTICAL} {prefix}camera_link"
    for child, place in places.items():
        *numbers, frame = place.split()
        names = ("x", "y", "z", "yaw", "pitch", "roll")
        if len(numbers) != len(names):
            raise ValueError(f"place = {place!r}: must be {' '.join(names)} frame")
        for text in numbers:
            number("place", text)
        options = dict(zip(names, numbers, strict=True)) | {"frame-id": frame, "child-frame-id": prefix + child}
        arguments = [word for name, text in options.items() for word in (f"--{name}", text)]
        node = {"name": f"{child}_place", "namespace": values["namespace"], "arguments": arguments}
        found.append({"package": "tf2_ros", "executable": "static_transform_publisher", **node})
    if flag("foxglove", values["foxglove"]):
        found.append({"package": "foxglove_bridge", "executable": "foxglove_bridge"})
    if flag("aggregator", values["aggregator"]):
        node = {"package": "diagnostic_aggregator", "executable": "aggregator_node"}
        found.append(node | {"parameters": [str(aggregation)]})
    return found


def remapping(rule: str) -> tuple[str, str]:
    """The names in `from:=to`; raises ValueError for another form."""
    old, _, new = rule.partition(":=")
    if not (old and new):
        raise ValueError(f"remap: {rule!r}: must be of the form from:=to")
    return old, new


def number(name: str, text: Any) -> float:
    """`text` as a number. Raises ValueError if it is not one; `name` is for the message."""
    try:
        return float(text)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: {text!r}: must be a number") from None


def flag(name: str, text: str, other: str = "") -> bool:
    """`text` as true or false. Raises ValueError if it is neither; the message also names the allowed value `other`."""
    if text.lower() not in ("true", "false"):
        raise ValueError(f"{name} = {text!r}: must be true{f', {other}' if other else ''} or false")
    return text.lower() == "true"
