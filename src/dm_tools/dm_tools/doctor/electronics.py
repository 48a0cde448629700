"""What the doctor checks of drive electronics: whether they are there; no output changes."""

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from dm_common.ros.domains import holders
from dm_tools.doctor.machine import Check, Finding

#: Cures for a link that does not open, for those kinds of electronics whose link can be tried.
CURES = {
    "edac40_tcp": "check power, cable and address (./dm exec python -m dm_driver.electronics.discover); it takes one "
    "client at a time: close the vendor's program, or stop the nodes that hold it",
    "microscope": "start the device server of python-microscope; it prints the value for electronics.address",
}


def electronics_checks(driver: Mapping[str, Any]) -> Iterator[Check]:
    """Checks that the parameters of the driver, which are all given, call for."""
    kind, address = driver["electronics.kind"], driver["electronics.address"]
    if kind in CURES and address:
        yield f"electronics at {address}", lambda: opens(kind, driver)
    discovery = driver["electronics.discovery_port"]
    if kind == "edac40_udp" and address and discovery:
        yield f"electronics at {address}", lambda: answers_discovery(address, discovery)
    device = driver["electronics.serial_port"]
    if kind in ("usb_dac40", "framed_serial") and device:
        yield f"serial port {device}", lambda: serial_port(Path(device).expanduser())


def opens(kind: str, driver: Mapping[str, Any]) -> Finding | None:
    """Try to open the link with the back end that the driver uses; no output changes."""
    from dm_driver.electronics import BACK_ENDS
    from dm_driver.electronics.base import ElectronicsSettings, LinkError

    address, port, channels = (driver[name] for name in ("electronics.address", "electronics.port", "mirror.actuators"))
    settings = ElectronicsSettings(address, port, channels=channels)
    try:
        with BACK_ENDS[kind](settings):
            return None
    except (LinkError, ValueError) as error:
        return Finding(str(error), CURES[kind])


def answers_discovery(address: str, port: int) -> Finding | None:
    from dm_driver.electronics.discovery import discover

    try:
        if discover(address, port, 1.0):
            return None
        reason = "no answer within 1 s"
    except OSError as error:
        reason = str(error)
    return Finding(f"no EDAC40 at {address}: discovery on UDP port {port}: {reason}", "check power, cable and address")


def serial_port(device: Path) -> Finding | None:
    if not device.exists():
        return Finding(
            f"{device} does not exist",
            "plug the unit in; `ls -l /dev/serial/by-id` lists the units under names that stay the same; for a unit "
            "behind a TCP port see docs/add-a-drive-unit.md",
        )
    if not os.access(device, os.R_OK | os.W_OK):
        group = _group(device)
        return Finding(
            f"no permission for {device}: it belongs to the group {group}",
            f"sudo usermod -aG {group} $USER, then log out and in again",
        )
    if users := holders([device.resolve()]):
        return Finding(
            f"{device} is in use by {', '.join(users)}",
            "end that program: two writers on one unit corrupt each other's frames",
            note=True,
        )
    return None


def _group(path: Path) -> str:
    try:
        return path.group()
    except KeyError:
        return str(path.stat().st_gid)
