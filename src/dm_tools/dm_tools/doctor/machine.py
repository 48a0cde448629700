"""What the doctor checks on any machine: packages, messages between nodes, memory, disk, clock."""

import importlib
import os
import shutil
import subprocess
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from dm_bringup.nodes import NODES
from dm_tools.running_suite import BUSY_S, NEEDED, latest_message, nodes_of_suite, where

MODULES = ("rclpy", "dm_msgs.msg", "numpy", "scipy", "statsmodels", "h5py", "serial")
#: Least free space in /dev/shm, B: virtual bench, autofocus and every program take 17 MB each (config/fastdds.xml).
SHARED_MEMORY_MIN = 60e6
DISK_MIN = 1e9
#: What the suite keeps in ~/.ros unless configured otherwise.
FOLDERS = ("dm_bench", "dm_calibrations")
#: DDS derives its ports from the domain; above this value they overlap the ephemeral ports of the system.
DOMAIN_MAX = 101
#: Time for nodes to find each other, s: a node announces itself once, then every few seconds.
DISCOVERY_S = 3.0
#: Largest difference of clocks, s; commands beyond `limits.command_age` or `limits.command_lead` are refused.
CLOCK_SKEW_S = 0.5
REPORTS_S = 2.5
#: Text about a driver that runs but does not reach its drive unit; the reason follows.
LINK_LOST = "; the driver does not reach the electronics: "


class Finding(NamedTuple):
    """Something a person should know.

    Attributes:
        problem: what is wrong, in words.
        cure: what to do about it; "" = nothing, all is well.
        note: True = worth knowing, but nothing is broken.
    """

    problem: str
    cure: str
    note: bool = False


#: Name of a check, and its function, which returns None when all is well.
Check = tuple[str, Callable[[], Finding | None]]


def machine_checks(namespace: str = "") -> list[Check]:
    """All checks of a machine, in the order in which cures make sense."""
    of_nodes: list[Check] = [
        ("messages between nodes", messages),
        ("nodes that are running", lambda: running_nodes(namespace)),
    ]
    wrong = (found := domain()) is not None and not found.note  # Fast DDS ends the process on a domain above 232
    return [
        ("packages", packages),
        ("Fast DDS profile", profile),
        ("shared memory", shared_memory),
        ("ROS domain", domain),
        *([] if wrong else of_nodes),
        ("disk", disk_use),
        ("clock", clock),
    ]


def packages() -> Finding | None:
    for name in (*MODULES, *dict.fromkeys(node.package for node in NODES)):
        try:
            importlib.import_module(name)
        except ImportError as error:
            return Finding(f"cannot import {name}: {error}", "remove the folder .venv and run ./dm again")
    return None


def profile() -> Finding | None:
    cure = "run through ./dm, or export FASTRTPS_DEFAULT_PROFILES_FILE=<share>/dm_bringup/config/fastdds.xml"
    path = os.environ.get("FASTRTPS_DEFAULT_PROFILES_FILE", "")
    if not path:
        return Finding("no Fast DDS profile is loaded: surface maps travel slowly, nodes find each other late", cure)
    try:
        tree = ElementTree.parse(path)
    except OSError as error:
        return Finding(f"the Fast DDS profile {path} cannot be read: {error.strerror}", cure)
    except ElementTree.ParseError as error:
        return Finding(f"the Fast DDS profile {path} is no XML: {error}", cure)
    names = {element.tag.rpartition("}")[2] for element in tree.iter()}
    wanted = {"maxInitialPeersRange"} | ({"segment_size"} if tree.find(".//{*}type[.='SHM']") is not None else set())
    if missing := wanted - names:
        return Finding(
            f"the Fast DDS profile {path} does not set {', '.join(sorted(missing))}",
            "take over these settings from config/fastdds.xml of dm_bringup",
            note=True,
        )
    return None


def shared_memory() -> Finding | None:
    folder = Path("/dev/shm")
    free = shutil.disk_usage(folder).free if folder.is_dir() else 0
    if free < SHARED_MEMORY_MIN:
        return Finding(
            f"/dev/shm has {free / 1e6:.0f} MB free; each program, virtual bench and autofocus take 17 MB",
            "./dm exec fastdds shm clean removes what killed processes left; in a container raise --shm-size",
        )
    return None


def domain() -> Finding | None:
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not (text.isdecimal() and int(text) <= DOMAIN_MAX):
        return Finding(f"ROS_DOMAIN_ID = {text!r}: must be 0 to {DOMAIN_MAX}", "export ROS_DOMAIN_ID=0")
    if os.environ.get("ROS_LOCALHOST_ONLY") not in (None, "", "0"):
        return Finding(
            "ROS_LOCALHOST_ONLY is set: it overrules ROS_AUTOMATIC_DISCOVERY_RANGE and is deprecated",
            "unset ROS_LOCALHOST_ONLY",
            note=True,
        )
    return None


def messages() -> Finding | None:
    from dm_client import DeformableMirrorClient, DeformableMirrorError

    with DeformableMirrorClient() as first, DeformableMirrorClient() as second:
        from std_msgs.msg import String

        received: list[Any] = []
        second.node.create_subscription(String, "doctor_echo", received.append, 1)
        publisher = first.node.create_publisher(String, "doctor_echo", 1)
        try:
            if not first.wait(lambda: publisher.get_subscription_count() > 0, 5.0):
                return Finding(
                    "two nodes on this machine do not find each other",
                    "check ROS_AUTOMATIC_DISCOVERY_RANGE (LOCALHOST or SUBNET, not OFF) and firewalls (UDP 7400 on)",
                )
            publisher.publish(String(data="?"))
            if not first.wait(lambda: received, 2.0):
                return Finding(
                    "a message between two nodes did not arrive", "./dm exec fastdds shm clean; then ./dm doctor again"
                )
        except DeformableMirrorError as error:
            return Finding(str(error), "run ./dm again")
    return None


def running_nodes(namespace: str = "") -> Finding:
    """Running nodes of the suite: none is a note; one that runs twice, or whose clock differs from ours, is wrong."""
    from dm_client import DeformableMirrorClient

    with DeformableMirrorClient(namespace) as client:
        client.wait(lambda: max(nodes_of_suite(client).values(), default=0) > 1, DISCOVERY_S)
        if max(nodes_of_suite(client).values(), default=0) > 1:  # the others of the second suite, too
            client.wait(lambda: min(nodes_of_suite(client).values(), default=0) > 1, DISCOVERY_S)
        if nodes_of_suite(client):
            client.wait(lambda: NEEDED.keys() <= nodes_of_suite(client).keys(), BUSY_S - DISCOVERY_S)
        count, place = nodes_of_suite(client), where(client)
        twice = [name for name in count if count[name] > 1]
        if twice:
            return Finding(
                f"{', '.join(twice)}: running more than once {place}; both answer requests and command the mirror",
                "end one of them, or give each mirror a --namespace or each bench a ROS_DOMAIN_ID of its own",
            )
        if count and (skew := _skew(client)) is not None:
            return skew
        reason = link_lost(client) if "pdm_driver" in count else ""
    if not count:
        return Finding(f"none {place}", "./dm up starts them", note=True)
    running = f"{', '.join(count)}, {place}"
    lacking = ", ".join(f"{name} ({effect})" for name, effect in NEEDED.items() if name not in count)
    lacking = f"; not running: {lacking}" if lacking else ""
    if reason:
        cure = "switch the unit on and check its cable; ./dm doctor --config FILE looks for it"
        return Finding(f"{running}{LINK_LOST}{reason}{lacking}", cure)
    cure = "end ./dm up with Ctrl-C and start it again" if lacking else ""
    return Finding(f"{running}{lacking}", cure, note=bool(lacking))


def _skew(client: Any) -> Finding | None:
    """Check how far the clocks of the nodes' machines are from ours; every node reports once a second."""
    from diagnostic_msgs.msg import DiagnosticArray

    from dm_common.messages import seconds

    if client.node.get_publishers_info_by_topic("/clock"):
        return None  # the bench has a time of its own
    late: list[tuple[float, str]] = []

    def on_report(report: Any) -> None:
        skew = time.time() - seconds(report.header.stamp)
        if report.status and abs(skew) > CLOCK_SKEW_S:
            late.append((skew, report.status[0].name))

    client.node.create_subscription(DiagnosticArray, "/diagnostics", on_report, 10)
    if client.wait(lambda: late, REPORTS_S):
        return Finding(
            f"the clock of {late[0][1]} and this one differ by {abs(late[0][0]):.1f} s: commands count as stale",
            "synchronise the clocks of both machines: sudo apt-get install chrony",
        )
    return None


def link_lost(client: Any) -> str:
    """Why the driver does not reach its unit; "" = it does, or says nothing."""
    from dm_msgs.msg import ActuatorState

    state = latest_message(client, "actuator_state", REPORTS_S)
    return str(state.message) if state is not None and state.driver_state == ActuatorState.STATE_LINK_LOST else ""


def disk(path: Path) -> Finding | None:
    free = shutil.disk_usage(path).free
    if free < DISK_MIN:
        return Finding(f"{free / 1e9:.1f} GB free in {path}", "make room: maps take 4 MB each, recordings more")
    return None


def disk_use() -> Finding:
    """Free disk space, and the space that the suite's own folders take."""
    home = Path.home()
    if scarce := disk(home):
        return scarce
    taken = []
    for folder in (home / ".ros" / name for name in FOLDERS):
        size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        if size:
            taken.append(f"{size / 1e6:.0f} MB in ~/.ros/{folder.name}")
    return Finding(", ".join([f"{shutil.disk_usage(home).free / 1e9:.0f} GB free", *taken]), "")


def clock() -> Finding | None:
    # A clock that is earlier than the installation of this file is wrong.
    installed = Path(__file__).stat().st_mtime
    if time.time() < installed:
        return Finding(
            f"the system clock says {time.strftime('%Y-%m-%d', time.gmtime())}, but this program was installed on "
            f"{time.strftime('%Y-%m-%d', time.gmtime(installed))}",
            "set the clock (timedatectl set-ntp true): time stamps of maps and commands depend on it",
        )
    program = shutil.which("timedatectl")
    if program is None:
        return None
    answer = subprocess.run(
        [program, "show", "--property=NTPSynchronized", "--value"], capture_output=True, text=True, check=False
    )
    if answer.stdout.strip() == "no":
        return Finding(
            "the system clock is not synchronised",
            "timedatectl set-ntp true; it matters when nodes or the instrument run on other machines",
            note=True,
        )
    return None
