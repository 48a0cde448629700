"""What every node of the suite publishes, subscribes to, offers and calls: the one source of all policies.

`tests/repository/test_security_profile.py` starts the nodes and compares this table with their ROS graph: no interface
may be missing, and none may be listed that no node uses.
"""

from dataclasses import dataclass, replace

from dm_bringup.nodes import NODES

#: Services of every node.
PARAMETER_SERVICES = (
    "~/describe_parameters",
    "~/get_parameter_types",
    "~/get_parameters",
    "~/get_type_description",
    "~/list_parameters",
    "~/set_parameters",
    "~/set_parameters_atomically",
)
LIFECYCLE_SERVICES = (
    "~/change_state",
    "~/get_available_states",
    "~/get_available_transitions",
    "~/get_state",
    "~/get_transition_graph",
)
LOGS = ("/parameter_events", "/rosout")
#: Whoever may publish on this topic controls the time of all others.
CLOCK = "/clock"
HEALTH = "/diagnostics"
#: What an operator's program subscribes to and calls.
_SUBSCRIBED = (HEALTH, "actuator_state", "calibration", "capabilities", "mirror_info", "recipes")
_MAPS = ("surface_map", "surface_map_info")
_OPERATION = ("flatten", "hold_mirror", "list_calibrations", "load_calibration", "measure", "set_focus", "set_signals")
_LONG_OPERATION = ("build_recipes", "calibrate", "converge", "degauss", "move_focus")


@dataclass(frozen=True)
class NodeInterface:
    """One node's interfaces. Names are relative to the mirror's namespace, `~` is the node, `/` begins a global name.

    Attributes:
        name: of the node; `*` in place of the process number.
        publish, subscribe: topics.
        reply, request: services that the node offers and calls.
        execute, call: actions that it offers and calls.
        enclave: last part of the enclave's path; "" = the name.
    """

    name: str
    publish: tuple[str, ...] = ()
    subscribe: tuple[str, ...] = ()
    reply: tuple[str, ...] = ()
    request: tuple[str, ...] = ()
    execute: tuple[str, ...] = ()
    call: tuple[str, ...] = ()
    enclave: str = ""


#: The nodes of a bench, and the programs that talk to them; without what `interfaces` adds.
_DECLARED = (
    NodeInterface(
        "pdm_driver",
        publish=("actuator_state", "mirror_info"),
        subscribe=("actuator_command",),
        reply=("hold_mirror", "set_signals"),
        execute=("degauss",),
    ),
    NodeInterface(
        "interferometer",
        publish=("surface_map", "surface_map_info", "surface_samples", "zernike"),
        subscribe=("mirror_info",),
        reply=("ingest_file", "measure"),
    ),
    NodeInterface(
        "calibration",
        publish=("calibration", "recipes"),
        subscribe=("actuator_state", "mirror_info", "surface_map_info", "surface_samples", "temperature", "zernike"),
        reply=(
            *("fit_influence_function", "fit_regression", "list_calibrations", "load_calibration"),
            *("predict_error", "store_recipes", "update_calibration"),
        ),
        request=("hold_mirror", "measure", "set_signals"),
        execute=("calibrate",),
        call=("degauss",),
    ),
    # Sends the mirror to mid range when the node ends during a run: the same process, with a node of its own.
    NodeInterface("calibration_exit", request=("set_signals",), enclave="calibration"),
    NodeInterface(
        "focus_controller",
        publish=("actuator_command", "actuator_estimate", "capabilities", "focus_state"),
        subscribe=("actuator_state", "calibration", "focus_request", "mirror_info", "recipes", "surface_map_info"),
        reply=("flatten", "set_focus"),
        request=("hold_mirror", "measure", "predict_error", "set_signals", "store_recipes"),
        execute=("build_recipes", "converge", "move_focus"),
        call=("degauss",),
    ),
    NodeInterface(
        "autofocus",
        publish=(
            *("autofocus_state", "focus_request"),
            *("focus_stack/camera_info", "focus_stack/depth", "focus_stack/image"),
        ),
        subscribe=(
            *("actuator_state", "capabilities", "focus_state"),
            *("camera_info", "image_raw", "image_raw/compressed"),
        ),
        reply=("get_focus_range", "set_focus_distance"),
        request=("hold_mirror", "set_focus"),
        execute=("autofocus", "focus_stack"),
    ),
    NodeInterface(
        "dm_console_*",
        subscribe=(*_SUBSCRIBED, *_MAPS, "/rosout", "actuator_estimate", "zernike"),
        request=_OPERATION,
        call=_LONG_OPERATION,
        enclave="console",
    ),
    NodeInterface(
        "dm_client_*",
        subscribe=(*_SUBSCRIBED, *_MAPS),
        request=(*_OPERATION, "ingest_file", "update_calibration"),
        call=_LONG_OPERATION,
        enclave="cli",
    ),
    # Only where there is a simulation instead of hardware: whoever holds this enclave sets the time of all others.
    NodeInterface(
        "virtual_bench",
        publish=(CLOCK, "camera_info", "image_raw", "temperature", "~/endpoints"),
        reply=("~/power", "~/trigger"),
    ),
)


def interfaces(simulation: bool = False, sensor: str = "") -> tuple[NodeInterface, ...]:
    """The interfaces of all nodes, with what every node has.

    Args:
        simulation: with the virtual bench and its clock.
        sensor: topic that the interferometer takes coefficients from (its parameter `zernike_topic`); "" = map files.
    """
    suite = {node.name: node for node in NODES}
    found = []
    for node in _DECLARED:
        if node.name == "virtual_bench" and not simulation:
            continue
        enclave = node.enclave or node.name
        publish, subscribe, reply = node.publish + LOGS, node.subscribe, node.reply + PARAMETER_SERVICES
        if node.name in suite:
            publish += (HEALTH,)
            if suite[node.name].lifecycle:
                publish += ("~/transition_event",)
                reply += LIFECYCLE_SERVICES
        if node.name == "interferometer" and sensor:
            subscribe += (sensor,)
        if simulation and enclave in suite and enclave != "virtual_bench":  # they go by simulated time
            subscribe += (CLOCK,)
        found.append(replace(node, publish=publish, subscribe=subscribe, reply=reply, enclave=enclave))
    return tuple(found)
