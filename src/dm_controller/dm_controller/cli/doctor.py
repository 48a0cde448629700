"""`dm doctor`: what is wrong on this machine or bench, in words, and how to cure it."""

from __future__ import annotations

import os
import shutil
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from dm_controller.cli.output import JsonOption, console, write_json

#: What a check found: None when all is well, else (what is wrong, the cure).
Finding = tuple[str, str] | None


def _imports() -> Finding:
    import importlib

    for name in (
        "rclpy",
        "dm_msgs.msg",
        "dm_driver",
        "dm_calibration",
        "numpy",
        "scipy",
        "statsmodels",
        "h5py",
        "serial",
    ):
        try:
            importlib.import_module(name)
        except ImportError as error:
            return (f"cannot import {name}: {error}", "remove the folder .venv and run ./dm again")
    return None


def _profile() -> Finding:
    path = os.environ.get("FASTRTPS_DEFAULT_PROFILES_FILE", "")
    if not Path(path).is_file():
        return (
            "no Fast DDS profile is loaded: surface maps travel slowly",
            "run through ./dm, or export FASTRTPS_DEFAULT_PROFILES_FILE=<share>/dm_controller/config/fastdds.xml",
        )
    return None


def _shared_memory() -> Finding:
    free = shutil.disk_usage("/dev/shm").free if Path("/dev/shm").is_dir() else 0
    if free < 128e6:
        return (
            f"/dev/shm has {free / 1e6:.0f} MB free; each node takes 17 MB",
            "remove stale fastrtps_* files from /dev/shm",
        )
    return None


def _dds() -> Finding:
    from dm_controller.client import DeformableMirrorClient, DeformableMirrorError

    with DeformableMirrorClient() as first, DeformableMirrorClient() as second:
        from std_msgs.msg import String

        received: list[Any] = []
        second.node.create_subscription(String, "doctor_echo", received.append, 1)
        publisher = first.node.create_publisher(String, "doctor_echo", 1)
        try:
            if not first.wait(lambda: publisher.get_subscription_count() > 0, 5.0):
                return (
                    "two nodes on this machine do not find each other",
                    "check ROS_AUTOMATIC_DISCOVERY_RANGE and firewalls",
                )
            publisher.publish(String(data="?"))
            if not first.wait(lambda: received, 2.0):
                return ("a message between two nodes did not arrive", "remove stale files with: fastdds shm clean")
        except DeformableMirrorError as error:
            return (str(error), "run ./dm again")
    return None


def _disk() -> Finding:
    free = shutil.disk_usage(Path.home()).free
    return (
        (f"{free / 1e9:.1f} GB free in {Path.home()}", "make room: a calibration keeps its maps")
        if free < 1e9
        else None
    )


def _clock() -> Finding:
    if time.time() < 1.6e9:
        return ("the system clock is far in the past", "set the clock: time stamps of maps and commands depend on it")
    return None


def _bench_checks(config: Path) -> Iterator[tuple[str, Callable[[], Finding]]]:
    from dm_controller.suite import ConfigError, load_config

    try:
        content = load_config(config)
    except ConfigError as error:
        reason = str(error)
        yield f"configuration {config}", lambda: (reason, "correct the file; config/hardware.yaml is a template")
        return
    driver = content.get("pdm_driver", {})
    required = ["mirror.serial", "electronics.kind"] + [
        f"volts.{name}" for name in ("dac_at_zero", "dac_at_full", "amplifier_gain", "min", "max")
    ]
    missing = [name for name in required if name not in driver]
    yield (
        "required parameters",
        lambda: (
            (f"pdm_driver lacks {', '.join(missing)}", "add them; docs/parameters.md tells what each means")
            if missing
            else None
        ),
    )
    unset = [
        f"{node}.{name}" for node, values in content.items() for name, value in values.items() if value == "CHANGE"
    ]
    yield (
        "values of your own",
        lambda: (f"still CHANGE: {', '.join(unset)}", "put in the values of your bench") if unset else None,
    )
    kind, address = driver.get("electronics.kind"), str(driver.get("electronics.address", ""))
    port = int(driver.get("electronics.port", 1234))
    if kind == "edac40_tcp" and address != "CHANGE" and "virtual_bench" not in content:
        yield f"electronics at {address}:{port}", lambda: _tcp(address, port)
    if kind == "usb_dac40":
        device = str(driver.get("electronics.serial_port", ""))
        yield f"serial port {device}", lambda: _serial(device)
    folder = str(content.get("interferometer", {}).get("watch_folder", ""))
    if folder and folder != "CHANGE":
        yield f"watched folder {folder}", lambda: _folder(Path(folder).expanduser(), "virtual_bench" in content)


def _tcp(address: str, port: int) -> Finding:
    try:
        socket.create_connection((address, port), 2.0).close()
    except OSError as error:
        return (
            f"no EDAC40 answers at {address}:{port}: {error}",
            "check power, cable and address (./dm exec python -m dm_driver.discover); it takes one client at a time",
        )
    return None


def _serial(device: str) -> Finding:
    if not Path(device).exists():
        return (f"{device} does not exist", "plug the unit in; `ls /dev/ttyUSB*` shows the ports")
    if not os.access(device, os.R_OK | os.W_OK):
        return (f"no permission for {device}", "sudo usermod -aG dialout $USER, then log in again")
    return None


def _folder(path: Path, virtual: bool) -> Finding:
    if not path.is_dir() and not virtual:
        return (f"{path} is not a folder", "create or mount it; the instrument saves its maps there")
    return None


def doctor(
    config: Annotated[Path | None, typer.Option(help="Check this bench configuration too.")] = None,
    json: JsonOption = None,
) -> None:
    """Say what is wrong on this machine or bench, and how to cure it."""
    checks: list[tuple[str, Callable[[], Finding]]] = [
        ("packages", _imports),
        ("Fast DDS profile", _profile),
        ("shared memory", _shared_memory),
        ("messages between nodes", _dds),
        ("disk", _disk),
        ("clock", _clock),
    ]
    if config is not None:
        checks += _bench_checks(config)
    findings = {}
    for name, run in checks:
        finding = run()
        findings[name] = None if finding is None else {"problem": finding[0], "cure": finding[1]}
        if finding is None:
            console.print(f"[green]ok[/]    {name}")
        else:
            console.print(f"[red]WRONG[/] {name}: {finding[0]}\n      cure: {finding[1]}", soft_wrap=True)
    write_json(json, {"doctor": findings})
    if any(findings.values()):
        raise typer.Exit(1)
