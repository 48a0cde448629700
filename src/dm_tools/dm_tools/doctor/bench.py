"""What the doctor checks on one bench: its file, ports, folders, the calibration in store."""

import os
import shutil
import socket
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

from dm_bringup.nodes import NODES, SuiteNode, nodes_of
from dm_bringup.sections import ConfigError
from dm_bringup.suite import Config, load_config
from dm_common.errors import unknown_name
from dm_common.ros.domains import held_by
from dm_common.ros.parameters import REQUIRED, Parameter, ParameterError
from dm_common.state_files import ros_home
from dm_common.values import switch
from dm_tools.doctor.electronics import electronics_checks
from dm_tools.doctor.machine import Check, Finding, disk

UNSET = "CHANGE"
DAY_S = 86400.0
#: Parameter that ROS gives every node.
COMMON = Parameter("use_sim_time", switch(False), "Take the time from /clock.")
#: Ports that the virtual bench opens, by their parameters, and their protocols.
BENCH_PORTS = {
    "electronics.tcp_port": "TCP",
    "electronics.udp_port": "UDP",
    "electronics.discovery_port": "UDP",
    "trigger.port": "TCP",
}


def bench_checks(file: Path, namespace: str = "") -> Iterator[Check]:
    """Checks that the file calls for, of the mirror in this namespace; "" = in any."""
    try:
        config = load_config(file, namespace.strip("/"))
    except ConfigError as error:
        reason = str(error)
        template = "correct the file; src/dm_bringup/config/hardware.yaml is a template"
        yield f"configuration {file}", lambda: Finding(reason, template)
        return
    yield "required parameters", lambda: required_parameters(config)
    yield "values of your own", lambda: own_values(config)
    yield "parameters", lambda: parameters(config)
    for node in nodes_of(config):
        if node.configuring:
            yield f"configuration of {node.name}", partial(node_configuration, config, node)
    yield "aperture of the maps", lambda: aperture_fits(config)
    yield "record of creep", lambda: one_record(config)
    driver, interferometer = effective(config, "pdm_driver"), effective(config, "interferometer")
    yield "trigger command", lambda: trigger_program(interferometer["trigger_command"])
    made = "virtual_bench" in config
    if made:
        yield "ports of the virtual bench", lambda: taken_ports(config)
    else:
        yield from electronics_checks(driver)
    for name in ("pdm_driver", "focus_controller"):
        if folder := effective(config, name)["state_folder"]:
            yield f"state folder of {name}", partial(writable_folder, ros_home(folder))
    if interferometer["watch_folder"]:
        watched = Path(interferometer["watch_folder"]).expanduser()
        writes = "{path}" in " ".join(interferometer["trigger_command"])
        yield f"watched folder {watched}", lambda: watched_folder(watched, writes, made)
    calibration = effective(config, "calibration")
    if calibration["calibration_folder"]:
        store = Path(calibration["calibration_folder"]).expanduser()
        yield f"calibration folder {store}", lambda: writable_folder(store)
        if (serial := driver["mirror.serial"]) not in ("", REQUIRED):
            yield "calibration", lambda: stored_calibration(store, serial, calibration["updates.stale_after"])


@cache
def _known(name: str) -> dict[str, Parameter]:
    """The parameters of a node, by their names."""
    return {item.name: item for node in NODES if node.name == name for item in (*node.load_parameters(), COMMON)}


def effective(config: Config, name: str) -> dict[str, Any]:
    """All values of a node: of those in its section the ones that are set and valid, and defaults for the others."""
    given = config.get(name, {})
    problems = _problems(name, given)
    valid = {key: value for key, value in given.items() if value != UNSET and key not in problems}
    return {item.name: item.default for item in _known(name).values()} | valid


def required_parameters(config: Config) -> Finding | None:
    driver = config.get("pdm_driver", {})
    missing = [name for name, item in _known("pdm_driver").items() if item.default is REQUIRED and name not in driver]
    cure = "add them; docs/parameters.md says what each of them means"
    return Finding(f"pdm_driver lacks {', '.join(missing)}", cure) if missing else None


def own_values(config: Config) -> Finding | None:
    unset = [f"{node}.{name}" for node, values in config.items() for name, value in values.items() if value == UNSET]
    return Finding(f"still {UNSET}: {', '.join(unset)}", "put in the values of your bench") if unset else None


def parameters(config: Config) -> Finding | None:
    """Report unknown names, wrong types and values out of range, all of them at once."""
    wrong = [f"{node}: {text}" for node, values in config.items() for text in _problems(node, values).values()]
    cure = "correct the file; docs/parameters.md lists every parameter with its range"
    return Finding("; ".join(wrong), cure) if wrong else None


def _problems(node: str, values: Mapping[str, Any]) -> dict[str, str]:
    """What is wrong with the values of a node, by parameter name; values that are still to be set are left out."""
    known, found = _known(node), {}
    for name, value in values.items():
        if name in known and value != UNSET:
            try:
                known[name].check(value)
            except ParameterError as error:
                found[name] = str(error)
        elif name not in known:
            found[name] = str(unknown_name("parameter", name, known))
    return found


def node_configuration(config: Config, node: SuiteNode) -> Finding | None:
    """Check that the values of `node` fit each other, with the function by which the node configures itself."""
    own, configuring = {node.name: config.get(node.name, {})}, node.load_configuring()
    missing = node.name == "pdm_driver" and required_parameters(config)
    if configuring is None or missing or own_values(own) or parameters(own):
        return None  # nothing to check, or reported already
    try:
        configuring(effective(own, node.name))
    except ValueError as error:
        return Finding(str(error), f"correct the value; {node.name} refuses to configure with it")
    return None


def aperture_fits(config: Config) -> Finding | None:
    """Whether the aperture that is configured for maps lies on the mirror, and is the working aperture."""
    from dm_calibration.acquisition.ingest import too_large

    radius = effective(config, "interferometer")["aperture.radius"]
    driver = effective(config, "pdm_driver")
    if problem := too_large(radius, 0.5 * driver["mirror.full_aperture_diameter"]):
        return Finding(problem, "correct it, or mirror.full_aperture_diameter of pdm_driver")
    working = 0.5 * driver["mirror.working_aperture_diameter"]
    tolerance = effective(config, "calibration")["aperture_tolerance"]
    if radius > 0.0 and "pdm_driver" in config and abs(radius - working) > tolerance * working:
        problem = f"aperture.radius = {radius:g} m: the working aperture of the mirror has a radius of {working:g} m"
        return Finding(problem, "correct it, or mirror.working_aperture_diameter of pdm_driver: maps would be refused")
    return None


def one_record(config: Config) -> Finding | None:
    """Whether both nodes that follow the actuators begin with the same record of what these have crept to."""
    nodes = ("focus_controller", "calibration")
    folders = {node: effective(config, node)["state_folder"] for node in nodes}
    if len(set(folders.values())) < 2:
        return None
    listed = ", ".join(f"{node}: {folder!r}" for node, folder in folders.items())
    return Finding(
        f"state_folder differs ({listed}): maps would be compared with another creep state", "give both nodes the same"
    )


def trigger_program(command: Sequence[str]) -> Finding | None:
    """Whether the program of the trigger command is installed."""
    if not command or shutil.which(command[0]):
        return None
    return Finding(f"trigger_command = {command[0]!r}, ...: no such program", "correct it, or give its whole path")


def taken_ports(config: Config) -> Finding | None:
    """Ports of the virtual bench that other programs hold; None = all are free. A wrong value counts as its default."""
    values, taken = effective(config, "virtual_bench"), []
    for name, protocol in BENCH_PORTS.items():
        port, kind = values[name], socket.SOCK_STREAM if protocol == "TCP" else socket.SOCK_DGRAM
        if port <= 0:
            continue
        with socket.socket(socket.AF_INET, kind) as probe:
            if kind == socket.SOCK_STREAM:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("127.0.0.1", port))
            except OSError as error:
                taken.append(f"{name} = {port}: {error.strerror}{held_by(port)}")
    if taken:
        return Finding(
            "; ".join(taken),
            "stop the ./dm up that is running, or the program that holds the port (ss -lntup shows it); or give the "
            "virtual bench and its clients other ports in a parameter file",
        )
    return None


def watched_folder(folder: Path, written: bool, made: bool) -> Finding | None:
    """Check that maps can be read in `folder`, and written if a trigger command writes them there.

    Args:
        written: the trigger command writes maps there.
        made: a virtual bench makes the folder when it starts.
    """
    if made and not folder.exists():
        return writable_folder(folder)
    if not folder.is_dir():
        what = "is not a folder" if folder.exists() else "does not exist"
        return Finding(f"{folder} {what}", "create or mount it; the instrument saves its maps there")
    if not os.access(folder, os.R_OK | os.X_OK):
        return Finding(f"{folder} cannot be read", f"give this user the right to read it: chmod u+rx {folder}")
    if written and not os.access(folder, os.W_OK):
        return Finding(f"{folder} cannot be written to, and trigger_command saves maps there", f"chmod u+w {folder}")
    return None


def writable_folder(folder: Path) -> Finding | None:
    """Whether a folder can be written to, or made."""
    nearest = next(place for place in (folder, *folder.parents) if place.exists())
    if not nearest.is_dir():
        return Finding(f"{nearest} is not a folder", "choose another folder, or remove the file")
    if not os.access(nearest, os.W_OK | os.X_OK):
        what = "cannot be written to" if nearest == folder else f"cannot be made: {nearest} cannot be written to"
        return Finding(f"{folder} {what}", f"choose another folder, or: sudo chown $USER {nearest}")
    return disk(nearest) if shutil.disk_usage(nearest).free != shutil.disk_usage(Path.home()).free else None


def stored_calibration(folder: Path, serial: str, stale_after: float) -> Finding | None:
    """Check for a readable calibration of this mirror that was measured or confirmed in the last `stale_after` s."""
    from dm_calibration.recalibration.check_log import SUFFIX, read_checks
    from dm_calibration.store.calibration_store import CalibrationStore

    store = CalibrationStore(folder)
    entries = store.entries()
    own = [found for entry in entries if (found := entry.calibration) and found.mirror_serial == serial]
    damaged = [entry for entry in entries if entry.calibration is None]
    if damaged:
        remarks = "; ".join(entry.remark for entry in damaged)
        return Finding(remarks, f"move the named files out of {folder}; restore it from your backup if you need it")
    if not own:
        other = sorted({entry.calibration.mirror_serial for entry in entries if entry.calibration})
        seen = f"; it holds those of {', '.join(other)}" if other else ""
        return Finding(
            f"no calibration of the mirror {serial} in {folder}{seen}", "./dm calibrate, once the nodes run", note=True
        )
    last = store.last_in_use(serial)
    used = next((one for one in own if one.id == last), own[0])
    agreed = [check.time for check in read_checks(folder / f"{used.id}{SUFFIX}") if check.accepted]
    checked = max([used.stamp_ns * 1e-9, *agreed])
    days = (time.time() - checked) / DAY_S
    if days * DAY_S > stale_after:
        return Finding(
            f"no map has agreed with {used.id} for {days:.0f} days",
            "./dm check says whether it still holds, and corrects small drifts; else ./dm calibrate",
            note=True,
        )
    return None
